"""Feature maps are what they say, sum to one where they should, and stay finite anywhere."""

import copy
import dataclasses
import itertools
import json
import math
import pickle
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import qmc

import creps_jax as cj
from creps_jax.policies.feature_functions import inducing_contexts
from creps_jax.policies.feature_settings import Features, upgraded
from creps_jax.policies.features import (
    describe,
    from_description,
    kernel_features,
    linear_features,
    polynomial_features,
    quadratic_features,
    rbf_features,
    rbf_grid,
    scaled_polynomial_features,
)

MAPS = {
    "linear": linear_features(2),
    "quadratic": quadratic_features(2),
    "polynomial": polynomial_features(2, 3),
    "scaled polynomial": scaled_polynomial_features((0.0, -1.0), (1.0, 3.0), 3),
    "radial": rbf_features((0.0, -1.0), (1.0, 3.0), 3),
    "kernel": kernel_features((0.0, -1.0), (1.0, 3.0), 12),
}


@pytest.mark.parametrize("name", MAPS)
def test_protocol(name, key):
    features = MAPS[name]
    context = jax.random.normal(key, (2,))
    row = features.apply(context)
    assert row.shape == (features.size,)
    assert row.dtype == jnp.float32
    # The inverse root of the kernel matrix enlarges rounding.
    rounding = 1e-5 if name == "kernel" else 0.0
    np.testing.assert_allclose(jax.jit(features.apply)(context), row, rtol=1e-6, atol=rounding)
    if features.scale is not None:
        far = jax.vmap(features.apply)(100.0 * jax.random.normal(key, (200, 2)))
        assert (jnp.abs(far) <= jnp.asarray(features.scale)[None]).all()
        # The outermost features get that large.
        np.testing.assert_allclose(jnp.abs(far).max(), max(features.scale), rtol=1e-3)
    rows = jax.vmap(features.apply)(jnp.stack([context, 2 * context]))
    np.testing.assert_allclose(rows[0], row, rtol=1e-6, atol=rounding)
    with pytest.raises(ValueError, match=r"shape \(2,\), got \(3,\)"):
        features.apply(jnp.zeros(3))


def test_linear_and_quadratic_by_hand():
    context = jnp.array([2.0, -3.0])
    np.testing.assert_array_equal(linear_features(2).apply(context), [1, 2, -3])
    np.testing.assert_array_equal(quadratic_features(2).apply(context), [2, -3, 4, 9])


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
@pytest.mark.parametrize("degree", [1, 2, 4])
def test_polynomial_features_are_all_monomials(dim, degree):
    features = polynomial_features(dim, degree)
    assert features.size == math.comb(dim + degree, degree) and features.context_dim == dim
    context = np.random.default_rng(dim).uniform(-2, 2, dim)
    expected = [
        math.prod(variables)
        for total in range(degree + 1)
        for variables in itertools.combinations_with_replacement(context.tolist(), total)
    ]
    assert expected[0] == 1
    np.testing.assert_allclose(features.apply(jnp.float32(context)), expected, rtol=1e-5)


@pytest.mark.parametrize(("low", "high"), [((0.0, 990.0), (1000.0, 1000.0)), ((-1e-3, 1.0), (1e-3, 2.0))])
def test_scaled_polynomials_are_of_the_range_from_minus_one_to_one(low, high):
    features = scaled_polynomial_features(low, high, 3)
    shares = cj.context_grid((-1.0, -1.0), (1.0, 1.0), 5)
    middle, half = 0.5 * np.add(high, low), 0.5 * np.subtract(high, low)
    rows = features(jnp.asarray(middle + half * np.asarray(shares), jnp.float32))
    np.testing.assert_allclose(rows, polynomial_features(2, 3)(shares), atol=2e-4)
    assert np.abs(rows).max() <= 1.0 and features.constant == polynomial_features(2, 3).constant
    settings = Features("polynomial", degree=3)
    assert settings.make(low, high) == features
    unscaled = Features("polynomial", degree=3, scaled=False)
    assert unscaled.make(low, high) == polynomial_features(2, 3)


