"""The planar arm: kinematics, exact collisions, and the rewards' properties."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from creps_jax.tasks.planar_arm import (
    arm_points,
    hits_ground,
    hole_movement,
    hole_reaching,
    via_point_movement,
    via_point_reaching,
)

KEY = jax.random.key(0)
seeds = st.integers(0, 2**31 - 1)
hole_rollout = jax.jit(hole_reaching().rollout)


def test_the_arm_points_up_and_turns_clockwise():
    np.testing.assert_allclose(arm_points(jnp.zeros(3)), [[0, 0], [0, 1], [0, 2], [0, 3]], atol=1e-6)
    bent = arm_points(jnp.array([jnp.pi / 2, jnp.pi / 2, -jnp.pi / 2]))
    np.testing.assert_allclose(bent, [[0, 0], [1, 0], [1, -1], [2, -1]], atol=1e-6)


def test_collisions_are_those_of_points_all_along_a_link():
    # Links about the hole: half of them have their upper end in or above it.
    rng = np.random.default_rng(0)
    num, center = 4000, 1.7
    upper = np.stack([center + rng.uniform(-0.3, 0.3, num), rng.uniform(-0.5, 1.0, num)], axis=1)
    lower = np.stack([center + rng.uniform(-0.25, 0.25, num), rng.uniform(-1.2, 0.5, num)], axis=1)
    links = np.stack([upper, lower], axis=1)
    share = np.linspace(0, 1, 2001)[:, None, None]
    x, y = np.moveaxis((1 - share) * links[:, 0] + share * links[:, 1], -1, 0)
    # How far a point below the surface is from the ground; negative inside it.
    room = np.where(y < 0, np.minimum(0.15 - np.abs(x - center), y + 1.0), np.inf).min(axis=0)
    expected, is_clear = room < 0, np.abs(room) > 2e-3
    hits = jax.vmap(lambda points: hits_ground(points, jnp.float32(center), 0.3, 1.0))
    found = np.asarray(hits(jnp.asarray(links, jnp.float32)))
    np.testing.assert_array_equal(found[is_clear], expected[is_clear])
    is_in_hole = is_clear & np.isfinite(room)
    assert expected[is_in_hole].sum() > 500
    assert (~expected[is_in_hole]).sum() > 500


def test_a_link_through_the_edge_of_the_hole_collides_though_both_its_ends_are_free():
    center, free, cut = jnp.float32(1.0), [[0.95, 0.5], [1.05, -0.5]], [[0.5, 0.5], [1.1, -0.5]]
    assert not hits_ground(jnp.array(free), center, 0.3, 1.0)
    assert hits_ground(jnp.array(cut), center, 0.3, 1.0)


def test_through_the_ground_and_up_again_collides():
    assert hits_ground(jnp.array([[0.0, 0.5], [1.0, -0.5], [2.0, 0.5]]), jnp.float32(3.0), 0.3, 1.0)
    assert hits_ground(jnp.array([[1.0, 0.5], [1.0, -1.01]]), jnp.float32(1.0), 0.3, 1.0)
    assert not hits_ground(jnp.array([[0.0, 0.0], [1.0, 0.0]]), jnp.float32(3.0), 0.3, 1.0)


def drawn(seed, size=1.0):
    rng = np.random.default_rng(seed)
    theta = size * rng.exponential() * rng.normal(size=18)
    return jnp.array([rng.uniform(1.4, 2.0)], jnp.float32), jnp.array(theta, jnp.float32)


@given(seeds)
@settings(deadline=None, max_examples=300)
def test_colliding_never_beats_standing_still_and_no_reward_is_infinite(seed):
    context, theta = drawn(seed, size=3.0)
    outcome, still = hole_rollout(KEY, context, theta), hole_rollout(KEY, context, jnp.zeros(18))
    assert np.isfinite(outcome.reward)
    assert still.num_collisions == 0
    if outcome.num_collisions > 0:
        assert outcome.reward < still.reward


@given(seeds)
@settings(deadline=None, max_examples=50)
def test_the_mirror_image_has_the_same_reward(seed):
    context, theta = drawn(seed, size=0.5)
    for one, other in zip(
        hole_rollout(KEY, context, theta), hole_rollout(KEY, -context, -theta), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-5)


def test_nearer_the_floor_of_the_hole_is_better():
    # Leaning towards the hole without touching the ground.
    lean = jnp.zeros(18).at[-3].set(0.5)
    nearer = hole_rollout(KEY, jnp.array([1.7]), lean)
    still = hole_rollout(KEY, jnp.array([1.7]), jnp.zeros(18))
    assert nearer.num_collisions == 0
    assert nearer.distance < still.distance
    assert nearer.reward > still.reward
    np.testing.assert_allclose(still.reward, -1e5 * (1.7**2 + 4.0**2), rtol=1e-5)


def tips_of(joint_pos):
    angle = np.cumsum(np.asarray(joint_pos, float), axis=1)
    return np.stack([np.sin(angle).sum(axis=1), np.cos(angle).sum(axis=1)], axis=1)


def test_the_reward_of_reaching_is_its_formula():
    context, theta = jnp.array([-1.2, -0.6]), jax.random.normal(KEY, (15,))
    reward = via_point_reaching().rollout(KEY, context, theta).reward
    movement = via_point_movement(theta)
    tips = tips_of(movement.pos)
    miss = np.sum((tips[49] - np.asarray(context)) ** 2) + np.sum((tips[99] - [3.0, 0.0]) ** 2)
    expected = -1e4 * miss - 0.5 * np.sum(np.asarray(movement.acc, float) ** 2)
    np.testing.assert_allclose(reward, expected, rtol=1e-4)


@pytest.mark.parametrize("goal", [0.4, 2.2])
def test_the_reward_of_the_hole_is_its_formula_with_and_without_collisions(goal):
    theta = (0.1 * jax.random.normal(KEY, (18,))).at[-3].set(goal)
    outcome = hole_rollout(KEY, jnp.array([1.7]), theta)
    movement = hole_movement(theta)
    points = jax.vmap(arm_points)(movement.pos)
    hits = sum(bool(hits_ground(posture, jnp.float32(1.7), 0.3, 1.0)) for posture in points)
    assert (hits > 0) == (goal > 2.0)
    first, last = 1.7**2 + 4.0**2, np.sum((tips_of(movement.pos)[-1] - [1.7, -1.0]) ** 2)
    missed = max(first, last) if hits else last
    expected = -1e5 * (missed + hits) - 10 * np.sum(np.asarray(movement.acc, float) ** 2)
    np.testing.assert_allclose(outcome.reward, expected, rtol=1e-4)
    np.testing.assert_allclose(outcome.distance, np.sqrt(last), rtol=1e-4)


@pytest.mark.parametrize("task, low, high", [(via_point_reaching(), -1.5, -0.5), (hole_reaching(), 1.4, 2.0)])
def test_contexts_stay_in_their_range(task, low, high):
    contexts = jax.vmap(task.sample_context)(jax.random.split(KEY, 500))
    assert contexts.min() >= np.float32(low)
    assert contexts.max() <= np.float32(high)
    assert contexts.std() > 0.15 * (high - low)


def test_a_hole_without_size_is_refused():
    with pytest.raises(ValueError, match=r"width must be finite and above 0, got 0.0"):
        hole_reaching(width=0.0)
    with pytest.raises(ValueError, match="low must be below high"):
        hole_reaching(2.0, 1.4, sample_context=lambda key: jnp.ones(1))
