"""The sinus task is what the paper says, and tells RBF-REPS from linear REPS."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.contexts import context_grid
from creps_jax.policies.features import linear_features, quadratic_features, rbf_features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.search.creps import creps
from creps_jax.tasks import sinus
from creps_jax.training import evaluate, train_trials

HIGH = 5 * math.pi


@pytest.mark.parametrize("context", [-3.0, 0.0, 1.0, 15.0])
def test_reward_is_best_at_the_sine(key, context):
    task, best = sinus(), math.sin(context)
    reward = lambda theta: task.rollout(key, jnp.asarray([context]), theta[None]).reward  # noqa: E731
    thetas = jnp.linspace(best - 2, best + 2, 41)
    np.testing.assert_allclose(jax.vmap(reward)(thetas), -np.square(thetas - best), atol=1e-5)
    assert jax.grad(reward)(jnp.asarray(best)) == pytest.approx(0, abs=1e-5)


def test_contexts_cover_the_range_that_is_asked_for(key):
    contexts = jax.vmap(sinus(1.0, 2.0).sample_context)(jax.random.split(key, 1000))
    assert contexts.min() == 1 and contexts.max() == 2 and abs(contexts.mean() - 1.5) < 0.05


def test_rbf_reps_learns_the_sine_and_linear_reps_does_not(key):
    """Held-out grid, three trials; without learning the mean reward is -0.5, that of theta = 0."""
    rbf = rbf_features(0.0, HIGH, 10)
    grid = context_grid(0.0, HIGH, 101)

    def reward_on_the_grid(policy_features, baseline_features):
        algorithm = creps(policy_features, baseline_features, archive_size=2000)
        policy = LinearGaussian(jnp.zeros((policy_features.size, 1)), jnp.eye(1))
        keys = jax.random.split(key, 3)
        # Of fewer samples too few lie near the ends of the range for a first policy of ten features.
        states, _ = train_trials(keys, sinus(), algorithm, policy, iterations=30, samples=100)
        thetas = jax.vmap(algorithm.mean, (0, None))(states.policy, grid)
        contexts = jnp.tile(grid, (3, 1))
        return evaluate(key, sinus(), contexts, thetas.reshape(-1, 1)).reward.reshape(3, -1).mean(1)

    assert (reward_on_the_grid(rbf, rbf) > -0.002).all()
    assert (reward_on_the_grid(linear_features(1), quadratic_features(1)) < -0.3).all()
