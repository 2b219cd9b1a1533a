"""Wrappers change what they promise, keep every other field, and refuse what does not fit."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.tasks import Outcome, PlainOutcome, Task, average_repeats, penalised, sigmoid_constrained
from creps_jax.training import evaluate


class NoisyOutcome(NamedTuple):
    reward: jax.Array
    violation: jax.Array
    fell: jax.Array
    theta: jax.Array
    num_steps: jax.Array


def noisy_rollout(key, context, theta):
    reward_key, fall_key = jax.random.split(key)
    return NoisyOutcome(
        reward=context[0] + jax.random.normal(reward_key),
        violation=jnp.zeros(0),
        fell=jax.random.bernoulli(fall_key),
        theta=theta,
        num_steps=jnp.int32(7),
    )


@pytest.fixture
def task() -> Task:
    return Task(lambda key: jax.random.normal(key, (1,)), noisy_rollout, 1, 2, worst_reward=-100)


CONTEXT, THETA = jnp.asarray([3.0]), jnp.asarray([0.25, -0.5])


def test_any_named_tuple_with_the_two_fields_is_an_outcome(task, key):
    assert isinstance(task.rollout(key, CONTEXT, THETA), Outcome)
    assert not isinstance((1.0, 2.0), Outcome)


def test_a_bare_reward_is_an_outcome_everywhere(key):
    bare = Task(lambda key: jnp.zeros(1), lambda key, context, theta: -jnp.sum(theta**2), 1, 2, -100)
    full = dataclasses.replace(bare, rollout=lambda *given: PlainOutcome(bare.rollout(*given), jnp.zeros(0)))
    wrappers = (
        lambda task: task,
        lambda task: average_repeats(task, 2),
        lambda task: sigmoid_constrained(task, 0.0, 1.0),
        lambda task: penalised(task, 0.0, 1.0, 5.0),
    )
    for wrap in wrappers:
        found, expected = (
            evaluate(key, wrap(task), jnp.zeros((3, 1)), jnp.ones((3, 2))) for task in (bare, full)
        )
        jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_average_is_the_mean_of_single_rollouts(task, key):
    outcome = average_repeats(task, 5).rollout(key, CONTEXT, THETA)
    single = [task.rollout(k, CONTEXT, THETA) for k in jax.random.split(key, 5)]
    np.testing.assert_allclose(outcome.reward, np.mean([o.reward for o in single]), rtol=1e-6)
    np.testing.assert_allclose(outcome.fell, np.mean([o.fell for o in single]), rtol=1e-6)
    np.testing.assert_array_equal(outcome.theta, THETA)
    assert outcome.num_steps == 7 and outcome.num_steps.dtype == jnp.float32
    assert len({float(o.reward) for o in single}) == 5


def test_average_reduces_the_noise(task, key):
    def spread(task):
        rollout = jax.vmap(task.rollout, (0, None, None))
        return float(rollout(jax.random.split(key, 2000), CONTEXT, THETA).reward.std())

    assert spread(task) == pytest.approx(1, rel=0.1)
    assert spread(average_repeats(task, 4)) == pytest.approx(0.5, rel=0.1)


def test_gate_reaches_the_rollout_and_other_fields_stay(task, key):
    low, high = (0.0, 10.0), (1.0, 20.0)
    outcome = sigmoid_constrained(task, low, high).rollout(key, CONTEXT, jnp.zeros(2))
    np.testing.assert_allclose(outcome.theta, [0.5, 15.0])
    plain = task.rollout(key, CONTEXT, jnp.zeros(2))
    assert outcome.reward == plain.reward and outcome.fell == plain.fell


def test_penalty_is_charged_outside_and_the_rollout_sees_the_clipped_theta(task, key):
    priced = penalised(task, low=0.0, high=(1.0, 1.0), penalty=1000)
    outside, plain = (t.rollout(key, CONTEXT, THETA) for t in (priced, task))
    np.testing.assert_allclose(outside.reward, plain.reward - 1000, rtol=1e-6)
    np.testing.assert_allclose(outside.theta, [0.25, 0.0])
    np.testing.assert_allclose(outside.violation, [0.0, 0.5])
    inside = priced.rollout(key, CONTEXT, jnp.abs(THETA))
    assert inside.reward == plain.reward and not inside.violation.any()
    assert priced.worst_reward == -1100


def test_wrappers_stack(task, key):
    wrapped = average_repeats(penalised(sigmoid_constrained(task, -1.0, 1.0), -5.0, 5.0, 10), 3)
    outcome = jax.jit(wrapped.rollout)(key, CONTEXT, 9 * jnp.ones(2))
    np.testing.assert_allclose(outcome.theta, jnp.tanh(5 * jnp.ones(2) / 2), rtol=1e-5)
    np.testing.assert_allclose(outcome.violation, [4.0, 4.0])


@pytest.mark.parametrize(("low", "high"), [(-3e38, 3e38), ((0.0, -3e38), (1e-30, -2.9e38)), (3e38, 3.1e38)])
@pytest.mark.parametrize("compiled", [False, True])
def test_wrappers_of_extreme_bounds_stay_finite_and_inside(task, key, low, high, compiled):
    largest = float(np.finfo(np.float32).max)
    for wrapped in (sigmoid_constrained(task, low, high), penalised(task, low, high, 10.0)):
        rollout = jax.jit(wrapped.rollout) if compiled else wrapped.rollout
        for size in (-largest, -1.0, 0.0, 30.0, largest):
            with jax.debug_nans(True):
                outcome = rollout(key, CONTEXT, jnp.float32(size) * jnp.ones(2))
            assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(outcome))
            assert (outcome.theta >= np.float32(low)).all() and (outcome.theta <= np.float32(high)).all()


@pytest.mark.parametrize(
    ("wrap", "message"),
    [
        (lambda task: average_repeats(task, 0), "repeats must be at least 1, got 0"),
        (lambda task: sigmoid_constrained(task, (0.0,), (1.0,)), r"2 parameters, got shapes \(1,\)"),
        (lambda task: penalised(task, (0, 2), (1, 1), 1), r"must not exceed .* \[0\. 2\.\] and \[1\. 1\.\]"),
        (lambda task: penalised(task, 0.0, 1.0, -3), "penalty must be finite and at least 0, got -3"),
    ],
)
def test_refuses_what_does_not_fit(task, wrap, message):
    with pytest.raises(ValueError, match=message):
        wrap(task)
