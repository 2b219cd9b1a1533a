"""The policy is the Gaussian it says, and its fit is the weighted maximum likelihood of Eq. 14 and 15."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from creps_jax.features import linear_features, rbf_features
from creps_jax.policy import LinearGaussian, entropy, fit_weighted_ml, kl, log_prob, mean, sample

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
    """Return coefficients and covariance of Eq. 14 and 15, written down plainly."""
    features, theta, d = (np.asarray(array, np.float64) for array in (features, theta, weights))
    gram = features.T @ np.diag(d) @ features
    coef = np.linalg.solve(gram, features.T @ np.diag(d) @ theta)
    residual = theta - features @ coef
    normaliser = (d.sum() ** 2 - (d**2).sum()) / d.sum()
    return coef, residual.T @ np.diag(d) @ residual / normaliser


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
    likeliest = found._replace(cov_chol=found.cov_chol * jnp.sqrt(1 - jnp.sum(share**2)))

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


def test_covariance_is_unbiased_for_few_weighted_samples():
    # Without features but a constant, Z of Eq. 15 makes the covariance unbiased whatever the weights.
    rng = np.random.default_rng(2)
    theta = jnp.float32(rng.normal(size=(4000, 6, 1)))
    weights = jnp.array([4.0, 2.0, 1.0, 1.0, 0.5, 0.5])
    fitted = jax.vmap(lambda t: fit(jnp.ones((6, 1)), t, weights, ridge=0.0))(theta)
    assert np.mean(np.float64(fitted.cov_chol) ** 2) == pytest.approx(1.0, abs=0.06)


def test_fit_does_not_depend_on_the_units_of_parameters_weights_or_features():
    features, theta, weights = data()
    plain = fit(features, theta, weights, ridge=1e-3)
    units = jnp.array([1e6, 1e-5])
    scaled = fit(8.0 * features, theta * units[None, :], 1e3 * weights, ridge=1e-3)
    np.testing.assert_allclose(8.0 * scaled.coef / units[None, :], plain.coef, rtol=1e-3)
    np.testing.assert_allclose(scaled.cov_chol / units[:, None], plain.cov_chol, rtol=1e-2)


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
    with pytest.raises(ValueError, match=r"features have to have shape \(2,\), got \(3,\)"):
        mean(policy(), jnp.ones(3))
    with pytest.raises(ValueError, match=r"theta has to have shape \(3,\), got \(2,\)"):
        log_prob(policy(), FEATURES, jnp.ones(2))
    with pytest.raises(ValueError, match=r"differ in shape: \(2, 3\) and \(2, 2\)"):
        kl(policy(), policy(np.ones((2, 2)), np.eye(2)), FEATURES)
    with pytest.raises(ValueError, match=r"theta must have shape \(4, d\) beside .*, got \(5, 3\)"):
        fit_weighted_ml(jnp.ones((4, 2)), jnp.ones((5, 3)), jnp.ones(5), ridge=0.0)
