"""The bounded fit keeps its bounds, is the best within them, and knows no units."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from creps_jax.policies import gaussian
from creps_jax.policies.features import rbf_features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.search.fit import WeightedSamples, bounded_ml, weighted_ml

RIDGE = 1e-8


def make_problem(key, num=60, dim=4, context_dim=1, greed=2.0):
    """Return an old policy, and samples of it whose weights prefer some of them."""
    keys = jax.random.split(key, 4)
    contexts = jax.random.uniform(keys[0], (num, context_dim), minval=1.0, maxval=2.0)
    features = jnp.concatenate([jnp.ones((num, 1)), contexts], axis=1)
    coef = jax.random.normal(keys[1], (1 + context_dim, dim))
    cov_chol = jnp.linalg.cholesky(0.5 * jnp.eye(dim) + 0.5) * jnp.linspace(0.1, 3.0, dim)[:, None]
    policy = LinearGaussian(coef, cov_chol)
    theta = features @ coef + jax.random.normal(keys[2], (num, dim)) @ cov_chol.T
    weights = jax.nn.softmax(greed * (theta[:, 0] / 0.1 + jax.random.normal(keys[3], (num,))))
    return policy, WeightedSamples(features, theta, weights, jnp.ones(num, bool))


def parts(new, old, samples):
    """Return the mean's and the covariance's part of the relative entropy, by the book, in float64."""
    inverse = np.linalg.inv(np.asarray(old.cov_chol, float))
    shift = np.asarray(samples.features, float) @ np.asarray(new.coef - old.coef, float)
    mean = 0.5 * np.sum((shift @ inverse.T) ** 2, axis=1)[np.asarray(samples.is_valid)].mean()
    ratio = inverse @ np.asarray(new.cov_chol, float)
    change = ratio @ ratio.T
    return mean, 0.5 * (np.trace(change) - len(change) - np.linalg.slogdet(change)[1])


def bounded_mean(policy, samples, kl_bound):
    """Return the coefficients within the bound, and Z of their residuals, by normal equations in float64."""
    features, theta, d = (np.asarray(x, float) for x in samples[:3])
    old, inverse = np.asarray(policy.coef, float), np.linalg.inv(np.asarray(policy.cov_chol, float))
    d = d / d.sum()
    gram, everywhere = features.T @ (d[:, None] * features), features.T @ features / len(features)

    def operator(log_multiplier):
        return np.linalg.solve(gram + np.exp(log_multiplier) * everywhere, features.T * d)

    def kl(log_multiplier):
        shift = features @ operator(log_multiplier) @ (theta - features @ old) @ inverse.T
        return 0.5 * np.sum(shift**2) / len(features)

    least = -30.0 if kl(-30.0) < kl_bound else optimize.brentq(lambda x: kl(x) - kl_bound, -30.0, 40.0)
    left = np.eye(len(d)) - features @ operator(least)
    return old + operator(least) @ (theta - features @ old), np.sum(d[:, None] * left**2)


@pytest.mark.parametrize("bounds", [(1.0, 0.05), (0.1, 0.5), (1e-3, 1e-3)])
@pytest.mark.parametrize("num", [8, 60, 2000], ids="{} samples".format)
def test_active_bounds_are_met_to_a_percent(key, num, bounds):
    policy, samples = make_problem(key, num)
    new = jax.jit(bounded_ml(mean_kl_bound=bounds[0], cov_kl_bound=bounds[1]))(policy, samples, ridge=RIDGE)
    np.testing.assert_allclose(parts(new, policy, samples), bounds, rtol=0.01)
    total = jax.vmap(gaussian.kl, (None, None, 0))(new, policy, samples.features).mean()
    assert total == pytest.approx(sum(bounds), rel=0.01)


def test_bounds_out_of_reach_change_nothing(key):
    policy, samples = make_problem(key)
    new = bounded_ml(mean_kl_bound=1e3, cov_kl_bound=1e3)(policy, samples, ridge=RIDGE)
    likeliest = weighted_ml(policy, samples, ridge=RIDGE)
    np.testing.assert_allclose(new.coef, likeliest.coef, rtol=5e-3, atol=5e-3)
    np.testing.assert_allclose(new.cov_chol, likeliest.cov_chol, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("entropy_loss", [None, 0.01, 0.001])
def test_nothing_likelier_is_within_the_bounds(key, entropy_loss):
    policy, samples = make_problem(key, num=200, dim=2, greed=2.0)
    bounds = 1.0, 0.1
    m_step = bounded_ml(mean_kl_bound=bounds[0], cov_kl_bound=bounds[1], entropy_loss_bound=entropy_loss)
    new = m_step(policy, samples, ridge=RIDGE)
    features, theta, weights = (np.asarray(x, float) for x in samples[:3])
    inverse = np.linalg.inv(np.asarray(policy.cov_chol, float))
    start = np.ravel(policy.coef).astype(float)

    def mean_cost(flat):
        residual = (theta - features @ flat.reshape(2, 2)) @ inverse.T
        return weights @ np.sum(residual**2, axis=1)

    def mean_room(flat):
        shift = features @ (flat - start).reshape(2, 2) @ inverse.T
        return bounds[0] - 0.5 * np.mean(np.sum(shift**2, axis=1))

    limit = {"type": "ineq", "fun": mean_room}
    best = optimize.minimize(mean_cost, start, method="SLSQP", constraints=limit, options={"maxiter": 500}).x
    np.testing.assert_allclose(np.ravel(new.coef), best, rtol=0.01, atol=0.01)

    residual = theta - features @ np.asarray(new.coef, float)
    scatter = (residual.T * weights) @ residual / bounded_mean(policy, samples, bounds[0])[1]

    def factor(flat):
        return np.array([[np.exp(flat[0]), 0.0], [flat[1], np.exp(flat[2])]])

    def cov_cost(flat):
        cov = factor(flat) @ factor(flat).T
        return np.linalg.slogdet(cov)[1] + np.trace(np.linalg.solve(cov, scatter))

    old = np.asarray(policy.cov_chol, float)
    start = [np.log(old[0, 0]), old[1, 0], np.log(old[1, 1])]

    def cov_room(flat):
        return bounds[1] - parts(policy._replace(cov_chol=factor(flat)), policy, samples)[1]

    def entropy_room(flat):
        return (entropy_loss or np.inf) + flat[0] + flat[2] - start[0] - start[2]

    rooms = [cov_room] if entropy_loss is None else [cov_room, entropy_room]
    limits = [{"type": "ineq", "fun": room} for room in rooms]
    best = optimize.minimize(cov_cost, start, method="SLSQP", constraints=limits).x
    np.testing.assert_allclose(new.cov_chol, factor(best), rtol=0.01, atol=0.01)
    if entropy_loss is not None:
        # Without that bound more entropy is lost: it is this one that holds.
        assert gaussian.entropy(policy) - gaussian.entropy(new) == pytest.approx(entropy_loss, rel=0.01)


@pytest.mark.parametrize(("unit", "zero"), [(1e-4, 0.0), (1e4, 0.0), (1.0, 300.0)])
def test_an_active_bound_does_not_know_the_units_of_the_context(key, unit, zero):
    policy, samples = make_problem(key)
    contexts = samples.features[:, 1]
    change = np.array([[1.0, zero], [0.0, unit]])
    other_policy = policy._replace(coef=jnp.float32(np.linalg.solve(change, np.float64(policy.coef))))
    features = jnp.stack([jnp.ones(60), unit * contexts + zero], axis=1)
    other = bounded_ml()(other_policy, samples._replace(features=features), ridge=RIDGE)
    new = bounded_ml()(policy, samples, ridge=RIDGE)
    spread = np.linalg.norm(policy.cov_chol, axis=1)
    means = np.float64(samples.features) @ np.float64(new.coef)
    np.testing.assert_allclose(
        (np.float64(features) @ np.float64(other.coef) - means) / spread, 0.0, atol=0.03
    )


@pytest.mark.parametrize("kl_bound", [1e-8, 0.02, 0.3, 1e4])
def test_the_covariance_counts_the_features_as_far_as_the_mean_follows_them(key, kl_bound):
    policy, samples = make_problem(key, num=12, dim=2, context_dim=2, greed=0.2)
    m_step = bounded_ml(mean_kl_bound=kl_bound, cov_kl_bound=1e4)
    new = jax.jit(m_step)(policy, samples, ridge=0.0)
    coef, normaliser = bounded_mean(policy, samples, kl_bound)
    features, theta, weights = (np.asarray(x, float) for x in samples[:3])
    residual = theta - features @ coef
    scatter = (residual.T * weights) @ residual / normaliser
    np.testing.assert_allclose(new.coef, coef, rtol=0.01, atol=0.01)
    np.testing.assert_allclose(new.cov_chol @ new.cov_chol.T, scatter, rtol=0.02, atol=1e-3)


@pytest.mark.parametrize("kl_bound", [1e-8, 1e4], ids=["held", "free"])
@pytest.mark.parametrize(("num", "degree", "spread"), [(8, 2, 0.0), (8, 2, 1.0), (30, 4, 1.0)])
def test_the_covariance_is_unbiased_for_few_weighted_samples(num, degree, spread, kl_bound):
    rng = np.random.default_rng(2)
    features = jnp.float32(rng.uniform(1.0, 3.0, size=(num, 1)) ** np.arange(degree + 1))
    weights = np.exp(spread * rng.normal(size=num))
    policy = LinearGaussian(jnp.zeros((degree + 1, 1)), jnp.eye(1))
    m_step = bounded_ml(mean_kl_bound=kl_bound, cov_kl_bound=1e4)

    def variance(theta):
        samples = WeightedSamples(features, theta, jnp.float32(weights / weights.sum()), jnp.ones(num, bool))
        return m_step(policy, samples, ridge=0.0).cov_chol[0, 0] ** 2

    variances = np.float64(jax.jit(jax.vmap(variance))(jnp.float32(rng.normal(size=(10_000, num, 1)))))
    assert variances.mean() == pytest.approx(1.0, abs=5 * variances.std() / np.sqrt(len(variances)))


def converted(policy, samples, m_step, unit, zero=0.0):
    """Return what an M-step makes of features in other units: the mean at the samples, and the covariance.

    Features are a constant and powers of the context, which counts from another zero.
    """
    unit = np.asarray(unit)
    features = np.asarray(samples.features, float)
    coef = np.asarray(policy.coef, float)
    change = np.eye(len(unit))
    change[0, 1] = zero
    features = np.float64(np.float32(features @ change * unit))
    other = policy._replace(coef=jnp.float32(np.linalg.solve(change, coef) / unit[:, None]))
    new = m_step(other, samples._replace(features=jnp.float32(features)), ridge=1e-3)
    return features @ np.asarray(new.coef, float), np.asarray(new.cov_chol)


@pytest.mark.parametrize("mean_kl_bound", [0.3, 1e4])
def test_the_unit_and_zero_of_a_feature_do_not_matter(key, mean_kl_bound):
    policy, samples = make_problem(key, context_dim=2, greed=0.5)
    m_step = jax.jit(bounded_ml(mean_kl_bound=mean_kl_bound))
    mean, cov_chol = converted(policy, samples, m_step, np.ones(3))
    spread = np.linalg.norm(cov_chol, axis=1)
    for column in range(3):
        for factor in (1e-25, 1e-15, 1e-3, 1e7, 1e15, 1e25):
            unit = np.where(np.arange(3) == column, factor, 1.0)
            found = converted(policy, samples, m_step, unit)
            np.testing.assert_allclose((found[0] - mean) / spread, 0.0, atol=2e-3)
            np.testing.assert_allclose((found[1] - cov_chol) / spread[:, None], 0.0, atol=1e-3)
    for zero in (1e2, 1e4):
        found = converted(policy, samples, m_step, np.ones(3), zero)
        np.testing.assert_allclose((found[0] - mean) / spread, 0.0, atol=1e-4 * zero + 1e-3)
        # The context itself is rounded.
        np.testing.assert_allclose((found[1] - cov_chol) / spread[:, None], 0.0, atol=2e-6 * zero + 1e-3)


@pytest.mark.parametrize("unit", [1e-30, 1e-15, 1e12])
def test_the_unit_of_a_parameter_does_not_matter(key, unit):
    policy, samples = make_problem(key)
    new = bounded_ml()(policy, samples, ridge=1e-3)
    units = np.array([unit, 1.0, 1.0, 1.0], np.float32)
    other_policy = LinearGaussian(policy.coef * units[None, :], policy.cov_chol * units[:, None])
    other = bounded_ml()(other_policy, samples._replace(theta=samples.theta * units[None, :]), ridge=1e-3)
    np.testing.assert_allclose(other.coef / units[None, :], new.coef, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(other.cov_chol / units[:, None], new.cov_chol, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("distance", [1.0, 1e3])
def test_bounds_hold_for_one_sample_with_all_the_weight_and_for_samples_far_away(key, distance):
    policy, samples = make_problem(key)
    alone = samples._replace(weights=jnp.zeros(60).at[3].set(1.0), theta=distance * samples.theta)
    new = bounded_ml(mean_kl_bound=0.1, cov_kl_bound=0.05)(policy, alone, ridge=RIDGE)
    mean, cov = parts(new, policy, alone)
    assert mean <= 0.1 * 1.01 and cov <= 0.05 * 1.01


@pytest.mark.parametrize("high", [0.9, 0.8, 0.6])
@pytest.mark.parametrize("mean_kl_bound", [1.0, 0.1, 1e-3])
@pytest.mark.parametrize("x64", [False, True])
def test_where_no_context_has_been_the_mean_moves_no_farther_than_without_a_bound(
    key, high, mean_kl_bound, x64
):
    """The bound does not see these contexts: only the ridge holds the radial basis functions there."""
    with jax.enable_x64(x64):
        features = rbf_features(0.0, 1.0, 20)
        scale = jnp.asarray(features.scale)
        keys = jax.random.split(key, 3)
        contexts = jax.random.uniform(keys[0], (60, 1), maxval=high)
        old = LinearGaussian(jnp.zeros((20, 2)), jnp.eye(2))
        theta = jax.random.normal(keys[1], (60, 2))
        weights = jax.nn.softmax(-jnp.sum((theta - contexts) ** 2, axis=1))
        samples = WeightedSamples(jax.vmap(features.apply)(contexts), theta, weights, jnp.ones(60, bool))
        free = weighted_ml(old, samples, ridge=1e-4, scale=scale)
        bounded = bounded_ml(mean_kl_bound=mean_kl_bound)(old, samples, ridge=1e-4, scale=scale)
        assert np.abs(bounded.coef).max() < 1.2 * np.abs(free.coef).max()
        assert parts(bounded, old, samples)[0] < 1.01 * mean_kl_bound


@pytest.mark.parametrize(("mean", "spread"), [(1e6, 0.1), (1e5, 0.01), (1.0, 1e-9)])
def test_bounds_hold_for_a_spread_below_the_rounding_of_theta(key, mean, spread):
    theta = jnp.float32(mean) + spread * jax.random.normal(key, (50, 1))
    samples = WeightedSamples(jnp.ones((50, 1)), theta, jnp.full(50, 0.02), jnp.ones(50, bool))
    old = LinearGaussian(jnp.full((1, 1), mean), jnp.full((1, 1), spread))
    new = bounded_ml(mean_kl_bound=1.0, cov_kl_bound=0.05)(old, samples, ridge=1e-4)
    mean_part, cov_part = parts(new, old, samples)
    assert mean_part < 1.01 and cov_part < 0.051


def test_a_covariance_does_not_shrink_to_nothing_nor_without_samples(key):
    policy, samples = make_problem(key)
    same = samples._replace(theta=jnp.ones((60, 4)))
    # Compiled once, or each of the many updates would be.
    update = jax.jit(partial(bounded_ml(cov_kl_bound=2.0), ridge=RIDGE))
    for _ in range(300):
        policy = update(policy, same)
    assert (jnp.diagonal(policy.cov_chol) > 0).all()
    new = bounded_ml()(policy, samples._replace(weights=jnp.zeros(60)), ridge=RIDGE)
    np.testing.assert_array_equal(new.cov_chol, policy.cov_chol)


@pytest.mark.parametrize("m_step", [weighted_ml, bounded_ml()], ids=["weighted_ml", "bounded_ml"])
def test_units_of_parameters_and_contexts_do_not_matter(key, m_step):
    policy, samples = make_problem(key)
    new = m_step(policy, samples, ridge=1e-4)
    # Parameters in other units and from other zeros; a context in another unit and from another zero.
    unit, zero = np.array([1e-3, 1.0, 50.0, 1e3]), np.array([1.0, -3.0, 0.0, 50.0])
    change = np.array([[1.0, 2.0], [0.0, 0.1]])

    def converted(coef):
        return np.linalg.solve(change, np.asarray(coef, float) * unit + np.array([[1.0], [0.0]]) * zero)

    other_policy = LinearGaussian(
        jnp.float32(converted(policy.coef)), jnp.float32(unit[:, None] * np.asarray(policy.cov_chol))
    )
    other = m_step(
        other_policy,
        samples._replace(
            features=jnp.float32(np.asarray(samples.features) @ change),
            theta=jnp.float32(np.asarray(samples.theta) * unit + zero),
        ),
        ridge=1e-4,
    )
    cov_chol = unit[:, None] * np.asarray(new.cov_chol)
    spread = np.linalg.norm(cov_chol, axis=1)
    np.testing.assert_allclose(other.cov_chol / spread[:, None], cov_chol / spread[:, None], atol=0.01)
    shift = np.asarray(samples.features) @ (change @ np.asarray(other.coef) - change @ converted(new.coef))
    np.testing.assert_allclose(shift / spread, 0.0, atol=0.02)


def test_what_does_not_count_is_not_looked_at(key):
    policy, samples = make_problem(key)
    m_step = bounded_ml()
    alone = m_step(policy, samples, ridge=RIDGE)
    junk = jnp.full((5, 4), jnp.nan)
    padded = WeightedSamples(
        jnp.concatenate([samples.features, junk[:, :2]]),
        jnp.concatenate([samples.theta, junk]),
        jnp.concatenate([samples.weights, jnp.zeros(5)]),
        jnp.concatenate([samples.is_valid, jnp.ones(5, bool)]),
    )
    for left, right in zip(alone, m_step(policy, padded, ridge=RIDGE), strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("m_step", [weighted_ml, bounded_ml()], ids=["weighted_ml", "bounded_ml"])
def test_a_ridge_does_not_wear_a_good_policy_down(key, m_step):
    policy, samples = make_problem(key, num=200)
    policy = policy._replace(cov_chol=1e-3 * policy.cov_chol)
    good, m_step = policy, jax.jit(partial(m_step, ridge=0.1))
    for update in range(30):
        noise = jax.random.normal(jax.random.fold_in(key, update), (200, 4)) @ policy.cov_chol.T
        theta = samples.features @ policy.coef + noise
        same = samples._replace(theta=theta, weights=jnp.full(200, 1 / 200))
        policy = m_step(policy, same)
    # A tenth of the slope in each of 30 updates would leave nothing; the noise moves it by far less.
    np.testing.assert_allclose(policy.coef, good.coef, atol=0.02 * float(jnp.abs(good.coef).max()))


@pytest.mark.parametrize("bounds", [(0.0, 0.1), (1.0, -1.0), (1.0, float("nan"))])
def test_bounds_have_to_be_positive(bounds):
    with pytest.raises(ValueError, match=r"_kl_bound must be finite.*, got"):
        bounded_ml(mean_kl_bound=bounds[0], cov_kl_bound=bounds[1])


def test_the_bound_on_entropy_has_to_be_positive():
    with pytest.raises(ValueError, match=r"entropy_loss_bound must be finite and above 0, got -1.0"):
        bounded_ml(entropy_loss_bound=-1.0)
