"""Functions have the minima they are known for, and the context moves these."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.tasks import contextual_function
from creps_jax.tasks.functions import ackley, ellipsoid, rastrigin, rosenbrock, sphere

MINIMA = {sphere: 0.0, ellipsoid: 0.0, rosenbrock: 1.0, rastrigin: 0.0, ackley: 0.0}
# By hand, at (1, 2).
VALUES = {
    sphere: 5.0,
    ellipsoid: 1.0 + 4e6,
    rosenbrock: 100.0,
    rastrigin: 5.0,
    ackley: 20.0 - 20.0 * np.exp(-0.2 * np.sqrt(2.5)),
}


@pytest.mark.parametrize("function", MINIMA)
def test_nothing_is_below_the_minimum(key, function):
    minimum = jnp.full(5, MINIMA[function])
    assert function(minimum) == pytest.approx(0.0, abs=1e-5)
    near_and_far = minimum[None] + jax.random.normal(key, (200, 5)) * jnp.geomspace(1e-2, 10.0, 200)[:, None]
    assert (jax.vmap(function)(near_and_far) > 0).all()


@pytest.mark.parametrize("function", VALUES)
def test_values_known_by_hand(function):
    assert function(jnp.array([1.0, 2.0])) == pytest.approx(VALUES[function], rel=1e-5)


def test_the_best_policy_is_affine_in_the_context(key):
    transform = jax.random.normal(key, (4, 2))
    task = contextual_function(rosenbrock, transform)
    for context in jax.vmap(task.sample_context)(jax.random.split(key, 5)):
        assert ((context >= 1.0) & (context <= 2.0)).all()
        best = 1.0 - transform @ context
        assert task.rollout(key, context, best).reward == pytest.approx(0.0, abs=1e-4)
        assert task.rollout(key, context, best.at[2].add(0.1)).reward < -0.1


def test_a_transform_has_to_be_a_matrix():
    with pytest.raises(ValueError, match=r"must have shape \(d, s\), got \(3,\)"):
        # The annotations of the tests would refuse it first.
        contextual_function(sphere, jnp.zeros(3))
