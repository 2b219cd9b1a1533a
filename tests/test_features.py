"""Feature maps are what they say, sum to one where they should, and stay finite anywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.features import linear_features, quadratic_features, rbf_features

MAPS = {
    "linear": linear_features(2),
    "quadratic": quadratic_features(2),
    "radial": rbf_features((0.0, -1.0), (1.0, 3.0), 3),
}


@pytest.mark.parametrize("name", MAPS)
def test_protocol(name, key):
    features = MAPS[name]
    context = jax.random.normal(key, (2,))
    row = features.apply(context)
    assert row.shape == (features.size,)
    assert row.dtype == jnp.float32
    np.testing.assert_allclose(jax.jit(features.apply)(context), row, rtol=1e-6)
    if features.scale is not None:
        far = jax.vmap(features.apply)(100.0 * jax.random.normal(key, (200, 2)))
        assert (jnp.abs(far) <= jnp.asarray(features.scale)[None]).all()
        # The outermost features get that large.
        np.testing.assert_allclose(jnp.abs(far).max(), max(features.scale), rtol=1e-3)
    rows = jax.vmap(features.apply)(jnp.stack([context, 2 * context]))
    np.testing.assert_allclose(rows[0], row, rtol=1e-6)
    with pytest.raises(ValueError, match=r"shape \(2,\), got \(3,\)"):
        features.apply(jnp.zeros(3))


def test_linear_and_quadratic_by_hand():
    context = jnp.array([2.0, -3.0])
    np.testing.assert_array_equal(linear_features(2).apply(context), [1, 2, -3])
    np.testing.assert_array_equal(quadratic_features(2).apply(context), [2, -3, 4, 9])


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
        ((0.0, 1.0, 3), (0.1, 0.2), "as long as low, 1, got"),
    ],
)
def test_bad_radial_settings_are_named(args, bandwidth, message):
    with pytest.raises(ValueError, match=message):
        rbf_features(*args, bandwidth=bandwidth)


@pytest.mark.parametrize("make", [linear_features, quadratic_features])
def test_bad_dimension_is_named(make):
    with pytest.raises(ValueError, match="dim must be at least 1, got 0"):
        make(0)
