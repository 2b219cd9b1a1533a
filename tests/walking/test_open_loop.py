"""Open-loop set-points: from standing, within limits and speed of the joints, along the engine's targets."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.numerics.rotations import rotation_y, rotation_z
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
from creps_jax.robots.robot import NAO, NAO_H25
from creps_jax.walking.controller import Stage, Walker
from creps_jax.walking.gaits import AHEAD, steered_gait, straight_walker
from creps_jax.walking.open_loop import open_loop_walk
from creps_jax.walking.posture import Balance

DURATION, PERIOD = 2.0, 0.02
# A gait of 0.33 m/s, and one so hasty that joints cannot follow.
WALKING = (0.001, 0.176, 0.039, 0.224, 3.2, 0.46, 0.31, 0.074, 0.038, 0.11)
HASTY = (0.0, 0.15, 0.15, 0.08, -5.0, 0.5, 0.5, 0.15, 0.0, 10.0)


def set_points_of(theta, **settings):
    commands = jnp.tile(jnp.array(AHEAD), (round(DURATION / PERIOD), 1))
    return open_loop_walk(straight_walker(theta, period=PERIOD, **settings), commands).set_point


def walk(theta):
    """Return the set-points, and the soles at the start in the frame of the torso."""
    set_points = set_points_of(theta)
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
    walk = jax.jit(jax.vmap(lambda theta: set_points_of(theta, robot=NAO_H25)))
    return np.asarray(walk(jnp.array([WALKING, HASTY])))


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


def test_the_trunk_leans_and_heads_as_planned_whatever_gains_and_balance():
    def gait(command):
        """Turn, and lean the more the faster the walk."""
        theta = jnp.array([*WALKING, 0.01, 0.15]).at[4].set(10.0 * command[0])
        return steered_gait(theta)

    free = {"joint_lower": (-3.0,) * NUM_JOINTS, "joint_upper": (3.0,) * NUM_JOINTS}
    robot = dataclasses.replace(NAO, max_joint_speed=(1e3,) * NUM_JOINTS, **free)
    walker = Walker(gait, robot, balance=Balance(0.5, 0.6, 0.06))
    commands = jnp.linspace(jnp.array([-0.3, 0.0, 0.0]), jnp.array([0.5, 0.1, 0.2]), 150)
    states = jax.jit(lambda commands: open_loop_walk(walker, commands))(commands)
    assert {Stage.STANDING, Stage.STARTING, Stage.WALKING} == set(np.asarray(states.stage).tolist())
    assert np.abs(np.diff(states.origin[:, 2])).max() > 0.1 and np.ptp(states.gait.params.lean) > 0.1
    poses = jax.vmap(walker.pose)(states)
    for side, sole in ((LEFT, poses.left), (RIGHT, poses.right)):
        found = jax.vmap(lambda joints, side=side: leg_fk(joints[leg_indices(side)], side))(states.set_point)
        lean, yaw = np.asarray(states.gait.params.lean), np.asarray(sole[:, 3] - poses.hips[:, 3])
        wanted = [rotation_y(-one) @ rotation_z(other) for one, other in zip(lean, yaw, strict=True)]
        np.testing.assert_allclose(found[:, :3, :3], np.stack(wanted), atol=1e-5)


def test_commands_that_are_not_finite_are_refused():
    walker = straight_walker(jnp.array(WALKING))
    with pytest.raises(ValueError, match="commands must be finite, got"):
        open_loop_walk(walker, jnp.array([[np.nan, 0.0, 0.0]]))
