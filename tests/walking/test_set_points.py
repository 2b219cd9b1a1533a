"""Open-loop set-points: from standing, within limits and speed of the joints, along the engine's targets."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.robots.nao_geometry import (
    JOINT_LOWER,
    JOINT_NAMES,
    JOINT_UPPER,
    LEFT,
    MAX_JOINT_SPEED,
    NUM_JOINTS,
    RIGHT,
    leg_indices,
)
from creps_jax.robots.nao_kinematics import leg_fk
from creps_jax.robots.robot import NAO_H25
from creps_jax.walking.engine import BodyPose, pose_joints
from creps_jax.walking.params import WalkParams, params_from_theta
from creps_jax.walking.set_points import next_set_point, open_loop_set_points

DURATION, PERIOD = 2.0, 0.02
# A gait of 0.33 m/s, and one so hasty that joints cannot follow.
WALKING = (0.001, 0.176, 0.039, 0.224, 3.2, 0.46, 0.31, 0.074, 0.038, 0.11)
HASTY = (0.0, 0.15, 0.15, 0.08, -5.0, 0.5, 0.5, 0.15, 0.0, 10.0)


def walk(theta):
    """Return the set-points, and the soles at the start in the frame of the torso."""
    set_points = open_loop_set_points(params_from_theta(theta), duration=DURATION, period=PERIOD)
    soles = [leg_fk(set_points[0, leg_indices(side)], side) for side in (LEFT, RIGHT)]
    return set_points, jnp.stack(soles)


@pytest.fixture(scope="module")
def walks():
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(walk))(jnp.array([WALKING, HASTY])))


def test_a_set_point_for_each_period_within_the_joint_limits(walks):
    walks, _ = walks
    assert walks.shape == (2, round(DURATION / PERIOD) + 1, NUM_JOINTS)
    assert (walks >= np.float32(JOINT_LOWER)).all()
    assert (walks <= np.float32(JOINT_UPPER)).all()


def test_a_walk_begins_standing_with_the_soles_level_side_by_side(walks):
    left, right = walks[1][0]
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    np.testing.assert_allclose(right, mirror @ left @ mirror, atol=1e-5)
    assert left[1, 3] > 0.04
    # The trunk leans forward over level soles: seen from it, their x axis points up.
    lean = np.radians(WALKING[4])
    np.testing.assert_allclose(left[:3, 0], [np.cos(lean), 0.0, np.sin(lean)], atol=1e-5)


def test_joints_turn_as_fast_as_they_can_and_no_faster(walks):
    walking, hasty = np.abs(np.diff(walks[0], axis=1)).max(axis=(1, 2)) / PERIOD
    assert 1.0 < walking <= hasty
    assert hasty == pytest.approx(MAX_JOINT_SPEED, rel=1e-4)


@pytest.fixture(scope="module")
def h25_walks():
    def walk(theta):
        return open_loop_set_points(params_from_theta(theta), duration=DURATION, period=PERIOD, robot=NAO_H25)

    return np.asarray(jax.jit(jax.vmap(walk))(jnp.array([WALKING, HASTY])))


def test_another_robot_keeps_to_its_own_limits_and_speeds(h25_walks):
    assert (h25_walks >= np.float32(NAO_H25.joint_lower)).all()
    assert (h25_walks <= np.float32(NAO_H25.joint_upper)).all()
    speeds = np.abs(np.diff(h25_walks, axis=1)).max(axis=1) / PERIOD
    assert (speeds <= np.float32(NAO_H25.max_joint_speed) * 1.0001).all()
    for joint, largest in (("left_hip_roll", 4.16), ("left_knee", 6.40)):
        assert speeds[1, JOINT_NAMES.index(joint)] == pytest.approx(largest, rel=1e-4)


def test_legs_that_share_a_motor_turn_their_hips_alike(h25_walks):
    left, right = (h25_walks[..., JOINT_NAMES.index(f"{side}_hip_yaw_pitch")] for side in ("left", "right"))
    np.testing.assert_allclose(left, right, atol=1e-6)
    assert np.abs(left[0]).max() > 0


def test_legs_that_share_a_motor_keep_their_soles_in_place_at_its_limit():
    params = params_from_theta(jnp.array(WALKING))
    toes_in = [jnp.array([0.0, side * 0.05, 0.0, -side]) for side in (LEFT, RIGHT)]
    pose = BodyPose(jnp.array([0.0, 0.0, 0.21, 0.0]), *toes_in, turn=jnp.float32(0.0))
    targets = pose_joints(params, pose, jnp.zeros(3), robot=NAO_H25)
    soles = []
    for side in (LEFT, RIGHT):
        leg = leg_indices(side)
        np.testing.assert_allclose(targets[leg.start], NAO_H25.joint_upper[leg.start], rtol=1e-6)
        soles.append(np.asarray(leg_fk(targets[leg], side, robot=NAO_H25)))
    left, right = soles
    np.testing.assert_allclose(left[:3, 3] - right[:3, 3], [0.0, 0.1, 0.0], atol=1e-5)
    np.testing.assert_allclose([left[1, 2], right[1, 2]], 0.0, atol=1e-5)


def test_a_set_point_reaches_its_target_or_comes_as_near_as_it_can():
    start, target = np.zeros(NUM_JOINTS, np.float32), np.linspace(-0.3, 0.3, NUM_JOINTS, dtype=np.float32)
    reached = np.asarray(jax.jit(next_set_point, static_argnums=2)(start, target, PERIOD))
    is_near = np.abs(target) <= MAX_JOINT_SPEED * PERIOD
    np.testing.assert_array_equal(reached[is_near], target[is_near])
    np.testing.assert_allclose(np.abs(reached[~is_near]), MAX_JOINT_SPEED * PERIOD, rtol=1e-6)
    assert 0 < is_near.sum() < NUM_JOINTS


@pytest.mark.parametrize(("duration", "period"), [(1.0, 0.0), (0.01, 0.02)])
def test_a_walk_without_length_is_refused(duration, period):
    with pytest.raises(ValueError, match=rf"period must be .* at most duration, got {period} and {duration}"):
        open_loop_set_points(WalkParams(*WALKING), duration=duration, period=period)
