"""A search and a policy of a user's own, in a few lines each, are trained as the library's are."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import creps_jax as cj

TASK = cj.sinus(low=0.0, high=3.0)


class Best(NamedTuple):
    """What random search around the best parameters remembers."""

    theta: jax.Array
    reward: jax.Array
    iteration: jax.Array


def random_search() -> cj.Search:
    def init(policy):
        return Best(policy, jnp.float32(-jnp.inf), jnp.int32(0))

    def ask(key, state, contexts):
        return state.theta[None] + jax.random.normal(key, (len(contexts), len(state.theta)))

    def tell(state, batch):
        best = jnp.argmax(batch.reward)
        is_better = batch.reward[best] > state.reward
        theta = jnp.where(is_better, batch.theta[best], state.theta)
        reward = jnp.maximum(batch.reward[best], state.reward)
        return Best(theta, reward, state.iteration + 1), {"is_better": is_better}

    return cj.Search(init, ask, tell, policy=lambda state: state.theta)


@pytest.mark.parametrize("on_iteration", [None, lambda state, log: None])
def test_a_search_of_ones_own_is_trained(key, on_iteration):
    settings = {"iterations": 5, "samples": 8, "on_iteration": on_iteration}
    state, log = cj.train(key, TASK, random_search(), jnp.zeros(1), **settings)
    assert int(state.iteration) == 5 and float(state.reward) > -0.1
    assert log.info["is_better"].shape == log.mean_reward.shape == (5,)
    # It goes on from a state with the numbers of a run that never stopped.
    search = random_search()
    half, _ = cj.train(key, TASK, search, jnp.zeros(1), iterations=2, samples=8)
    resumed, _ = cj.train(key, TASK, search, half, iterations=3, samples=8)
    jax.tree.map(np.testing.assert_array_equal, resumed, state)


def test_trials_of_a_search_of_ones_own_are_trained(key):
    keys = jax.random.split(key, 3)
    states, log = cj.train_trials(keys, TASK, random_search(), jnp.zeros(1), iterations=4, samples=8)
    assert states.theta.shape == (3, 1) and log.mean_reward.shape == (3, 4)


def test_a_search_that_gives_other_parameters_than_the_task_takes_is_refused(key):
    with pytest.raises(ValueError, match=r"the task's 1 parameters, got thetas of shape \(8, 2\)"):
        cj.train(key, TASK, random_search(), jnp.zeros(2), iterations=1, samples=8)


class Cloud(NamedTuple):
    """A mean that a small network gives, and one spread."""

    first: jax.Array
    second: jax.Array
    spread: jax.Array


def network_policy() -> cj.Policy:
    def mean(state, x):
        return jnp.tanh(x @ state.first) @ state.second

    def sample(key, state, x):
        centre = mean(state, x)
        return centre + state.spread * jax.random.normal(key, centre.shape)

    def log_prob(state, x, theta):
        return jnp.sum(jax.scipy.stats.norm.logpdf(theta, mean(state, x), state.spread), axis=1)

    def kl(state, reference, x):
        ratio, shift = state.spread / reference.spread, mean(state, x) - mean(reference, x)
        return jnp.sum(0.5 * (ratio**2 + (shift / reference.spread) ** 2 - 1.0) - jnp.log(ratio), axis=1)

    def fit(state, samples):
        x, theta, weights, _ = samples
        loss = lambda weight: -weights @ log_prob(Cloud(*weight, state.spread), x, theta)  # noqa: E731
        step = lambda w, _: (jax.tree.map(lambda a, g: a - 0.02 * g, w, jax.grad(loss)(w)), None)  # noqa: E731
        (first, second), _ = jax.lax.scan(step, (state.first, state.second), length=100)
        error = theta - mean(Cloud(first, second, state.spread), x)
        return Cloud(first, second, jnp.sqrt(weights @ jnp.mean(error**2, axis=1)))

    entropy = lambda state: jnp.log(state.spread) + 1.4189385  # noqa: E731
    return cj.Policy(cj.linear_features(1), mean, sample, log_prob, kl, entropy, fit)


def test_a_policy_of_ones_own_is_trained(key):
    first = jax.random.normal(key, (2, 16))
    start = Cloud(first, jnp.zeros((16, 1)), jnp.float32(1.0))
    baseline = cj.rbf_features(0.0, 3.0, 5)
    settings = {"archive_size": 400, "significance": None}
    algorithm = cj.creps(network_policy(), baseline, importance=cj.Importance(), **settings)
    state, log = cj.train(key, TASK, algorithm, start, iterations=25, samples=40)
    contexts = jnp.linspace(0.2, 2.8, 9)[:, None]
    means = algorithm.mean(state, contexts)
    assert float(jnp.abs(means - jnp.sin(contexts)).max()) < 0.25
    assert np.isfinite(log.info.policy_kl).all() and log.info.is_updated.any()
    np.testing.assert_array_equal(algorithm.mean(state.policy, contexts), means)


def test_what_does_not_go_with_a_policy_of_ones_own_is_named():
    with pytest.raises(ValueError, match="significance must be None for a policy that has no function blend"):
        cj.creps(network_policy(), archive_size=400)
    with pytest.raises(ValueError, match=r"ridge and m_step must be None for a Policy, got 0\.1 and None"):
        cj.creps(network_policy(), archive_size=400, significance=None, ridge=0.1)


def test_a_search_whose_state_has_no_iteration_is_named(key):
    search = dataclasses.replace(random_search(), init=lambda policy: policy)
    for learn, keys in ((cj.train, key), (cj.train_trials, jax.random.split(key, 2))):
        with pytest.raises(ValueError, match="what init returns must be the state of a search, with a field"):
            learn(keys, TASK, search, jnp.zeros(1), iterations=1, samples=8)


def test_parts_of_a_policy_that_are_none_are_named():
    policy = network_policy()
    for field, value in (("mean", 3), ("features", None), ("fit", None)):
        with pytest.raises(ValueError, match=rf"policy_features\.{field} must be"):
            cj.creps(policy._replace(**{field: value}), archive_size=400, significance=None)
    algorithm = cj.creps(policy, archive_size=400, significance=None)
    with pytest.raises(ValueError, match="policy must be a pytree of arrays with floats, got None"):
        algorithm.init(None)


@pytest.mark.parametrize("kind", [bool, np.bool_, jnp.bool_])
def test_a_callback_can_end_a_run(key, kind):
    stop = lambda state, log: kind(int(state.iteration) == 3)  # noqa: E731
    search = random_search()
    state, log = cj.train(key, TASK, search, jnp.zeros(1), iterations=9, samples=8, on_iteration=stop)
    assert int(state.iteration) == 3 and log.mean_reward.shape == (3,)
    whole, _ = cj.train(key, TASK, search, jnp.zeros(1), iterations=3, samples=8)
    jax.tree.map(np.testing.assert_array_equal, state, whole)
