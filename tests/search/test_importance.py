"""Importance weights: SciPy's densities as oracle, the mean under a policy from samples of others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from creps_jax.policies.features import linear_features
from creps_jax.policies.gaussian import LinearGaussian, linear_gaussian
from creps_jax.search.archive import Batch
from creps_jax.search.creps import creps
from creps_jax.search.fit import weighted_ml
from creps_jax.search.importance import Importance, empty_history, importance_weights, remember

FEATURES = linear_features(1)
GAUSSIAN = linear_gaussian(FEATURES, m_step=weighted_ml)
NUM_EACH, NUM_POLICIES, DIM = 40, 3, 2
SETTINGS = {"archive_size": 200}
WEIGHTED = creps(FEATURES, FEATURES, importance=Importance(NUM_POLICIES), **SETTINGS)
PLAIN = creps(FEATURES, FEATURES, **SETTINGS)


def policies():
    """Return three policies that drift and narrow, as those of a search do."""
    rng = np.random.default_rng(0)
    for number in range(NUM_POLICIES):
        coef = np.array([[0.5 * number, -0.3 * number], [0.2, 0.1 * number]])
        chol = np.tril(rng.normal(size=(DIM, DIM)), -1) * 0.1 + 0.9**number * np.eye(DIM)
        yield LinearGaussian(jnp.float32(coef), jnp.float32(chol))


def drawn_from_all(key):
    """Return the last policy, the history of all, and samples of each: features, thetas, ages."""
    history, rows = None, []
    for number, policy in enumerate(policies()):
        history = empty_history(policy, NUM_POLICIES) if history is None else history
        history = remember(history, policy, jnp.int32(number))
        context_key, theta_key = jax.random.split(jax.random.fold_in(key, number))
        features = jax.vmap(FEATURES.apply)(jax.random.uniform(context_key, (NUM_EACH, 1)))
        noise = jax.random.normal(theta_key, (NUM_EACH, DIM))
        age = jnp.full(NUM_EACH, NUM_POLICIES - 1 - number, jnp.int32)
        rows.append((features, features @ policy.coef + noise @ policy.cov_chol.T, age))
    return policy, history, *(jnp.concatenate(column) for column in zip(*rows, strict=True))


def weights_of(key, num_valid=None, least_effective=1.0):
    policy, history, features, theta, age = drawn_from_all(key)
    is_valid = jnp.arange(len(age)) < (len(age) if num_valid is None else num_valid)
    iteration = jnp.int32(NUM_POLICIES - 1)
    samples = features, theta, age, is_valid, iteration
    settings = {"least_effective": least_effective}
    return importance_weights(GAUSSIAN.log_prob, policy, history, *samples, **settings)


def densities(policy, features, theta):
    mean, chol = np.asarray(features @ policy.coef, float), np.asarray(policy.cov_chol, float)
    return scipy.stats.multivariate_normal(cov=chol @ chol.T).pdf(np.asarray(theta, float) - mean)


@pytest.mark.parametrize("num_valid", [None, 70])
def test_weights_are_density_over_that_of_the_mixture(key, num_valid):
    policy, _, features, theta, _ = drawn_from_all(key)
    counts = np.arange(len(theta)) < (num_valid or len(theta))
    shares = [np.mean(counts[i * NUM_EACH : (i + 1) * NUM_EACH]) for i in range(NUM_POLICIES)]
    mixture = sum(s * densities(p, features, theta) for s, p in zip(shares, policies(), strict=True))
    expected = np.where(counts, densities(policy, features, theta) / mixture, 0.0)
    np.testing.assert_allclose(weights_of(key, num_valid), expected / expected.sum(), rtol=1e-4, atol=1e-8)


def test_samples_of_others_have_the_mean_of_the_policy():
    """Its own samples are one in three; the mean of all, without weights, is off by half a deviation."""
    keys = jax.random.split(jax.random.key(1), 200)
    offset = lambda key: drawn_from_all(key)[3] - drawn_from_all(key)[2] @ drawn_from_all(key)[0].coef  # noqa: E731
    offsets, weights = jax.vmap(offset)(keys), jax.vmap(weights_of)(keys)
    assert abs(offsets.mean(axis=(0, 1))).max() > 0.3
    # Self-normalised weights have a bias of the order of one over the number of samples.
    np.testing.assert_allclose((weights[..., None] * offsets).sum(1).mean(0), 0.0, atol=0.02)


def test_the_guard_keeps_as_many_samples_as_asked_and_no_more_than_there_are(key):
    count = lambda weights: 1 / np.sum(np.asarray(weights, float) ** 2)  # noqa: E731
    free = count(weights_of(key))
    assert free < 100
    np.testing.assert_allclose(count(weights_of(key, least_effective=0.9 * free)), free, rtol=1e-4)
    np.testing.assert_allclose(count(weights_of(key, least_effective=110.0)), 110.0, rtol=1e-3)
    np.testing.assert_allclose(weights_of(key, least_effective=1e6), 1 / (NUM_EACH * NUM_POLICIES), rtol=1e-3)


def test_without_valid_samples_there_are_no_weights(key):
    assert (weights_of(key, num_valid=0) == 0).all()


def told(algorithm, key, rounds, is_failed=()):
    """Ask and tell a few times; the best thetas are the context. Return what was told in each round, too."""
    state = algorithm.init(LinearGaussian(jnp.zeros((2, DIM)), jnp.eye(DIM)))
    infos, past = [], []
    for number in range(rounds):
        context_key, theta_key = jax.random.split(jax.random.fold_in(key, number))
        contexts = jax.random.uniform(context_key, (30, 1))
        thetas = algorithm.ask(theta_key, state, contexts)
        reward = -jnp.sum((thetas - contexts) ** 2, axis=1)
        reward = reward.at[jnp.array(is_failed, int)].set(jnp.nan)
        past.append((state.policy, contexts, thetas))
        state, info = algorithm.tell(state, Batch(contexts, thetas, reward))
        infos.append(info)
    return state, infos, past


@pytest.mark.parametrize("is_failed", [(), (0, 7, 8)])
def test_an_update_weighs_each_sample_by_the_policy_it_was_drawn_from(key, is_failed):
    """After more rounds than policies are kept: the places of all have been written anew."""
    _, infos, past = told(WEIGHTED, key, 5, is_failed)
    works = [i for i in range(30) if i not in is_failed]
    kept = past[-NUM_POLICIES:]
    features = np.concatenate([np.column_stack([np.ones(len(works)), c[works, 0]]) for _, c, _ in kept])
    theta = np.concatenate([thetas[np.array(works)] for _, _, thetas in kept])
    each = [densities(policy, features, theta) for policy, _, _ in kept]
    weights = each[-1] / np.mean(each, axis=0)
    expected = weights.sum() ** 2 / (weights**2).sum()
    assert 50.0 < expected < 0.95 * len(theta)
    np.testing.assert_allclose(infos[-1].prior_effective_samples, expected, rtol=1e-3)
    assert infos[-1].num_valid == NUM_POLICIES * len(works)


def test_samples_of_one_policy_count_equally(key):
    (_, (weighted,), _), (_, (plain,), _) = told(WEIGHTED, key, 1), told(PLAIN, key, 1)
    np.testing.assert_allclose(weighted.prior_effective_samples, 30, rtol=1e-5)
    for name in ("kl", "policy_kl", "effective_samples", "entropy"):
        np.testing.assert_allclose(getattr(weighted, name), getattr(plain, name), rtol=1e-3)


def test_samples_of_forgotten_policies_are_left_out(key):
    state, infos, _ = told(WEIGHTED, key, 5)
    assert [int(info.num_valid) for info in infos] == [30, 60, 90, 90, 90]
    assert state.archive.age[:150].max() == 4
    assert all(abs(info.kl - 0.5) < 1e-3 for info in infos)


def test_a_state_of_another_setting_is_refused(key):
    state, _, _ = told(PLAIN, key, 1)
    with pytest.raises(ValueError, match="the last 3 policies, as `init` makes it, got 0"):
        WEIGHTED.tell(state, Batch(jnp.zeros((3, 1)), jnp.zeros((3, DIM)), jnp.zeros(3)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ((0,), "num_policies must be at least 1, got 0"),
        ((5, 0.5), "least_effective must be finite and at least 1, got 0.5"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Importance(*settings)