def test_polynomial_features_by_hand():
    x, y, z = 2.0, -3.0, 5.0
    row = polynomial_features(3, 2).apply(jnp.array([x, y, z]))
    np.testing.assert_array_equal(row, [1, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
    np.testing.assert_array_equal(
        polynomial_features(2, 1).apply(jnp.array([x, y])), linear_features(2).apply(jnp.array([x, y]))
    )


@pytest.mark.parametrize(("dim", "degree"), [(1000, 3), (3, 1000), (10**9, 10**9), (2, 2**31 - 1)])
def test_too_many_monomials_are_refused(dim, degree):
    with pytest.raises(ValueError, match=f"dim and degree must leave at most .*, got {dim} and {degree}"):
        polynomial_features(dim, degree)


MAKERS = {
    "linear": lambda: linear_features(2),
    "quadratic": lambda: quadratic_features(2),
    "polynomial": lambda: polynomial_features(2, 2),
    "polynomial of another degree": lambda: polynomial_features(2, 3),
    "scaled polynomial": lambda: scaled_polynomial_features((0.0, 0.0), (1.0, 1.0), 2),
    "scaled polynomial of another range": lambda: scaled_polynomial_features((0.0, 0.0), (1.0, 2.0), 2),
    "radial": lambda: rbf_features((0.0, -1.0), (1.0, 3.0), 3),
    "radial of NumPy": lambda: rbf_features(np.array([0.0, -2.0]), jnp.array([1.0, 3.0]), 3),
    "kernel": lambda: kernel_features((0.0, -1.0), (1.0, 3.0), 9),
    "kernel of another width": lambda: kernel_features((0.0, -1.0), (1.0, 3.0), 9, bandwidth=0.2),
    "radial of another width": lambda: rbf_features((0.0, -1.0), (1.0, 3.0), 3, bandwidth=0.2),
}


@pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)
def test_features_of_equal_settings_are_equal_and_can_be_copied(make):
    features, context = make(), jnp.array([0.3, 0.7])
    copies = [make(), copy.deepcopy(features), pickle.loads(pickle.dumps(features))]
    for same in copies:
        assert same == features and hash(same) == hash(features)
        np.testing.assert_array_equal(same.apply(context), features.apply(context))
    assert [features == other() for other in MAKERS.values()].count(True) == 1


def test_equal_features_share_one_compilation():
    traces = []

    @partial(jax.jit, static_argnums=0)
    def apply(features, context):
        traces.append(features)
        return features.apply(context)

    for _ in range(2):
        apply(rbf_features(0.0, 1.0, 3), jnp.array([0.3]))
    assert len(traces) == 1


LARGEST = float(np.finfo(np.float32).max)
# Ranges with bandwidths, None for the default one; a row of numbers is a range of several variables.
EXTREMES = {
    "narrow bandwidth": (0.0, 1.0, 1e-20),
    "narrowest bandwidth": (-3e38, 3e38, 1.2e-38),
    "wide bandwidth": (0.0, 1.0, 1e30),
    "widest bandwidth": (0.0, 1.0, LARGEST),
    "narrow range": (0.0, 1e-30, None),
    "narrow range and wide bandwidth": (0.0, 1e-30, LARGEST),
    "wide range": (-3e38, 3e38, None),
    "widest range": (-LARGEST, LARGEST, None),
    "wide range and bandwidth": (-LARGEST, LARGEST, LARGEST),
    "half wide range": (0.0, LARGEST, None),
    "high range": (3e38, 3.1e38, None),
    "all at once": ((0.0, -3e38, 0.0, 0.0), (1.0, 3e38, 1e-30, 1.0), (1e-20, 1e38, 1e-31, 0.3)),
}


@pytest.mark.parametrize("num_centers", [1, 2, 5])
@pytest.mark.parametrize(("low", "high", "width"), EXTREMES.values(), ids=EXTREMES)
def test_radial_features_of_extreme_settings_are_weights(low, high, width, num_centers):
    features = rbf_features(low, high, num_centers, bandwidth=width)
    low, high = np.atleast_1d(low), np.atleast_1d(high)
    inside = low + np.linspace(0, 1, 9)[:, None] * (high - low)
    far = np.array([-LARGEST, -1e20, -1.0, 0.0, 1e-38, 1.0, 1e20, LARGEST])[:, None] * np.ones_like(low)
    contexts = jnp.float32(np.concatenate([inside, far]).clip(-LARGEST, LARGEST))
    with jax.debug_nans(True):
        eager = jnp.stack([features.apply(context) for context in contexts])
        compiled = jax.jit(jax.vmap(features.apply))(contexts)
    for rows in (eager, compiled):
        assert np.isfinite(rows).all() and (rows >= 0).all()
        np.testing.assert_allclose(rows.sum(1), 1, atol=1e-5)
    np.testing.assert_allclose(eager, compiled, atol=1e-5)


@pytest.mark.parametrize("width", [1e-5, 1e-8, 1e-12, 1e-19, 1e-20, 1e-30, 1.2e-38])
@pytest.mark.parametrize("compiled", [False, True])
def test_the_nearest_center_wins_at_any_narrow_bandwidth(width, compiled):
    features = rbf_features(0.0, 4.0, 5, bandwidth=width)
    apply = jax.jit(features.apply) if compiled else features.apply
    for context in (-7.0, 0.0, 0.3, 1.4, 1.6, 3.9, 4.0, 1e30):
        expected = np.zeros(5)
        expected[round(min(max(context, 0.0), 4.0))] = 1.0
        np.testing.assert_array_equal(apply(jnp.float32([context])), expected)
    for middle in (0.5, 1.5, 3.5):
        expected = [0.5 if abs(center - middle) < 1 else 0.0 for center in range(5)]
        np.testing.assert_array_equal(apply(jnp.float32([middle])), expected)


def test_a_narrow_bandwidth_of_one_variable_leaves_the_others_alone():
    features = rbf_features((0.0, 0.0), (1.0, 1.0), 3, bandwidth=(1e-20, 0.3))
    expected = np.outer([0, 0.5, 0.5], radial_by_hand(0.4, 0.0, 1.0, 3, 0.3)).ravel()
    np.testing.assert_allclose(features.apply(jnp.float32([0.75, 0.4])), expected, rtol=1e-4)


@pytest.mark.parametrize("width", [1e10, 1e20, 1e30, LARGEST])
def test_wide_bandwidths_give_equal_features(width):
    apply = rbf_features(0.0, 1.0, 4, bandwidth=width).apply
    for context in (-1.0, 0.0, 0.3, 1.0, 9.0):
        np.testing.assert_allclose(apply(jnp.float32([context])), 0.25, rtol=1e-6)


@pytest.mark.parametrize("scale", [1e-29, 1e-10, 1e10, 1e29, 1e31, 5e37, 1e38, 3e38])
def test_radial_features_do_not_depend_on_the_unit(scale):
    ordinary = rbf_features(-1.0, 1.0, 4).apply
    other = rbf_features(-scale, scale, 4).apply
    for context in (-0.9, 0.0, 0.5, 1.1):
        expected = ordinary(jnp.float32([context]))
        np.testing.assert_allclose(other(jnp.float32([context * scale])), expected, rtol=1e-4)


@pytest.mark.parametrize(("low", "high"), [(0.1, 0.6), ((0.0, -1.0), (1.0, 3.0)), ((-3e3, 0.0), (2e5, 1e-6))])
@pytest.mark.parametrize("num_centers", [1, 2, 5])
@pytest.mark.parametrize("width", [None, 1e-3, 100.0])
def test_radial_features_of_ordinary_settings_are_the_plain_formula_to_the_bit(low, high, num_centers, width):
    features = rbf_features(low, high, num_centers, bandwidth=width)
    centers, widths = map(jnp.float32, rbf_grid(low, high, num_centers, bandwidth=width))
    low, high = jnp.float32(np.atleast_1d(low)), jnp.float32(np.atleast_1d(high))

    def plain(context):
        nearest = jnp.clip(context, low, high)
        inside = (nearest[None, :] - centers) / widths[None, :]
        outside = jnp.clip((context - nearest) / widths, -1e20, 1e20)
        return jax.nn.softmax(-jnp.sum(0.5 * inside**2 + outside[None, :] * inside, axis=1))

    shares = jnp.linspace(-0.5, 1.5, 41)[:, None]
    contexts = low[None] + shares * (high - low)[None]
    for transform in (jax.vmap, lambda f: jax.jit(jax.vmap(f))):
        np.testing.assert_array_equal(transform(features.apply)(contexts), transform(plain)(contexts))


@pytest.mark.parametrize("features", [quadratic_features(3), polynomial_features(3, 4)])
def test_powers_stay_finite(features):
    numbers = [0.0, 1e-38, 1.0, 1e15, 1e20, LARGEST]
    contexts = jnp.float32(list(itertools.product([*numbers, -1e20], repeat=3)))
    with jax.debug_nans(True):
        rows = jax.jit(jax.vmap(features.apply))(contexts)
    assert np.isfinite(rows).all()
    ordinary = np.abs(contexts).max(1) <= 1.0
    assert (np.abs(rows[ordinary]) <= 1).all()


def radial_by_hand(context, low, high, num_centers, width):
    """Evaluate Eq. 16 in float64, one context variable."""
    centers = low + (high - low) * np.arange(num_centers) / (num_centers - 1)
    psi = np.exp(-((context - centers) ** 2) / (2 * width**2))
    return psi / psi.sum()


@pytest.mark.parametrize("width", [None, 0.05, 0.3])
def test_radial_is_equation_16(width):
    features = rbf_features(0.1, 0.6, 5, bandwidth=width)
    for context in np.linspace(0.0, 0.7, 8):
        expected = radial_by_hand(np.float32(context), 0.1, 0.6, 5, width or 0.1)
        np.testing.assert_allclose(features.apply(jnp.float32([context])), expected, rtol=2e-4, atol=1e-7)


def test_radial_on_a_grid_is_a_product():
    features = rbf_features((0.0, -1.0), (1.0, 3.0), 3, bandwidth=(0.4, 2.0))
    context = np.array([0.3, 0.7])
    first, second = radial_by_hand(0.3, 0, 1, 3, 0.4), radial_by_hand(0.7, -1, 3, 3, 2.0)
    expected = np.outer(first, second).ravel()
    np.testing.assert_allclose(features.apply(jnp.float32(context)), expected, rtol=1e-4)
    assert features.size == 9


def test_one_center_lies_in_the_middle():
    features = rbf_features(0.0, 1.0, 1)
    assert features.size == 1
    np.testing.assert_array_equal(features.apply(jnp.array([0.3])), [1.0])


@pytest.mark.parametrize(("num_centers", "width"), [(1, None), (2, 100.0), (5, None), (20, 1e-3)])
def test_rows_sum_to_one_and_are_finite_anywhere(num_centers, width):
    features = rbf_features(-2.0, 6.0, num_centers, bandwidth=width)
    contexts = np.concatenate([np.linspace(-3, 7, 41), [-1e3, 1e3, -1e8, 1e8, -3e38, 3e38, -np.inf, np.inf]])
    rows = np.asarray(jax.jit(jax.vmap(features.apply))(jnp.float32(contexts)[:, None]))
    assert np.all(np.isfinite(rows)) and np.all(rows >= 0)
    np.testing.assert_allclose(rows.sum(1), 1.0, atol=1e-5)
    gradients = jax.jit(jax.vmap(jax.jacobian(features.apply)))(jnp.float32(contexts)[:-2, None])
    assert np.all(np.isfinite(gradients))


def test_far_outside_only_the_nearest_center_is_left():
    features = rbf_features(0.0, 1.0, 4)
    np.testing.assert_allclose(features.apply(jnp.array([-1e6])), [1, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(features.apply(jnp.array([1e6])), [0, 0, 0, 1], atol=1e-6)


def test_radial_is_smooth_across_the_ends_of_the_range():
    features = rbf_features(0.0, 1.0, 4)
    slope = jax.jit(jax.jacobian(features.apply))
    for end in (0.0, 1.0):
        near = [slope(jnp.float32([end + step]))[:, 0] for step in (-1e-4, 0.0, 1e-4)]
        np.testing.assert_allclose(near[0], near[2], atol=0.02)
        np.testing.assert_allclose(near[1], near[2], atol=0.02)


@pytest.mark.parametrize(
    ("args", "bandwidth", "message"),
    [
        ((1.0, 1.0, 3), None, r"low must be below high, got \[1\.\] and \[1\.\]"),
        ((2.0, 1.0, 3), None, r"got \[2\.\] and \[1\.\]"),
        (((0.0, 1.0), (1.0, 0.5), 3), None, "low must be below high"),
        ((0.0, float("inf"), 3), None, "high must be finite, got inf"),
        ((float("nan"), 1.0, 3), None, "low must be finite, got nan"),
        (((0.0, 0.0), 1.0, 3), None, r"one length, got \(2,\) and \(1,\)"),
        ((0.0, 1.0, 0), None, "num_centers must be at least 1, got 0"),
        ((0.0, 1.0, 3), 0.0, "bandwidth must be above zero, got 0.0"),
        ((0.0, 1.0, 3), float("nan"), "got nan"),
        ((0.0, 1.0, 3), 1e-39, "bandwidth must be above zero, got 1e-39, which float32 cannot hold"),
        ((0.0, 1e-39, 3), None, r"below high by at least 1e-30, got \[0\.\] and \[1\.e-39\]"),
        (((0.0, -1e-38), (1.0, 1e-38), 3), None, "below high by at least 1e-30"),
        ((0.0, 1.0, 3), (0.1, 0.2), "as long as low, 1, got"),
    ],
)
def test_bad_radial_settings_are_named(args, bandwidth, message):
    with pytest.raises(ValueError, match=message):
        rbf_features(*args, bandwidth=bandwidth)


@pytest.mark.parametrize(
    "make", [linear_features, quadratic_features, partial(polynomial_features, degree=2)]
)
def test_bad_dimension_is_named(make):
    with pytest.raises(ValueError, match="dim must be at least 1, got 0"):
        make(0)


@pytest.mark.parametrize("name", MAPS)
def test_features_are_described_by_plain_values(name):
    described = json.loads(json.dumps(describe(MAPS[name])))
    assert from_description(described) == MAPS[name]


@pytest.mark.parametrize("dim", [1, 3, 6])
def test_inducing_contexts_are_a_halton_sequence(dim):
    expected = qmc.Halton(dim, scramble=False).random(51)[1:]
    np.testing.assert_allclose(inducing_contexts(dim, 50), expected, rtol=1e-12)


@pytest.mark.parametrize("width", [None, (0.3, 2.0), 40.0])
def test_products_of_kernel_features_are_the_covariances_that_the_inducing_contexts_represent(width):
    low, high = np.array([0.0, -1.0]), np.array([1.0, 3.0])
    features = kernel_features(low, high, 20, bandwidth=width)
    widths = 0.75 * (high - low) if width is None else np.broadcast_to(width, 2)

    def kernel(left, right):
        return np.exp(-0.5 * np.sum(((left[:, None] - right[None]) / widths) ** 2, axis=2))

    points = low + inducing_contexts(2, 20) * (high - low)
    contexts = np.float32(np.random.default_rng(0).uniform(low - 0.5, high + 0.5, (30, 2)))
    rows = np.asarray(features(jnp.asarray(contexts)), float)
    np.testing.assert_array_equal(rows[:, 0], 1.0)
    between = kernel(contexts, points)
    expected = between @ np.linalg.solve(kernel(points, points) + 1e-6 * np.eye(20), between.T)
    np.testing.assert_allclose(rows[:, 1:] @ rows[:, 1:].T, expected, atol=2e-3)
    # With narrow kernels inducing contexts know themselves, and nothing else.
    narrow = kernel_features(low, high, 5, bandwidth=0.01 * (high - low))
    points = low + inducing_contexts(2, 5) * (high - low)
    np.testing.assert_allclose(narrow(jnp.float32(points))[:, 1:], np.eye(5), atol=1e-4)


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 1e-30), (-3e38, 3e38), (-LARGEST, LARGEST), (3e38, 3.1e38), (0.0, 1.0)]
)
def test_kernel_features_are_finite_anywhere(low, high):
    features = kernel_features((low, low), (high, high), 6)
    numbers = [-LARGEST, -1e20, 0.0, 1e-30, 0.5, low, high, 0.5 * high + 0.5 * low, LARGEST]
    contexts = jnp.float32(list(itertools.product(numbers, repeat=2)))
    rows = jax.jit(jax.vmap(features.apply))(contexts)
    assert np.isfinite(rows).all() and (np.abs(rows) <= 1.001).all()
    middle = jnp.float32([[0.5 * high + 0.5 * low] * 2])
    ordinary = kernel_features((0.0, 0.0), (1.0, 1.0), 6)(jnp.float32([[0.5, 0.5]]))
    np.testing.assert_allclose(features(middle), ordinary, atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"num": 0}, "num must be at least 1, got 0"),
        ({"num": 10_000}, "num must be at most 2000 inducing contexts, got 10000"),
        ({"bandwidth": 0.0}, r"bandwidth must be from 0\.001 to 1000 times high - low, got 0\.0"),
        ({"bandwidth": 1e4}, r"bandwidth must be from 0\.001 to 1000 times high - low, got 10000\.0"),
        ({"bandwidth": (0.1, 0.1)}, r"bandwidth must be a number or as long as low, 1, got \(0\.1, 0\.1\)"),
        ({"low": 1.0}, "low must be below high"),
    ],
)
def test_kernels_that_cannot_be_are_named(changes, match):
    with pytest.raises(ValueError, match=match):
        kernel_features(**({"low": 0.0, "high": 1.0, "num": 5} | changes))


