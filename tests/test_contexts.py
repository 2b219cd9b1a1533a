"""Context samplers have the spread they promise, and the grid covers the range."""

import copy
import pickle
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.contexts import context_grid, gaussian_contexts, uniform_contexts

LOW, HIGH = (0.1, -2.0), (0.6, 2.0)
NUM = 20_000


def draw(sampler, key, num=NUM):
    return np.asarray(jax.vmap(sampler)(jax.random.split(key, num)), np.float64)


@pytest.mark.parametrize("std", [None, 0.5, (0.2, 3.0)])
def test_gaussian_has_its_mean_and_standard_deviation(key, std):
    low, high = np.asarray(LOW), np.asarray(HIGH)
    expected = (high - low) / 4 if std is None else np.broadcast_to(std, (2,))
    contexts = draw(gaussian_contexts(LOW, HIGH, std=std), key)
    # Five standard errors of a mean and of a standard deviation.
    np.testing.assert_array_less(np.abs(contexts.mean(0) - (low + high) / 2), 5 * expected / np.sqrt(NUM))
    np.testing.assert_array_less(np.abs(contexts.std(0) - expected), 5 * expected / np.sqrt(2 * NUM))


def test_clipping_moves_only_what_lies_outside(key):
    free = draw(gaussian_contexts(LOW, HIGH), key)
    clipped = draw(gaussian_contexts(LOW, HIGH, clip=True), key)
    low, high = np.float32(LOW), np.float32(HIGH)
    assert (free < low).any() and (free > high).any()
    np.testing.assert_array_equal(clipped, np.clip(free, low, high))


def test_uniform_fills_the_range_evenly(key):
    contexts = draw(uniform_contexts(LOW, HIGH), key)
    unit = (contexts - LOW) / (np.asarray(HIGH) - LOW)
    assert unit.min() >= -1e-6 and unit.max() <= 1 + 1e-6
    for dim in range(2):
        counts, _ = np.histogram(unit[:, dim], bins=10, range=(-1e-6, 1 + 1e-6))
        np.testing.assert_allclose(counts, NUM / 10, atol=5 * np.sqrt(NUM / 10))
    assert abs(np.corrcoef(unit.T)[0, 1]) < 5 / np.sqrt(NUM)


def test_numbers_mean_one_dimension(key):
    assert gaussian_contexts(0.1, 0.6)(key).shape == uniform_contexts(0, 1)(key).shape == (1,)


def test_grid_holds_every_combination_and_both_ends():
    grid = np.asarray(context_grid(LOW, HIGH, 3))
    expected = [(a, b) for a in (0.1, 0.35, 0.6) for b in (-2.0, 0.0, 2.0)]
    np.testing.assert_allclose(grid, expected, rtol=1e-6)
    np.testing.assert_allclose(context_grid(0, 1, 5)[:, 0], [0, 0.25, 0.5, 0.75, 1])


@pytest.mark.parametrize("make", [gaussian_contexts, uniform_contexts, partial(context_grid, num=3)])
@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        (1.0, 1.0, r"low must be below high.*\[1\.\] and \[1\.\]"),
        ((0.0, 0.0), 1.0, r"one length, got \(2,\) and \(1,\)"),
        (0.0, float("nan"), "nan"),
        (0.0, 1e-39, r"below high by at least 1e-30, got \[0\.\] and \[1\.e-39\]"),
        ((0.0, 1e-38), (1.0, 2e-38), "low must be below high by at least 1e-30"),
    ],
)
def test_refuses_a_range_that_is_none(make, low, high, message):
    with pytest.raises(ValueError, match=message):
        make(low, high)


@pytest.mark.parametrize("std", [0.0, -1.0, (1.0, 1.0), 1e-39])
def test_refuses_a_standard_deviation_that_is_none(std):
    with pytest.raises(ValueError, match="std must be positive"):
        gaussian_contexts(0.0, 1.0, std=std)


def test_refuses_a_grid_of_one():
    with pytest.raises(ValueError, match="num must be at least 2, got 1"):
        context_grid(0.0, 1.0, 1)


LARGEST = float(np.finfo(np.float32).max)
EXTREMES = {
    "wide": (-3e38, 3e38),
    "widest": (-LARGEST, LARGEST),
    "high": (3e38, 3.1e38),
    "narrow": (0.0, 1e-30),
    "all at once": ((-3e38, 0.0, 0.1), (3e38, 1e-30, 0.6)),
}
extremes = pytest.mark.parametrize(("low", "high"), EXTREMES.values(), ids=EXTREMES)


