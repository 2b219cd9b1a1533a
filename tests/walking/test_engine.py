"""The walking engine: footsteps, swing, posture, and joint targets that are safe for every theta."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from creps_jax.numerics.rotations import matrix_to_rpy, rotation_x, rotation_y, rotation_z
from creps_jax.robots.nao_geometry import (
    GEOMETRY,
    JOINT_LOWER,
    JOINT_NAMES,
    JOINT_UPPER,
    LEFT,
    RIGHT,
    leg_indices,
)
from creps_jax.robots.nao_kinematics import leg_fk
from creps_jax.robots.robot import NAO, NAO_H25
from creps_jax.walking.controller import Gait
from creps_jax.walking.engine import BodyPose, pose_joints, stand_upright, vertical_trunk
from creps_jax.walking.footsteps import FOOT_SPACING, compose, next_footstep, standing
from creps_jax.walking.gaits import AHEAD, straight_walker
from creps_jax.walking.open_loop import open_loop_walk
from creps_jax.walking.params import (
    AUTHOR_BOUNDS,
    NAO_BOUNDS,
    NAO_H25_BOUNDS,
    PAPER_BOUNDS,
    PARAM_LABELS,
    PARAM_NAMES,
    PARAM_UNITS,
    WalkParams,
    params_from_theta,
)
from creps_jax.walking.posture import Balance, corrected_lean
from creps_jax.walking.swing import swing_pose

THETA = jnp.array([0.001, 0.176, 0.039, 0.224, 0.0, 0.5, 0.5, 0.07, 0.04, 0.1])
DURATION = 0.224  # of a step of THETA, s
LEVEL = jnp.zeros(3)
NUM_STEPS = 12
BALANCE = Balance(heading_gain=0.3, placement_gain=0.6)
LEFT_LEG, RIGHT_LEG = leg_indices(LEFT), leg_indices(RIGHT)


def ahead(num):
    return jnp.tile(jnp.array(AHEAD), (num, 1))


@jax.jit
def walk_of(theta):
    """Return the states of a walk of 3 s, every 0.05 s."""
    return open_loop_walk(straight_walker(theta, period=0.05), ahead(60))


@jax.jit
def targets_of(theta, state, measured):
    """Return the joint targets of a state."""
    pose = straight_walker(theta).pose(state)
    return pose_joints(params_from_theta(theta), pose, measured, balance=BALANCE)


@partial(jax.jit, static_argnames="num")
def steps_of(theta, command=None, num=NUM_STEPS):
    """Return a state in the middle of each step of a walk with the duration of `THETA`."""
    walker = straight_walker(theta, period=0.5 * DURATION)
    if command is not None:
        walker = dataclasses.replace(walker, gait=lambda _: Gait(params_from_theta(theta), command))
    states = open_loop_walk(walker, ahead(2 * num))
    return jax.tree.map(lambda leaf: leaf[1::2], states)


def at_phase(state, phase):
    return state._replace(time=jnp.float32(phase * DURATION))


def in_world(states):
    """Return the poses of support foot and landing foot, and the CoM at the nodes, in the world."""

    def of_one(state):
        to_world = jax.vmap(compose, in_axes=(None, 0))
        com = jnp.pad(state.plan.com, ((0, 0), (0, 1)))
        feet = jnp.stack([state.plan.footstep.support, state.plan.footstep.swing_end])
        return *to_world(state.origin, feet), to_world(state.origin, com)[:, :2]

    return jax.tree.map(np.asarray, jax.vmap(of_one)(states))


def test_names_units_and_bounds_belong_together():
    assert WalkParams._fields == PARAM_NAMES
    assert len(PARAM_NAMES) == len(PARAM_UNITS) == len(PARAM_LABELS) == 10
    for low, high in (NAO_BOUNDS, NAO_H25_BOUNDS, PAPER_BOUNDS, AUTHOR_BOUNDS):
        assert len(low) == len(high) == 10
        assert all(np.array(low) < np.array(high))


@pytest.mark.parametrize("bounds", [NAO_BOUNDS, PAPER_BOUNDS, AUTHOR_BOUNDS], ids=["nao", "paper", "author"])
@pytest.mark.parametrize("widening", [1.0, 30.0, 1e6])
def test_every_theta_gives_finite_targets_within_the_limits(bounds, widening):
    low, high = np.array(bounds, np.float32)
    rng = np.random.default_rng(0)
    share = (rng.uniform(size=(200, 10)) - 0.5) * widening + 0.5
    corners = rng.integers(0, 2, size=(50, 10))
    thetas = jnp.asarray(low + np.concatenate([share, corners]) * (high - low), jnp.float32)
    measured = jnp.asarray(rng.normal(size=(len(thetas), 3)), jnp.float32)
    over_time = jax.vmap(targets_of, in_axes=(None, 0, None))
    targets = jax.vmap(over_time)(thetas, jax.vmap(walk_of)(thetas), measured)
    assert targets.shape == (250, 61, len(JOINT_NAMES))
    assert jnp.isfinite(targets).all()
    assert (np.asarray(targets) >= np.array(JOINT_LOWER, np.float32)).all()
    assert (np.asarray(targets) <= np.array(JOINT_UPPER, np.float32)).all()


@given(st.lists(st.floats(-1e20, 1e20), min_size=10, max_size=10), st.floats(-1e6, 1e6))
@settings(max_examples=30, deadline=None)
def test_wild_thetas_and_times_give_finite_targets(theta, time):
    theta = jnp.array(theta, jnp.float32)
    state = jax.tree.map(lambda leaf: leaf[-1], walk_of(theta))
    assert jnp.isfinite(targets_of(theta, state._replace(time=jnp.float32(time)), LEVEL)).all()


def test_params_of_a_sensible_theta_are_the_theta_in_si_units():
    theta = THETA.at[4].set(3.0)
    params = params_from_theta(theta)
    np.testing.assert_allclose(
        jnp.stack(params)[jnp.array([0, 1, 2, 3, 5, 6, 7, 8, 9])], jnp.delete(theta, 4), rtol=1e-6
    )
    np.testing.assert_allclose(params.lean, np.radians(3.0), rtol=1e-6)


def test_amplitude_and_double_support_are_limited_by_the_duration():
    params = params_from_theta(THETA.at[0].set(1.0).at[8].set(1.0))
    assert params.amplitude * (2 * np.pi / params.step_duration) ** 2 < 9.81
    assert params.double_support < params.step_duration


def test_steps_grow_from_standstill_to_the_wanted_length():
    params = params_from_theta(THETA)
    support, landing, com = in_world(steps_of(THETA, jnp.array([0.07, 0.0, 0.0])))
    lengths = com[:, -1, 0] - com[:, 0, 0]
    growth = float(params.step_growth * params.step_duration)
    np.testing.assert_allclose(lengths, np.minimum(growth * np.arange(1, NUM_STEPS + 1), 0.07), atol=1e-6)
    # In the steady walk the body ends each step between the feet.
    between = 0.5 * (support + landing)[-1, :2]
    np.testing.assert_allclose(com[-1, -1], between, atol=1e-6)
    np.testing.assert_allclose(landing[::2, 1], -FOOT_SPACING / 2, atol=1e-6)
    np.testing.assert_allclose(landing[1::2, 1], FOOT_SPACING / 2, atol=1e-6)


@pytest.mark.parametrize(
    "command", [(0.0, 0.03, 0.0), (0.0, -0.03, 0.0), (0.03, 0.0, 0.2), (0.05, 0.02, -0.2)]
)
def test_the_engine_walks_in_every_direction(command):
    steps = steps_of(THETA, jnp.array(command))
    support, landing, _ = in_world(steps)
    _, sideways, turned = 0.5 * (support + landing)[-1]
    assert np.sign(np.round(turned, 3)) == np.sign(command[2])
    if command[2] == 0.0:
        assert np.sign(sideways) == np.sign(command[1])
    # Each foot lands on its own side of the other.
    seen, yaw = landing - support, support[:, 2]
    left = np.cos(yaw) * seen[:, 1] - np.sin(yaw) * seen[:, 0]
    assert (np.where(steps.plan.footstep.supports_left, -left, left) > 0.09).all()


def test_turning_mirrors():
    ends = []
    for command in ([0.04, 0.02, 0.2], [0.04, -0.02, -0.2]):
        support, landing, _ = in_world(steps_of(THETA, jnp.array(command)))
        ends.append(0.5 * (support + landing)[-1])
    # The first step is always with the same foot, so walks mirror from the second one on, one step apart
    # at most.
    np.testing.assert_allclose(ends[0][2], -ends[1][2], atol=0.21)


def test_com_is_continuous_from_step_to_step_and_starts_between_the_feet():
    _, _, com = in_world(steps_of(THETA, jnp.array([0.07, 0.0, 0.0])))
    np.testing.assert_allclose(com[1:, 0], com[:-1, -1], atol=1e-6)
    np.testing.assert_allclose(com[0, 0], 0.0, atol=1e-7)


def test_joint_targets_are_continuous_in_time():
    theta = THETA.at[8].set(0.05)
    states = jax.jit(lambda: open_loop_walk(straight_walker(theta, period=0.002), ahead(1100)))()
    targets = np.asarray(jax.vmap(targets_of, in_axes=(None, 0, None))(theta, states, LEVEL))
    # 12 rad/s is twice what the motors do; a jump would be seen as hundreds.
    assert np.abs(np.diff(targets, axis=0)).max() < 0.002 * 30.0


def test_the_swing_foot_leaves_and_lands_at_rest_and_rises_to_its_height():
    start, end = jnp.array([0.0, 0.05, 0.1]), jnp.array([0.1, 0.05, -0.1])
    heights = jax.vmap(lambda phase: swing_pose(start, end, jnp.float32(0.03), phase)[1])
    phases = jnp.linspace(0.0, 1.0, 201)
    np.testing.assert_allclose(jnp.max(heights(phases)), 0.03, atol=1e-6)
    for phase, pose in ((0.0, start), (1.0, end)):
        value, speed = jax.jvp(
            lambda s: swing_pose(start, end, jnp.float32(0.03), s), (jnp.float32(phase),), (jnp.float32(1.0),)
        )
        np.testing.assert_allclose(value[0], pose, atol=1e-6)
        np.testing.assert_allclose(jnp.append(*speed), 0.0, atol=1e-5)


def test_posture_gains_blend_measured_and_intended_lean():
    intended, measured = jnp.array([0.0, 0.05]), jnp.array([0.1, -0.2])

    def lean(gain):
        return corrected_lean(intended, measured, jnp.float32(gain), jnp.float32(gain))

    np.testing.assert_allclose(lean(0.0), measured, atol=1e-7)
    np.testing.assert_allclose(lean(1.0), intended, atol=1e-7)
    np.testing.assert_allclose(lean(0.5), 0.5 * (intended + measured), atol=1e-7)


def sole_orientation(theta, measured):
    targets = targets_of(theta, straight_walker(theta).start(), measured)
    return matrix_to_rpy(leg_fk(targets[LEFT_LEG], LEFT)[:3, :3]), targets


def test_a_larger_r_offset_leans_the_trunk_forward():
    # Seen from a trunk that leans forward (positive pitch), level feet point up: negative pitch.
    full_gain = THETA.at[5].set(1.0).at[6].set(1.0)
    upright, _ = sole_orientation(full_gain, LEVEL)
    leaning, _ = sole_orientation(full_gain.at[4].set(5.0), LEVEL)
    np.testing.assert_allclose(upright[1], 0.0, atol=1e-5)
    np.testing.assert_allclose(leaning[1], -np.radians(5.0), atol=1e-5)


def test_without_gain_the_feet_stay_level_whatever_the_trunk_does():
    no_gain = THETA.at[5].set(0.0).at[6].set(0.0)
    orientation, _ = sole_orientation(no_gain, jnp.array([0.1, 0.2, 0.0]))
    # R_trunk_sole is the inverse of the trunk's own orientation.
    pitched, _ = sole_orientation(no_gain, jnp.array([0.0, 0.2, 0.0]))
    np.testing.assert_allclose(pitched[1], -0.2, atol=1e-5)
    np.testing.assert_allclose(orientation[0], -0.1, atol=0.01)


def test_legs_that_share_a_motor_keep_their_soles_in_place_at_its_limit():
    params = params_from_theta(THETA)
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


def test_hips_stand_at_the_asked_height_above_the_ankles():
    theta = THETA.at[0].set(0.0)
    targets = targets_of(theta, straight_walker(theta).start(), LEVEL)
    T_torso_sole = leg_fk(targets[RIGHT_LEG], RIGHT)
    height = GEOMETRY.hip_z - T_torso_sole[2, 3] - GEOMETRY.ankle_height
    np.testing.assert_allclose(height, 0.176, atol=1e-5)


def test_planted_feet_are_not_turned_in_double_support():
    theta = THETA.at[8].set(0.25 * DURATION)
    steps = steps_of(theta)

    def turn_at(index, phase):
        state = jax.tree.map(lambda leaf: leaf[index], steps)
        return straight_walker(theta).pose(at_phase(state, phase)).turn

    # A quarter of the step has both feet on the ground, half of it at each end.
    np.testing.assert_allclose(turn_at(2, 0.12), turn_at(1, 0.88), atol=1e-6)
    assert abs(turn_at(2, 0.12)) == pytest.approx(0.5)
    assert abs(turn_at(2, 0.5)) < 1e-5


def first_step(theta):
    return jax.tree.map(lambda leaf: leaf[0], steps_of(theta, num=1))


def test_heading_hold_turns_the_feet_back_and_is_off_by_default():
    turned_left = jnp.array([0.0, 0.0, 0.2])
    # The right foot is about to land.
    pose = straight_walker(THETA).pose(at_phase(first_step(THETA), 0.95))

    def right_foot_yaw(balance):
        targets = pose_joints(params_from_theta(THETA), pose, turned_left, balance=balance)
        return matrix_to_rpy(leg_fk(targets[RIGHT_LEG], RIGHT)[:3, :3])[2]

    np.testing.assert_allclose(right_foot_yaw(Balance()), 0.0, atol=1e-5)
    assert right_foot_yaw(Balance(heading_gain=0.5)) < -0.03


@pytest.mark.parametrize(
    ("gain", "tilt", "axis", "sign"),
    [("placement_gain", (0.1, 0.0), 1, -1.0), ("forward_placement_gain", (0.0, 0.1), 0, 1.0)],
    ids=["sideways", "forwards"],
)
def test_a_landing_foot_is_put_out_to_where_the_robot_tips_and_that_is_off_by_default(gain, tilt, axis, sign):
    # Without gains of roll and pitch the feet stay level, and the tilt alone does not move them.
    theta = THETA.at[5:7].set(0.0)
    step, lean = first_step(theta), params_from_theta(theta).lean
    hips = jnp.array([NAO.hip_centre[0], 0.0, NAO.hip_centre[1]])

    def places(phase, tilt, **balance):
        """Return the left and the right sole seen from the hips, in a level frame."""
        roll, pitch = tilt[0], lean + tilt[1]
        measured = jnp.array([roll, pitch, 0.0])
        pose = straight_walker(theta).pose(at_phase(step, phase))
        targets = pose_joints(params_from_theta(theta), pose, measured, balance=Balance(**balance))
        R_level_trunk = rotation_y(pitch) @ rotation_x(jnp.float32(roll))
        soles = [
            R_level_trunk @ (leg_fk(targets[leg], side)[:3, 3] - hips)
            for leg, side in ((LEFT_LEG, LEFT), (RIGHT_LEG, RIGHT))
        ]
        return np.array(soles)

    np.testing.assert_allclose(places(0.95, tilt), places(0.95, (0.0, 0.0)), atol=1e-4)
    # The left foot stands in the first step, the right one lands.
    for phase, share in ((0.02, [1.0, 0.0]), (0.98, [0.0, 1.0])):
        moved = places(phase, tilt, **{gain: 0.5}) - places(phase, tilt)
        expected = np.zeros((2, 3))
        expected[:, axis] = sign * 0.5 * 0.176 * 0.1 * np.array(share)
        np.testing.assert_allclose(moved, expected, atol=3e-4)


def test_a_step_holds_its_last_pose_after_its_end():
    step, walker = first_step(THETA), straight_walker(THETA)
    late, end = walker.pose(at_phase(step, 10.0)), walker.pose(at_phase(step, 1.0))
    for a, b in zip(late, end, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_a_landing_beyond_reach_is_held_at_it():
    params = params_from_theta(THETA.at[9].set(10.0))
    footstep, _ = next_footstep(params, standing(), jnp.array([1.0, -1.0, 3.0]))
    seen = footstep.swing_end - footstep.support
    assert abs(float(seen[0])) <= 0.2 + 1e-6
    assert abs(float(seen[1])) <= 0.18 + 1e-6
    assert abs(float(seen[2])) <= 0.6 + 1e-6


@pytest.mark.parametrize("yaw", [0.0, 1.0, -2.0, 3.0])
def test_a_trunk_is_vertical_on_a_slope_whatever_its_heading(yaw):
    slope = 0.3
    up = np.array([np.sin(slope), 0.0, np.cos(slope)])
    roll, pitch = vertical_trunk(slope, jnp.float32(yaw))
    trunk = rotation_z(jnp.float32(yaw)) @ rotation_y(pitch) @ rotation_x(roll)
    np.testing.assert_allclose(trunk[:, 2], up, atol=1e-6)
    # Hips on a line against gravity above the feet, in a frame with this heading.
    zero = jnp.zeros(4)
    pose = stand_upright(BodyPose(zero.at[2].set(0.2), zero, zero, jnp.float32(0.0)), jnp.float32(slope), yaw)
    hips = rotation_z(jnp.float32(yaw)) @ pose.hips[:3]
    np.testing.assert_allclose(hips / np.linalg.norm(hips), up, atol=1e-6)