@pytest.mark.parametrize(
    "settings",
    [
        {"kind": "rbf", "degree": 3},
        {"kind": "linear", "degree": 2},
        {"num_centers": 4, "degree": 3},
        {"kind": "polynomial", "bandwidth": 0.5},
        {"kind": "polynomial", "num_points": 5},
        {"num_centers": 3, "kind": "rbf", "num_points": 5},
        {"num_centers": 3, "num_points": 5},
    ],
)
def test_settings_of_another_kind_of_features_are_refused(settings):
    with pytest.raises(ValueError, match=r"must be None for (rbf|linear|polynomial|kernel) features, got"):
        Features(**settings).make(0.0, 1.0)


@pytest.mark.parametrize(("dim", "size"), [(1, 5), (2, 9), (3, 21), (4, 21), (5, 21)])
def test_the_default_features_depend_on_the_number_of_contexts(dim, size):
    low, high = (-1.0,) * dim, (1.0,) * dim
    assert Features().make(low, high).size == Features().complete(dim).make(low, high).size == size


@pytest.mark.parametrize(("dim", "num"), [(1, 6), (2, 10), (3, 20), (4, 20), (6, 20)])
def test_settings_make_kernel_features(dim, num):
    low, high = (-1.0,) * dim, (3.0,) * dim
    assert Features("kernel").make(low, high) == kernel_features(low, high, num)
    assert Features("kernel").complete(dim) == Features("kernel", num_points=num)
    wide = kernel_features(low, high, 4, bandwidth=5.0)
    assert Features(num_points=4, bandwidth=5.0).make(low, high) == wide
    assert Features(num_points=4).make_baseline(low, high) == kernel_features(low, high, 4)


def test_plain_settings_upgraded_have_polynomials_that_are_not_scaled():
    before = {"features": {"kind": "polynomial", "degree": 2}, "seed": 3}
    assert upgraded(before) == {"features": {**before["features"], "scaled": False}, "seed": 3}
    for now in ({"features": dataclasses.asdict(Features())}, {"seed": 3}, {"features": 3}, [1], None):
        assert upgraded(now) == now


@pytest.mark.parametrize("num", [0, -1, 2001, True])
def test_a_bad_number_of_points_is_named(num):
    with pytest.raises(ValueError, match=f"num_points must be from 1 to 2000, got {num!r}"):
        Features("kernel", num_points=num).make(0.0, 1.0)
