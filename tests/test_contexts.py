"""Context samplers have the spread they promise, and the grid covers the range."""

from functools import partial

import jax
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
    ],
)
def test_refuses_a_range_that_is_none(make, low, high, message):
    with pytest.raises(ValueError, match=message):
        make(low, high)


@pytest.mark.parametrize("std", [0.0, -1.0, (1.0, 1.0)])
def test_refuses_a_standard_deviation_that_is_none(std):
    with pytest.raises(ValueError, match="std must be positive"):
        gaussian_contexts(0.0, 1.0, std=std)


def test_refuses_a_grid_of_one():
    with pytest.raises(ValueError, match="num must be at least 2, got 1"):
        context_grid(0.0, 1.0, 1)