@extremes
def test_contexts_of_extreme_ranges_stay_in_them(key, low, high):
    ends = np.float32(low), np.float32(high)
    middle = np.mean(np.asarray([low, high], float), axis=0)
    half = np.asarray(high, float) - middle
    for sampler in (uniform_contexts(low, high), gaussian_contexts(low, high, clip=True)):
        with jax.debug_nans(True):
            contexts = draw(sampler, key, 2000)
            single = sampler(key)
            np.testing.assert_allclose(single, jax.jit(sampler)(key), rtol=1e-5)
        assert np.isfinite(single).all()
        assert (contexts >= ends[0]).all() and (contexts <= ends[1]).all()
        # Both halves of the range are visited, and most of it.
        unit = (contexts - middle) / half
        assert (np.abs(unit.mean(0)) < 0.1).all() and (unit.min(0) < -0.9).all() and (unit.max(0) > 0.9).all()
    grid = np.asarray(context_grid(low, high, 3), float)
    assert np.isfinite(grid).all()
    np.testing.assert_array_equal(grid[0], np.float32(np.atleast_1d(low)))
    np.testing.assert_array_equal(grid[-1], np.float32(np.atleast_1d(high)))
    np.testing.assert_allclose((grid[len(grid) // 2] - middle) / half, 0.0, atol=1e-5)


@extremes
@pytest.mark.parametrize("std", [None, LARGEST])
def test_gaussian_contexts_without_limits_are_finite(key, low, high, std):
    contexts = draw(gaussian_contexts(low, high, std=std), key, 2000)
    assert np.isfinite(contexts).all() and (contexts.std(0) > 0).all()


@pytest.mark.parametrize(("low", "high"), [(0.1, 0.6), (LOW, HIGH), ((-3e3, 0.0), (2e5, 1e-6))])
def test_contexts_of_ordinary_ranges_are_the_plain_formulas_to_the_bit(key, low, high):
    low, high = np.float32(np.atleast_1d(low)), np.float32(np.atleast_1d(high))
    keys = jax.random.split(key, 100)

    def gaussian(key):
        return jnp.asarray((low + high) / 2) + (high - low) / 4 * jax.random.normal(key, low.shape)

    pairs = [
        (gaussian_contexts(low, high), gaussian),
        (gaussian_contexts(low, high, clip=True), lambda key: jnp.clip(gaussian(key), low, high)),
        (
            uniform_contexts(low, high),
            lambda key: jax.random.uniform(key, low.shape, minval=low, maxval=high),
        ),
    ]
    for sampler, plain in pairs:
        for transform in (jax.vmap, lambda f: jax.jit(jax.vmap(f))):
            np.testing.assert_array_equal(transform(sampler)(keys), transform(plain)(keys))
    grid = np.asarray(context_grid(low, high, 5)).reshape(*[5] * low.size, low.size)
    for dim in range(low.size):
        axis = np.moveaxis(grid[..., dim], dim, 0).reshape(5, -1)[:, 0]
        np.testing.assert_array_equal(axis, np.linspace(low[dim], high[dim], 5, dtype=np.float32))


SAMPLERS = {
    "gaussian": lambda: gaussian_contexts(LOW, HIGH),
    "gaussian and clipped": lambda: gaussian_contexts(LOW, HIGH, clip=True),
    "gaussian of another width": lambda: gaussian_contexts(LOW, HIGH, std=2.0),
    "uniform": lambda: uniform_contexts(LOW, HIGH),
    "uniform from elsewhere": lambda: uniform_contexts(LOW, (0.7, 2.0)),
}


@pytest.mark.parametrize("make", SAMPLERS.values(), ids=SAMPLERS)
def test_samplers_of_equal_settings_are_equal_and_can_be_copied(key, make):
    sampler = make()
    for same in (make(), copy.deepcopy(sampler), pickle.loads(pickle.dumps(sampler))):
        assert same == sampler and hash(same) == hash(sampler)
        np.testing.assert_array_equal(same(key), sampler(key))
    assert [sampler == other() for other in SAMPLERS.values()].count(True) == 1
