"""The policy is the Gaussian it says, and its fit is the weighted maximum likelihood of Eq. 14 and 15."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from creps_jax.policies.base import WeightedSamples
from creps_jax.policies.features import (
    linear_features,
    polynomial_features,
    quadratic_features,
    rbf_features,
)
from creps_jax.policies.gaussian import (
    LinearGaussian,
    entropy,
    fit_weighted_ml,
    kl,
    linear_gaussian,
    log_prob,
    mean,
    sample,
    start_policy,
)
from creps_jax.search.fit import bounded_ml, weighted_ml

COEF = np.array([[1.0, -2.0, 0.5], [3.0, 0.0, -1.0]])
ROOT = np.array([[0.5, 0.0, 0.0], [0.2, 1.0, 0.0], [-0.3, 0.4, 2.0]])
FEATURES = jnp.array([1.0, 0.7])


fit = jax.jit(fit_weighted_ml)


def policy(coef=COEF, root=ROOT):
    return LinearGaussian(jnp.float32(coef), jnp.float32(root))


def data(num=300, seed=0):
    """Return rows of radial features, parameters of very different sizes, and weights."""
    rng = np.random.default_rng(seed)
    context = rng.uniform(0.1, 0.6, size=num)
    rows = jax.vmap(rbf_features(0.1, 0.6, 5).apply)(jnp.float32(context)[:, None])
    small = 1e-3 * np.sin(9 * context) + 1e-4 * rng.normal(size=num)
    large = 10 + context + rng.normal(size=num) + 1e3 * small
    return rows, jnp.float32(np.column_stack([small, large])), jnp.float32(rng.exponential(size=num))


def fit_in_float64(features, theta, weights):
    """Return coefficients and covariance of Eq. 14 and 15, written down plainly.

    Z counts the fitted features; of a constant alone it is that of Eq. 15.
    """
    features, theta, d = (np.asarray(array, np.float64) for array in (features, theta, weights))
    d = d / d.sum()
    gram = features.T @ np.diag(d) @ features
    coef = np.linalg.solve(gram, features.T @ np.diag(d) @ theta)
    residual = theta - features @ coef
    return coef, residual.T @ np.diag(d) @ residual / normaliser_of(features, d)


def normaliser_of(features, weights):
    """Return Z = 1 - sum d^2 x' G^-1 x with G = X' D X."""
    features, d = np.asarray(features, np.float64), np.asarray(weights, np.float64)
    d = d / d.sum()
    return 1 - np.trace(
        np.linalg.solve(features.T @ np.diag(d) @ features, features.T @ np.diag(d**2) @ features)
    )


# The distribution.


def test_log_prob_and_entropy_are_those_of_scipy():
    theta = np.array([0.3, -1.0, 2.0])
    reference = multivariate_normal(np.asarray(FEATURES) @ COEF, ROOT @ ROOT.T)
    np.testing.assert_allclose(
        log_prob(policy(), FEATURES, jnp.float32(theta)), reference.logpdf(theta), rtol=1e-5
    )
    np.testing.assert_allclose(entropy(policy()), reference.entropy(), rtol=1e-6)
    np.testing.assert_allclose(mean(policy(), FEATURES), reference.mean, rtol=1e-6)


def test_samples_have_the_mean_and_covariance(key):
    num = 20_000
    keys = jax.random.split(key, num)
    thetas = np.asarray(jax.jit(jax.vmap(sample, (0, None, None)))(keys, policy(), FEATURES), np.float64)
    cov = ROOT @ ROOT.T
    spread = np.sqrt(np.diag(cov))
    assert np.all(np.abs(thetas.mean(0) - np.asarray(FEATURES) @ COEF) < 5 * spread / np.sqrt(num))
    assert np.all(np.abs(np.cov(thetas.T) - cov) < 7 * np.outer(spread, spread) / np.sqrt(num))


def test_kl_is_the_mean_log_ratio_and_zero_to_itself(key):
    other = policy(COEF + 0.3, np.diag([1.0, 2.0, 1.5]))
    thetas = jax.jit(jax.vmap(sample, (0, None, None)))(jax.random.split(key, 20_000), policy(), FEATURES)
    densities = [jax.vmap(log_prob, (None, None, 0))(p, FEATURES, thetas) for p in (policy(), other)]
    np.testing.assert_allclose(kl(policy(), other, FEATURES), np.mean(densities[0] - densities[1]), rtol=0.03)
    np.testing.assert_allclose(kl(policy(), policy(), FEATURES), 0.0, atol=1e-6)


# The fit.


def test_fit_is_equations_14_and_15():
    features, theta, weights = data()
    found = fit(features, theta, weights, ridge=0.0)
    coef, cov = fit_in_float64(features, theta, weights)
    spread = np.sqrt(np.diag(cov))
    assert np.max(np.abs(found.coef - coef) / spread) < 1e-3
    found_cov = np.float64(found.cov_chol) @ np.float64(found.cov_chol).T
    np.testing.assert_allclose(
        found_cov / np.outer(spread, spread), cov / np.outer(spread, spread), atol=1e-4
    )


def test_gradient_of_the_weighted_log_likelihood_is_zero():
    features, theta, weights = data()
    share = weights / jnp.sum(weights)
    found = fit(features, theta, weights, ridge=0.0)
    # Eq. 15 divides by Z, which is unbiased; the likelihood is greatest with Z = 1.
    root = jnp.sqrt(jnp.float32(normaliser_of(features, weights)))
    likeliest = found._replace(cov_chol=found.cov_chol * root)

    def likelihood(coef_change, root_change):
        spread = jnp.diagonal(likeliest.cov_chol)
        changed = LinearGaussian(
            likeliest.coef + coef_change * spread[None, :],
            likeliest.cov_chol + jnp.tril(root_change) * spread[:, None],
        )
        return jnp.sum(share * jax.vmap(log_prob, (None, 0, 0))(changed, features, theta))

    gradients = jax.jit(jax.grad(likelihood, (0, 1)))(jnp.zeros((5, 2)), jnp.zeros((2, 2)))
    for gradient in gradients:
        np.testing.assert_allclose(gradient, 0.0, atol=1e-3)


def test_noise_is_recovered_though_the_context_moves_the_mean():
    rng = np.random.default_rng(1)
    context = rng.uniform(-3, 3, size=4000)
    theta = np.column_stack([5 + 2 * context, -context]) + rng.normal(size=(4000, 2)) * [0.1, 0.3]
    features = jax.vmap(linear_features(1).apply)(jnp.float32(context)[:, None])
    found = fit(features, jnp.float32(theta), jnp.ones(4000), ridge=1e-6)
    np.testing.assert_allclose(found.coef, [[5, 0], [2, -1]], atol=0.03)
    np.testing.assert_allclose(found.cov_chol @ found.cov_chol.T, np.diag([0.01, 0.09]), atol=5e-3)


@pytest.mark.parametrize(
    ("num", "degree", "spread"), [(6, 0, 1.0), (8, 2, 0.0), (8, 2, 1.0), (5, 3, 0.3), (30, 4, 1.0)]
)
def test_covariance_is_unbiased_for_few_weighted_samples(num, degree, spread):
    rng = np.random.default_rng(2)
    features = jnp.float32(rng.uniform(1.0, 3.0, size=(num, 1)) ** np.arange(degree + 1))
    weights = jnp.float32(np.exp(spread * rng.normal(size=num)))
    theta = 3.0 + jnp.float32(rng.normal(size=(20_000, num, 1)))
    fitted = jax.jit(jax.vmap(lambda t: fit_weighted_ml(features, t, weights, ridge=0.0)))(theta)
    variances = np.float64(fitted.cov_chol[:, 0, 0]) ** 2
    assert variances.mean() == pytest.approx(1.0, abs=5 * variances.std() / np.sqrt(len(variances)))


def test_normaliser_of_a_constant_alone_is_that_of_equation_15():
    rng = np.random.default_rng(2)
    theta, weights = rng.normal(size=(6, 1)), np.array([4.0, 2.0, 1.0, 1.0, 0.5, 0.5])
    found = fit(jnp.ones((6, 1)), jnp.float32(theta), jnp.float32(weights), ridge=0.0)
    residual = theta[:, 0] - np.average(theta[:, 0], weights=weights)
    normaliser = (weights.sum() ** 2 - (weights**2).sum()) / weights.sum()
    assert found.cov_chol[0, 0] ** 2 == pytest.approx(np.sum(weights * residual**2) / normaliser, rel=1e-5)


def test_a_mean_that_the_ridge_holds_counts_as_a_constant():
    features, theta, weights = data(num=8)
    theta = jnp.float32(np.random.default_rng(4).normal(size=(8, 1)))
    held = fit(features, theta, weights, ridge=1e6)
    constant = fit(jnp.ones((8, 1)), theta, weights, ridge=0.0)
    np.testing.assert_allclose(held.cov_chol, constant.cov_chol, rtol=1e-3)


# Units and zeros.


def polynomial(num=100, degree=3):
    """Return features 1, s, s^2, ..., parameters, weights and a start in float64."""
    rng = np.random.default_rng(5)
    context = rng.uniform(0.5, 1.5, size=num)
    theta = np.column_stack([1 + 2 * context - context**2, 3 * context])
    theta += rng.normal(size=(num, 2)) * [0.1, 0.2]
    start = rng.normal(size=(degree + 1, 2))
    return context[:, None] ** np.arange(degree + 1), theta, rng.exponential(size=num), start


def fitted(features, theta, weights, start=None, scale=None, ridge=1e-3, constant=None):
    """Return the mean at the samples, in float64, and the factor of the covariance."""
    features, theta, weights = map(jnp.float32, (features, theta, weights))
    scale, start, constant = (None if x is None else jnp.float32(x) for x in (scale, start, constant))
    found = fit(features, theta, weights, ridge=ridge, scale=scale, start=start, constant=constant)
    return np.float64(np.float32(features)) @ np.float64(found.coef), np.float64(found.cov_chol)


@pytest.mark.parametrize("has_scale", [False, True], ids=["no scale", "scale"])
@pytest.mark.parametrize("has_start", [False, True], ids=["no start", "start"])
def test_the_unit_of_a_feature_does_not_matter(has_start, has_scale):
    features, theta, weights, start = polynomial()
    start, scale = (start if has_start else None), (np.ones(4) if has_scale else None)
    expected = fitted(features, theta, weights, start, scale)
    for column in range(4):
        for factor in (1e-30, 1e-25, 1e-15, 1e-3, 1e7, 1e15, 1e18, 1e28):
            unit = np.where(np.arange(4) == column, factor, 1.0)
            found = fitted(
                unit * features,
                theta,
                weights,
                None if start is None else start / unit[:, None],
                None if scale is None else scale * unit,
            )
            np.testing.assert_allclose(found[0], expected[0], atol=1e-4, err_msg=f"{column} times {factor}")
            np.testing.assert_allclose(found[1], expected[1], atol=1e-5, err_msg=f"{column} times {factor}")


@pytest.mark.parametrize("unit", [1e-6, 1e3, 1e6, 2e7, 1e10])
def test_the_unit_of_the_context_of_a_polynomial_does_not_matter(unit):
    features, theta, weights, _ = polynomial(degree=2)
    units = unit ** np.arange(3.0)
    expected = fitted(features, theta, weights)
    np.testing.assert_allclose(fitted(units * features, theta, weights)[0], expected[0], atol=1e-4)
    exact = features @ np.array([[1.0, 3.0], [2.0, 0.0], [-1.0, 0.0]])
    np.testing.assert_allclose(fitted(units * features, exact, weights, ridge=0.0)[0], exact, atol=1e-5)


@pytest.mark.parametrize(
    ("constant", "zero"),
    [*(("one", zero) for zero in (1e2, 1e4, 1e5, 1e6)), *(("sum of two", zero) for zero in (1e2, 1e4, 1e5))],
)
def test_the_zero_of_a_feature_does_not_matter(constant, zero):
    features, theta, weights, _ = polynomial()
    kind = np.arange(len(features)) % 3 == 0
    ones = np.ones((len(features), 1)) if constant == "one" else np.column_stack([kind, ~kind])
    stated = np.append(np.ones(ones.shape[1]), 0.0)
    context = np.float64(np.float32(features[:, 1:2] + zero))
    found = fitted(np.column_stack([ones, context]), theta, weights, constant=stated)
    expected = fitted(np.column_stack([ones, context - zero]), theta, weights, constant=stated)
    # Coefficients of this size cannot hold the mean better.
    np.testing.assert_allclose(found[0], expected[0], atol=8 * zero * np.finfo(np.float32).eps)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-4)


@pytest.mark.parametrize("has_start", [False, True], ids=["no start", "start"])
def test_the_unit_and_zero_of_a_parameter_do_not_matter(has_start):
    features, theta, weights, start = polynomial()
    start = start if has_start else np.zeros_like(start)
    expected = fitted(features, theta, weights, start)
    for unit in (1e-30, 1e-15, 1e12):
        units = np.array([unit, 1.0])
        found = fitted(features, theta * units, weights, start * units)
        np.testing.assert_allclose(found[0] / units, expected[0], atol=1e-4)
        np.testing.assert_allclose(found[1] / units[:, None], expected[1], atol=1e-5)
    for zero in (1e2, 1e4, 1e5):
        shifted = np.float64(np.float32(theta + zero))
        from_zero = start + np.array([[zero], [0], [0], [0]])
        found, expected = (
            fitted(features, shifted, weights, from_zero),
            fitted(features, shifted - zero, weights, start),
        )
        np.testing.assert_allclose(found[0] - zero, expected[0], atol=4 * zero * np.finfo(np.float32).eps)
        np.testing.assert_allclose(found[1], expected[1], atol=0.01)


@pytest.mark.parametrize("size", [1e-38, 1e-30, 1e30, 1e37])
def test_coefficients_beyond_the_format_stay_finite(size):
    features, theta, weights, _ = polynomial()
    unit = np.array([1.0, 1.0, 1.0, min(size, 1e29)])
    found = fit(jnp.float32(features * unit), jnp.float32(theta * 1e14), jnp.float32(weights), ridge=0.0)
    assert np.all(np.isfinite(found.coef)) and np.all(np.isfinite(found.cov_chol))
    scale = jnp.full(4, size, jnp.float32)
    held = fit(jnp.float32(features), jnp.float32(theta), jnp.float32(weights), ridge=1e-3, scale=scale)
    assert np.all(np.isfinite(held.coef)) and np.all(np.isfinite(held.cov_chol))


@pytest.mark.parametrize("function", [fit_weighted_ml, fit], ids=["eager", "compiled"])
@pytest.mark.parametrize("largest", [1.2e-37, 1e-30, 1e30, 1e38, 3.4e38])
def test_the_size_of_the_weights_does_not_matter(function, largest):
    features, theta, weights, _ = (jnp.float32(x) for x in polynomial())
    share = weights / weights.max()
    share = jnp.where(share > 0.1, share, 0.0)
    expected = function(features, theta, share, ridge=1e-3)
    found = function(features, theta, share * jnp.float32(largest), ridge=1e-3)
    np.testing.assert_allclose(features @ found.coef, features @ expected.coef, atol=1e-4)
    np.testing.assert_allclose(found.cov_chol, expected.cov_chol, atol=1e-5)


@pytest.mark.parametrize("has_scale", [False, True], ids=["no scale", "scale"])
@pytest.mark.parametrize("num", [4, 12, 100])
@pytest.mark.parametrize(
    "features", [linear_features(2), polynomial_features(2, 2), rbf_features([0, 0], [1, 1], 3)]
)
def test_the_constant_that_features_state_is_found_in_samples_too(features, num, has_scale):
    rng = np.random.default_rng(num)
    rows = features(jnp.float32(rng.uniform(size=(num, 2))))
    theta, weights = rng.normal(size=(num, 2)) + np.array([0.0, 100.0]), rng.exponential(size=num)
    scale = np.ones(features.size) if has_scale else None
    found = fitted(rows, theta, weights, scale=scale)
    stated = fitted(rows, theta, weights, scale=scale, constant=features.constant)
    np.testing.assert_allclose(found[0], stated[0], rtol=1e-6)
    np.testing.assert_allclose(found[1], stated[1], rtol=1e-6)


def test_an_m_step_need_not_take_the_constant():
    given = []

    def plain(policy, samples, *, ridge, scale):
        given.append((ridge, scale))
        return policy

    features = linear_features(1)
    start = start_policy(features, 2)
    samples = WeightedSamples(jnp.ones((3, 2)), jnp.ones((3, 2)), jnp.full(3, 1 / 3), jnp.ones(3, bool))
    assert linear_gaussian(features, m_step=plain, ridge=0.1).fit(start, samples) is start
    assert given == [(0.1, None)]


def test_an_m_step_with_any_settings_gets_the_constant():
    given = []

    def any_settings(policy, samples, **settings):
        given.append(settings)
        return policy

    start = start_policy(linear_features(1), 2)
    samples = WeightedSamples(jnp.ones((3, 2)), jnp.ones((3, 2)), jnp.full(3, 1 / 3), jnp.ones(3, bool))
    linear_gaussian(linear_features(1), m_step=any_settings, ridge=0.1).fit(start, samples)
    assert given[0].keys() == {"ridge", "scale", "constant"}
    np.testing.assert_array_equal(given[0]["constant"], [1.0, 0.0])


@pytest.mark.parametrize("m_step", [weighted_ml, bounded_ml(mean_kl_bound=1e3)], ids=["plain", "bounded"])
@pytest.mark.parametrize("seen", [0.0, 0.3])
def test_a_policy_of_one_context_does_not_extrapolate(seen, m_step):
    """At one context all features are constant: only `FeatureMap.constant` tells which one always is."""
    features = linear_features(1)
    theta = jnp.float32(np.random.default_rng(0).normal(size=(10, 2)) + 5.0)
    kind = linear_gaussian(features, m_step=m_step)
    start = start_policy(features, 2)
    rows = features(jnp.full((10, 1), seen))
    fitted = kind.fit(start, WeightedSamples(rows, theta, jnp.full(10, 0.1), jnp.ones(10, bool)))
    np.testing.assert_allclose(fitted.coef[0], theta.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(fitted.coef[1], 0.0, atol=1e-5)


def test_a_constant_that_the_features_do_not_make_is_refused():
    features, theta, weights, _ = (jnp.float32(x) for x in polynomial(degree=1))
    with pytest.raises(ValueError, match=r"features @ constant - 1 must be at most 0\.001 in size, got 1\.0"):
        fit_weighted_ml(features, theta, weights, ridge=0.0, constant=jnp.array([2.0, 0.0]))


def test_features_and_parameters_beyond_their_limits_are_named():
    features, theta, weights, _ = (jnp.float32(x) for x in polynomial())
    with pytest.raises(ValueError, match=r"theta must be at most 1e\+15 in size, got"):
        fit_weighted_ml(features, theta.at[3].set(1e16), weights, ridge=0.0)
    with pytest.raises(ValueError, match=r"features must be at most 1e\+30 in size, got"):
        fit_weighted_ml(features.at[3].set(1e31), theta, weights, ridge=0.0)


# Gradients.


def total(features, theta, weights, ridge=1e-3, scale=None, start=None):
    """Return a sum of all that a fit returns, each entry counted differently."""
    found = fit_weighted_ml(features, theta, weights, ridge=ridge, scale=scale, start=start)
    sums = [jnp.sum(x * jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape)) for x in found]
    return sums[0] + sums[1]


gradients_of = jax.jit(jax.grad(total, (0, 1, 2)))


@pytest.mark.parametrize("has_scale", [False, True], ids=["no scale", "scale"])
@pytest.mark.parametrize("kind", ["polynomial", "radial", "no constant"])
def test_gradients_are_those_of_finite_differences(kind, has_scale):
    features, theta, weights, start = polynomial(num=12, degree=2)
    rng = np.random.default_rng(6)
    if kind == "radial":
        features = np.exp(-8 * (features[:, 1:2] - [0.5, 1.0, 1.5]) ** 2)
        features /= features.sum(axis=1, keepdims=True)
    if kind == "no constant":
        features = rng.normal(size=(12, 3))
    with jax.enable_x64(True):
        arrays = [jnp.float64(x) for x in (features, theta, weights)]
        settings = {
            "ridge": 0.1,
            "scale": jnp.ones(3, jnp.float64) if has_scale else None,
            "start": jnp.float64(start),
        }
        function = jax.jit(lambda *xs: total(*xs, **settings))
        gradients = jax.jit(jax.grad(function, (0, 1, 2)))(*arrays)
        for position, gradient in enumerate(gradients):
            # The constant stays one, and features that sum to one do so.
            towards = rng.normal(size=gradient.shape)
            if position == 0 and kind != "no constant":
                towards[:, 0] = 0.0 if kind == "polynomial" else -towards[:, 1:].sum(axis=1)
            ends = [
                function(*(x + step * towards if i == position else x for i, x in enumerate(arrays)))
                for step in (1e-6, -1e-6)
            ]
            slope = float(ends[0] - ends[1]) / 2e-6
            assert np.sum(gradient * towards) == pytest.approx(slope, rel=1e-5)


def degenerate(case):
    """Return samples of a kind that a naive derivative of the fit divides by zero for."""
    features, theta, weights, start = polynomial(num=12, degree=2)
    if case == "some weights are zero":
        weights[::3], features[::3], theta[::3] = 0.0, np.nan, np.nan
    elif case == "all weights are zero":
        weights[:] = 0.0
    elif case == "one weight is not zero":
        weights[1:] = 0.0
    elif case == "no residuals":
        theta = np.zeros_like(theta)
    elif case == "residuals of rounding":
        theta = features @ start
    elif case == "parameters are equal":
        theta[:, 1] = theta[:, 0]
    elif case == "eigenvalues are equal":
        features, theta = features[:, :1], np.resize(np.eye(4)[:, :2] - 0.25, (12, 2))
        weights[:] = 1.0
    elif case == "features are equal":
        features[:, 2] = features[:, 1]
    elif case == "features are zero":
        features = np.zeros_like(features)
    return [jnp.float32(x) for x in (features, theta, weights)]


@pytest.mark.parametrize(
    "case",
    [
        "some weights are zero",
        "all weights are zero",
        "one weight is not zero",
        "no residuals",
        "residuals of rounding",
        "parameters are equal",
        "eigenvalues are equal",
        "features are equal",
        "features are zero",
    ],
)
def test_gradients_are_finite_for(case):
    features, theta, weights = degenerate(case)
    for ridge in (0.0, 1e-3):
        for gradient in gradients_of(features, theta, weights, ridge):
            assert np.all(np.isfinite(gradient))
            if case == "some weights are zero":
                assert np.all(gradient[::3] == 0)


# The ridge.


def test_ridge_shrinks_towards_the_weighted_mean():
    features, theta, weights = data()
    centre = np.average(theta, axis=0, weights=weights)
    found = fit(features, theta, weights, ridge=1e6)
    np.testing.assert_allclose(features @ found.coef, np.broadcast_to(centre, theta.shape), rtol=1e-3)


def test_a_policy_is_not_wild_where_there_were_no_contexts(key):
    rbf = rbf_features(0.0, 1.0, 20)
    contexts = jnp.clip(0.5 + 0.1 * jax.random.normal(key, (40, 1)), 0.0, 1.0)
    features = jax.vmap(rbf.apply)(contexts)
    theta = contexts + 0.1 * jax.random.normal(jax.random.key(1), (40, 1))
    found = fit(features, theta, jnp.ones(40), ridge=1e-4, scale=jnp.asarray(rbf.scale))
    everywhere = jax.vmap(rbf.apply)(jnp.linspace(0.0, 1.0, 101)[:, None]) @ found.coef
    assert everywhere.min() > -0.5 and everywhere.max() < 1.5


@pytest.mark.parametrize("seen", [[0.1], [0.1, 0.3]])
def test_a_policy_of_one_or_two_contexts_is_not_wild_elsewhere(seen):
    rbf = rbf_features(0.0, 1.0, 5)
    features = jax.vmap(rbf.apply)(jnp.array(seen * 20)[:, None])
    theta = 1.0 + 0.01 * jax.random.normal(jax.random.key(0), (len(features), 1))
    found = fit(features, theta, jnp.ones(len(features)), ridge=1e-4, scale=jnp.asarray(rbf.scale))
    everywhere = jax.vmap(rbf.apply)(jnp.linspace(0.0, 1.0, 21)[:, None]) @ found.coef
    np.testing.assert_allclose(everywhere, 1.0, atol=0.3)


@pytest.mark.parametrize("shift", [0.0, 100.0])
def test_ridge_does_not_care_for_the_zero_of_the_context(shift, key):
    contexts = jax.random.uniform(key, (200, 1))
    theta = 3.0 * contexts + 0.1 * jax.random.normal(jax.random.key(1), (200, 1))
    features = jnp.concatenate([jnp.ones((200, 1)), contexts + shift], axis=1)
    found = fit(features, theta, jnp.ones(200), ridge=0.5)
    # A ridge of half the variance takes away a third of the slope.
    assert found.coef[1, 0] == pytest.approx(2.0, rel=0.02)
    np.testing.assert_allclose(jnp.mean(features @ found.coef), theta.mean(), atol=2e-3)


def test_samples_without_weight_may_hold_anything():
    features, theta, weights = data()
    hidden = np.arange(300) % 3 == 0
    expected = fit(features, theta, jnp.where(hidden, 0.0, weights), ridge=1e-4)
    found = fit(
        jnp.where(hidden[:, None], jnp.nan, features),
        jnp.where(hidden[:, None], jnp.inf, theta),
        jnp.where(hidden, 0.0, weights),
        ridge=1e-4,
    )
    np.testing.assert_array_equal(found.coef, expected.coef)
    np.testing.assert_array_equal(found.cov_chol, expected.cov_chol)
    coef, cov = fit_in_float64(features[~hidden], theta[~hidden], weights[~hidden])
    assert np.max(np.abs(found.coef - coef) / np.sqrt(np.diag(cov))) < 0.05


@pytest.mark.parametrize("num_weighted", [0, 1, 2, 3, 5, 8])
@pytest.mark.parametrize("ridge", [0.0, 1e-3])
def test_fit_on_few_samples_is_finite_and_usable(num_weighted, ridge, key):
    features, theta, _ = data()
    weights = jnp.where(jnp.arange(300) < num_weighted, 0.25, 0.0)
    found = fit(features, theta, weights, ridge=ridge)
    assert np.all(np.isfinite(found.coef)) and np.all(np.isfinite(found.cov_chol))
    assert np.all(jnp.diagonal(found.cov_chol) > 0)
    assert np.isfinite(entropy(found))
    drawn = sample(key, found, features[0])
    assert np.isfinite(log_prob(found, features[0], drawn))
    if num_weighted:
        # It shrinks to the samples it has: no parameter far from them, where they are.
        scale = np.max(np.abs(theta[:num_weighted]), axis=0)
        assert np.all(np.abs(mean(found, features[0])) < 2 * scale)


def test_equal_parameters_keep_a_small_positive_spread():
    features, theta, weights = data()
    fixed = theta.at[:, 0].set(0.02)
    found = fit(features, fixed, weights, ridge=0.0)
    assert 0 < float(found.cov_chol[0, 0]) < 1e-6
    np.testing.assert_allclose(features @ found.coef[:, :1], 0.02, rtol=1e-5)


def test_vmap_equals_loop():
    features, theta, _ = data()
    weights = jnp.float32(np.random.default_rng(3).exponential(size=(3, 300)))
    together = jax.vmap(lambda w: fit(features, theta, w, ridge=1e-4))(weights)
    for i in range(3):
        alone = fit(features, theta, weights[i], ridge=1e-4)
        np.testing.assert_allclose(together.cov_chol[i], alone.cov_chol, rtol=1e-3, atol=1e-7)
        np.testing.assert_allclose(together.coef[i], alone.coef, rtol=1e-2, atol=1e-5)


# Errors.


def test_bad_shapes_are_named():
    with pytest.raises(ValueError, match=r"features must have shape \(2,\), got \(3,\)"):
        mean(policy(), jnp.ones(3))
    with pytest.raises(ValueError, match=r"theta must have shape \(3,\), got \(2,\)"):
        log_prob(policy(), FEATURES, jnp.ones(2))
    with pytest.raises(ValueError, match=r"coef of the reference must have shape \(2, 3\), got \(2, 2\)"):
        kl(policy(), policy(np.ones((2, 2)), np.eye(2)), FEATURES)
    with pytest.raises(ValueError, match=r"theta must have shape \(4, d\) beside .*, got \(5, 3\)"):
        fit_weighted_ml(jnp.ones((4, 2)), jnp.ones((5, 3)), jnp.ones(5), ridge=0.0)


@pytest.mark.parametrize(
    "features", [linear_features(2), polynomial_features(2, 3), rbf_features([0, 0], [1, 1], (2, 3))]
)
def test_a_start_policy_is_the_same_for_every_context(features, key):
    policy = start_policy(features, 3, mean=(1.0, -2.0, 0.5), std=0.1)
    contexts = jax.random.normal(key, (20, 2))
    means = features(contexts) @ policy.coef
    np.testing.assert_allclose(means, np.tile([1.0, -2.0, 0.5], (20, 1)), rtol=1e-5)
    np.testing.assert_allclose(policy.cov_chol, 0.1 * np.eye(3), rtol=1e-6)
    assert policy.coef.dtype == policy.cov_chol.dtype == jnp.float32


@pytest.mark.parametrize(
    ("features", "settings", "match"),
    [
        (linear_features(1), {"mean": (1.0, 2.0, 3.0)}, r"mean must be .* 2 parameters, got shape \(3,\)"),
        (linear_features(1), {"std": 0.0}, "std must be above zero, got 0"),
        (
            quadratic_features(1),
            {"mean": 1.0},
            "mean must be zero for features that cannot express",
        ),
    ],
)
def test_a_start_policy_that_cannot_be_is_refused(features, settings, match):
    with pytest.raises(ValueError, match=match):
        start_policy(features, 2, **settings)
