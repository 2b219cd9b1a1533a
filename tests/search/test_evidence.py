"""The covariance moves on evidence: the test keeps its level, the spread stays in noise, signals are seen."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from creps_jax.policies.features import linear_features, rbf_features
from creps_jax.policies.gaussian import LinearGaussian, blended_cov_chol
from creps_jax.search.archive import Batch
from creps_jax.search.creps import creps
from creps_jax.search.evidence import _f_survival, independence_p_value, share_of_evidence
from creps_jax.search.fit import bounded_ml, weighted_ml


def samples(key, num, dim, gain=0.0):
    """Return features, parameters, and weights that depend on the first parameter as `gain` says."""
    keys = jax.random.split(key, 3)
    features = jnp.concatenate([jnp.ones((num, 1)), jax.random.uniform(keys[0], (num, 2))], axis=1)
    theta = jax.random.normal(keys[1], (num, dim))
    weights = jax.nn.softmax(gain * theta[:, 0] + jax.random.normal(keys[2], (num,)))
    return features, theta, weights


@pytest.mark.parametrize(("num", "dim"), [(8, 3), (30, 3), (60, 10), (200, 20)])
def test_noise_is_significant_no_more_often_than_it_says(num, dim):
    @jax.jit
    @jax.vmap
    def p_value(key):
        features, theta, weights = samples(key, num, dim)
        return independence_p_value(weights, jnp.ones(num), features, theta)

    p_values = np.asarray(p_value(jax.random.split(jax.random.key(0), 400)))
    for level in (0.05, 0.1, 0.2):
        assert (p_values < level).mean() < 1.4 * level + 0.03


@pytest.mark.parametrize("gain", [1.0, 3.0])
def test_a_signal_is_significant(key, gain):
    features, theta, weights = samples(key, 200, 5, gain)
    prior = jnp.ones(200)
    assert independence_p_value(weights, prior, features, theta) < 1e-3
    # So is one that narrows: weights that prefer parameters near the mean.
    narrow = jax.nn.softmax(-gain * jnp.sum(theta**2, axis=1))
    assert independence_p_value(narrow, prior, features, theta) < 1e-3


@pytest.mark.parametrize("size", [1e-24, 1.0, 1e22])
def test_units_and_dependent_columns_do_not_change_the_p_value(key, size):
    features, theta, weights = samples(key, 60, 3, 0.3)
    prior = jnp.ones(60)
    plain = independence_p_value(weights, prior, features, theta)
    units = jnp.array([[1e-6, 1.0, 1e6]]) * size
    other = independence_p_value(weights, 7.0 * prior, features * units, theta * units + 3.0 * units)
    np.testing.assert_allclose(other, plain, rtol=0.02)
    again = jnp.concatenate([theta, theta[:, :1], jnp.ones((60, 1))], axis=1)
    np.testing.assert_allclose(independence_p_value(weights, prior, features, again), plain, rtol=0.02)


@pytest.mark.parametrize("offset", [0.0, 30.0, 1e4])
@pytest.mark.parametrize("slope", [0.0, 1.0, 100.0])
def test_neither_offsets_nor_means_that_follow_the_context_change_the_p_value(key, offset, slope):
    features, theta, weights = samples(key, 100, 4, 0.3)
    prior = jnp.ones(100)
    plain = independence_p_value(weights, prior, features, theta)
    moved = theta + offset + slope * features[:, 1:2]
    np.testing.assert_allclose(
        independence_p_value(weights, prior, features + offset, moved), plain, rtol=0.1
    )


@pytest.mark.parametrize("value", [1.0, 0.1, 3e7])
@pytest.mark.parametrize("num", [10, 30, 1000])
def test_a_constant_feature_is_no_further_one_however_weights_round(key, value, num):
    features, theta, weights = samples(key, num, 3, 0.3)
    constant = jnp.full((num, 1), value)
    plain = independence_p_value(weights, jnp.ones(num), features[:, 1:], theta)
    for noise in (0.0, 1e-7):
        prior = 1.0 / num + noise * jax.random.uniform(key, (num,))
        both = jnp.concatenate([constant, features[:, 1:]], axis=1)
        for test in (independence_p_value, jax.jit(independence_p_value)):
            np.testing.assert_allclose(test(weights, prior, both, theta), plain, rtol=0.02, atol=1e-9)


@pytest.mark.parametrize("spread", [1e-1, 1e-3, 1e-6, 0.0])
def test_nearly_dependent_parameters_leave_the_others_to_be_tested(key, spread):
    features, theta, weights = samples(key, 200, 3, 1.0)
    nearly = theta.at[:, 2].set(theta[:, 1] + spread * theta[:, 2])
    assert independence_p_value(weights, jnp.ones(200), features, nearly) < 1e-3
    noise = jax.random.permutation(key, weights)
    assert independence_p_value(noise, jnp.ones(200), features, nearly) > 1e-3


@pytest.mark.parametrize("num", [0, 1, 2, 6])
def test_too_few_samples_are_no_evidence(key, num):
    features, theta, weights = samples(key, 20, 3, 5.0)
    prior = (jnp.arange(20) < num).astype(jnp.float32)
    assert independence_p_value(jnp.where(prior > 0, weights, 0.0), prior, features, theta) == 1.0


def test_the_survival_function_is_that_of_the_f_distribution():
    for num, rest in ((1, 30), (3, 8), (10, 20), (20, 176), (1, 500)):
        r_squared = np.linspace(0.01, 0.9, 50)
        expected = stats.f.sf(r_squared / num / ((1 - r_squared) / rest), num, rest)
        survival = jax.vmap(_f_survival, (0, None, None))
        found = survival(jnp.float32(r_squared), jnp.float32(num), jnp.float32(rest))
        np.testing.assert_allclose(found, expected, atol=0.01)


def test_the_blend_is_one_of_covariances(key):
    old, new = jnp.linalg.cholesky(jnp.eye(3) + 0.5), jnp.diag(jnp.array([0.1, 2.0, 1.0]))
    for share in (0.0, 0.3, 1.0):
        blend = blended_cov_chol(old, new, share)
        np.testing.assert_allclose(
            blend @ blend.T, (1 - share) * old @ old.T + share * new @ new.T, atol=1e-5
        )
        assert np.all(np.diagonal(blend) > 0) and np.allclose(blend, np.tril(blend))
    np.testing.assert_array_equal(blended_cov_chol(old, new, 0.0), old)
    np.testing.assert_array_equal(blended_cov_chol(old, new, 1.0), new)
    for p_value, share in ((0.0, 1.0), (0.05, 0.5), (0.1, 0.0), (1.0, 0.0)):
        assert share_of_evidence(p_value, 0.1) == pytest.approx(share, abs=1e-6)


@pytest.mark.parametrize("m_step", [weighted_ml, bounded_ml()], ids=["weighted_ml", "bounded_ml"])
@pytest.mark.parametrize(("archive_size", "num_features"), [(100, 3), (30, 3), (12, 3)])
def test_the_spread_stays_in_pure_noise(m_step, archive_size, num_features):
    dim, num = 3, 10
    features = rbf_features(0.0, 1.0, num_features)
    algorithm = creps(features, features, archive_size=archive_size, m_step=m_step)
    state = algorithm.init(LinearGaussian(jnp.zeros((num_features, dim)), jnp.eye(dim)))

    @jax.jit
    def search(state, key):
        def step(state, key):
            keys = jax.random.split(key, 3)
            contexts = jax.random.uniform(keys[0], (num, 1))
            thetas = algorithm.ask(keys[1], state, contexts)
            return algorithm.tell(state, Batch(contexts, thetas, jax.random.normal(keys[2], (num,))))

        return jax.lax.scan(step, state, jax.random.split(key, 150))

    last, _ = search(state, jax.random.key(0))
    assert np.log(np.diagonal(last.policy.cov_chol)).mean() > -1.0


@pytest.mark.parametrize("significance", [None, 0.1])
def test_a_figure_estimates_what_is_lost_by_chance(significance):
    dim, num, searches = 3, 10, 12
    features = linear_features(1)
    algorithm = creps(features, features, archive_size=20, significance=significance)
    state = algorithm.init(LinearGaussian(jnp.zeros((2, dim)), jnp.eye(dim)))

    def step(state, key):
        keys = jax.random.split(key, 3)
        contexts = jax.random.uniform(keys[0], (num, 1))
        batch = Batch(contexts, algorithm.ask(keys[1], state, contexts), jax.random.normal(keys[2], (num,)))
        new, info = algorithm.tell(state, batch)
        return new, (state.policy.cov_chol, new.policy.cov_chol, info.unsupported_loss)

    keys = jax.random.split(jax.random.key(1), (searches, 40))
    old, new, estimate = jax.jit(jax.vmap(lambda keys: jax.lax.scan(step, state, keys)[1]))(keys)
    entropies = [np.log(np.diagonal(chol, axis1=-2, axis2=-1)).sum(-1) for chol in (old, new)]
    lost = np.maximum(entropies[0] - entropies[1], 0.0).sum()
    assert lost > 1.0
    assert 0.4 < float(estimate.sum()) / lost < 2.0


@pytest.mark.parametrize("hits", [3, 6])
def test_few_samples_that_lie_close_to_each_other_are_evidence(key, hits):
    features, theta, _ = samples(key, 200, 2)
    is_hit = jnp.arange(200) < hits
    weights = jax.nn.softmax(jnp.where(is_hit, 4.0, 0.0))
    close = jnp.where(is_hit[:, None], 0.05 * theta, theta)
    assert independence_p_value(weights, jnp.ones(200), features[:, :1], close) < 0.05


def test_one_parameter_that_narrows_among_many_is_evidence(key):
    features, theta, _ = samples(key, 400, 20)
    weights = jax.nn.softmax(-0.7 * theta[:, 7] ** 2)
    assert independence_p_value(weights, jnp.ones(400), features, theta) < 1e-3


@pytest.mark.parametrize("kind", ["few hits", "uneven prior"])
def test_uneven_weights_are_significant_little_more_often_than_it_says(kind):
    @jax.jit
    @jax.vmap
    def p_value(key):
        features, theta, _ = samples(key, 100, 4)
        keys = jax.random.split(key, 2)
        if kind == "few hits":
            return independence_p_value(
                jax.nn.softmax(jnp.where(jnp.arange(100) < 3, 4.0, 0.0)), jnp.ones(100), features, theta
            )
        prior = jax.nn.softmax(jax.random.normal(keys[0], (100,)))
        weights = jax.nn.softmax(jnp.log(prior) + jax.random.normal(keys[1], (100,)))
        return independence_p_value(weights, prior, features, theta)

    p_values = np.asarray(p_value(jax.random.split(jax.random.key(0), 400)))
    assert (p_values < 0.1).mean() < 0.16
    assert np.clip(1.0 - p_values / 0.1, 0.0, 1.0).mean() < 0.1


@pytest.mark.parametrize("significance", [0.0, -0.1, 1.5, float("nan")])
def test_significance_is_a_probability(significance):
    with pytest.raises(ValueError, match="significance must be"):
        creps(linear_features(1), linear_features(1), archive_size=10, significance=significance)
