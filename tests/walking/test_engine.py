"""The walking engine: footsteps, swing, posture, and joint targets that are safe for every theta."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from creps_jax.numerics.rotations import matrix_to_rpy, rotation_x
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
from creps_jax.robots.robot import NAO_H25
from creps_jax.walking.engine import BodyPose, joint_targets, plan_step, plan_walk, pose_at, pose_joints
from creps_jax.walking.footsteps import FOOT_SPACING, next_footstep, standing
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
LEVEL = jnp.zeros(3)
NUM_STEPS = 12
BALANCE = Balance(heading_gain=0.3, placement_gain=0.6)
LEFT_LEG, RIGHT_LEG = leg_indices(LEFT), leg_indices(RIGHT)


@jax.jit
def targets_of(theta, time, measured):
    params = params_from_theta(theta)
    return joint_targets(params, plan_walk(params, NUM_STEPS), time, measured, balance=BALANCE)


@jax.jit
def walk_of(theta, command):
    return plan_walk(params_from_theta(theta), NUM_STEPS, command)


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
    times = jnp.asarray(rng.uniform(0.0, 3.0, len(thetas)), jnp.float32)
    measured = jnp.asarray(rng.normal(size=(len(thetas), 3)), jnp.float32)
    targets = jax.vmap(targets_of)(thetas, times, measured)
    assert targets.shape == (250, len(JOINT_NAMES))
    assert jnp.isfinite(targets).all()
    assert (np.asarray(targets) >= np.array(JOINT_LOWER, np.float32)).all()
    assert (np.asarray(targets) <= np.array(JOINT_UPPER, np.float32)).all()


@given(st.lists(st.floats(-1e20, 1e20), min_size=10, max_size=10), st.floats(-1e6, 1e6))
@settings(max_examples=30, deadline=None)
def test_wild_thetas_and_times_give_finite_targets(theta, time):
    assert jnp.isfinite(targets_of(jnp.array(theta, jnp.float32), jnp.float32(time), LEVEL)).all()


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
    plan = walk_of(THETA, jnp.array([0.07, 0.0, 0.0]))
    lengths = np.asarray(plan.com[:, -1, 0] - plan.com[:, 0, 0])
    growth = float(params.step_growth * params.step_duration)
    np.testing.assert_allclose(lengths, np.minimum(growth * np.arange(1, NUM_STEPS + 1), 0.07), atol=1e-6)
    # In the steady walk the body ends each step between the feet.
    between = 0.5 * (plan.footstep.support + plan.footstep.swing_end)[-1, :2]
    np.testing.assert_allclose(plan.com[-1, -1], between, atol=1e-6)
    np.testing.assert_allclose(plan.footstep.swing_end[::2, 1], -FOOT_SPACING / 2, atol=1e-6)
    np.testing.assert_allclose(plan.footstep.swing_end[1::2, 1], FOOT_SPACING / 2, atol=1e-6)


@pytest.mark.parametrize(
    "command", [(0.0, 0.03, 0.0), (0.0, -0.03, 0.0), (0.03, 0.0, 0.2), (0.05, 0.02, -0.2)]
)
def test_the_engine_walks_in_every_direction(command):
    plan = walk_of(THETA, jnp.array(command))
    middles = np.asarray(0.5 * (plan.footstep.support + plan.footstep.swing_end))
    sideways, turned = middles[-1, 1], middles[-1, 2]
    assert np.sign(np.round(turned, 3)) == np.sign(command[2])
    if command[2] == 0.0:
        assert np.sign(sideways) == np.sign(command[1])
    # Each foot lands on its own side of the other.
    seen = np.asarray(plan.footstep.swing_end - plan.footstep.support)
    yaw = np.asarray(plan.footstep.support[:, 2])
    left = np.cos(yaw) * seen[:, 1] - np.sin(yaw) * seen[:, 0]
    assert (np.where(plan.footstep.supports_left, -left, left) > 0.09).all()


def test_turning_mirrors():
    left, right = walk_of(THETA, jnp.array([0.04, 0.02, 0.2])), walk_of(THETA, jnp.array([0.04, -0.02, -0.2]))
    # The first step is always with the same foot, so walks mirror from the second one on, one step apart
    # at most.
    last_left = np.asarray(0.5 * (left.footstep.support + left.footstep.swing_end))[-1]
    last_right = np.asarray(0.5 * (right.footstep.support + right.footstep.swing_end))[-1]
    np.testing.assert_allclose(last_left[2], -last_right[2], atol=0.21)


def test_planning_step_by_step_is_planning_at_once():
    params = params_from_theta(THETA)
    command = jnp.array([0.05, 0.01, 0.1])
    at_once, stance = walk_of(THETA, command), standing()
    step = jax.jit(plan_step)
    for index in range(NUM_STEPS):
        plan, stance = step(params, stance, command)
        for one, all_of_them in zip(jax.tree.leaves(plan), jax.tree.leaves(at_once), strict=True):
            np.testing.assert_allclose(one, all_of_them[index], atol=1e-6)


def test_com_is_continuous_from_step_to_step_and_starts_between_the_feet():
    plan = walk_of(THETA, jnp.array([0.07, 0.0, 0.0]))
    np.testing.assert_allclose(plan.com[1:, 0], plan.com[:-1, -1], atol=1e-6)
    np.testing.assert_allclose(plan.com[0, 0], 0.0, atol=1e-7)


def test_joint_targets_are_continuous_in_time():
    theta = THETA.at[8].set(0.05)
    times = jnp.arange(0.0, 2.2, 0.002)
    targets = np.asarray(jax.vmap(targets_of, in_axes=(None, 0, None))(theta, times, LEVEL))
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
    targets = targets_of(theta, jnp.float32(0.0), measured)
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
    targets = targets_of(THETA.at[0].set(0.0), jnp.float32(0.0), LEVEL)
    T_torso_sole = leg_fk(targets[RIGHT_LEG], RIGHT)
    height = GEOMETRY.hip_z - T_torso_sole[2, 3] - GEOMETRY.ankle_height
    np.testing.assert_allclose(height, 0.176, atol=1e-5)


def test_planted_feet_are_not_turned_in_double_support():
    params = params_from_theta(jnp.array([0.0, 0.17, 0.04, 0.4, 0.0, 0.3, 0.3, 0.05, 0.1, 0.1]))
    plan = plan_walk(params, NUM_STEPS)

    def turn_at(steps):
        return pose_at(params, plan, jnp.float32(steps) * params.step_duration).turn

    # A quarter of the step has both feet on the ground, half of it at each end.
    np.testing.assert_allclose(turn_at(2.12), turn_at(1.88), atol=1e-6)
    assert abs(turn_at(2.12)) == pytest.approx(0.5)
    assert abs(turn_at(2.5)) < 1e-5


def test_heading_hold_turns_the_feet_back_and_is_off_by_default():
    params = params_from_theta(THETA)
    plan = plan_walk(params, NUM_STEPS)
    turned_left = jnp.array([0.0, 0.0, 0.2])
    time = 0.95 * params.step_duration  # the right foot is about to land

    def right_foot_yaw(balance):
        targets = joint_targets(params, plan, time, turned_left, balance=balance)
        return matrix_to_rpy(leg_fk(targets[RIGHT_LEG], RIGHT)[:3, :3])[2]

    np.testing.assert_allclose(right_foot_yaw(Balance()), 0.0, atol=1e-5)
    assert right_foot_yaw(Balance(heading_gain=0.5)) < -0.03


def test_a_landing_foot_is_put_out_to_where_the_robot_tips_and_that_is_off_by_default():
    # Without roll gain the feet stay level, and the tilt alone changes nothing about where they are put.
    params = params_from_theta(THETA.at[6].set(0.0))
    plan = plan_walk(params, NUM_STEPS)

    def sideways(phase, roll, **balance):
        """Return how far to the left of the hips the left and the right sole are, in a level frame."""
        measured = jnp.array([roll, 0.0, 0.0])
        targets = joint_targets(
            params, plan, phase * params.step_duration, measured, balance=Balance(**balance)
        )
        soles = [
            rotation_x(roll) @ (leg_fk(targets[leg], side)[:3, 3] - jnp.array([0.0, 0.0, GEOMETRY.hip_z]))
            for leg, side in ((LEFT_LEG, LEFT), (RIGHT_LEG, RIGHT))
        ]
        return np.array([sole[1] for sole in soles])

    tips_right = jnp.float32(0.1)
    np.testing.assert_allclose(sideways(0.95, tips_right), sideways(0.95, jnp.float32(0.0)), atol=1e-4)
    for phase, expected in ((0.02, [1.0, 0.0]), (0.98, [0.0, 1.0])):
        moved = sideways(phase, tips_right, placement_gain=0.5) - sideways(phase, tips_right)
        # The left foot stands in the first step, the right one lands; to the right is negative.
        np.testing.assert_allclose(moved, -0.5 * 0.176 * 0.1 * np.array(expected), atol=3e-4)


def test_the_plan_holds_its_last_pose_after_its_end():
    params = params_from_theta(THETA)
    plan = plan_walk(params, 3)
    late = pose_at(params, plan, 10.0 * params.step_duration)
    end = pose_at(params, plan, 3.0 * params.step_duration)
    for a, b in zip(late, end, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_a_landing_beyond_reach_is_held_at_it():
    params = params_from_theta(THETA.at[9].set(10.0))
    footstep, _ = next_footstep(params, standing(), jnp.array([1.0, -1.0, 3.0]))
    seen = footstep.swing_end - footstep.support
    assert abs(float(seen[0])) <= 0.2 + 1e-6
    assert abs(float(seen[1])) <= 0.18 + 1e-6
    assert abs(float(seen[2])) <= 0.6 + 1e-6
