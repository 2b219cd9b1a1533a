"""Turn the plan of a step into joint targets: pose hips and feet, then the joints."""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp

from creps_jax import checks
from creps_jax.numerics.curves import smooth_step
from creps_jax.numerics.rotations import rigid_transform, rotation_x, rotation_y, rotation_z, wrapped
from creps_jax.robots.legs import solve_legs
from creps_jax.robots.robot import NAO, Robot
from creps_jax.typing import Array, Float, Scalar, ScalarLike
from creps_jax.walking.com import spring_height
from creps_jax.walking.footsteps import Footstep
from creps_jax.walking.params import WalkParams
from creps_jax.walking.posture import Balance, corrected_lean
from creps_jax.walking.swing import swing_pose

__all__ = [
    "BodyPose",
    "StepPlan",
    "body_pose",
    "pose_joints",
    "stand_upright",
    "vertical_trunk",
]

MAX_HEADING_STEP = 0.15
# Tilt beyond which a foot is put out no further, rad.
MAX_TILT = 0.35


class StepPlan(NamedTuple):
    """All that is planned of one step.

    Attributes:
        footstep: Where the feet are and go.
        com: Horizontal CoM position at equally spaced nodes over the step, in the frame of the footstep, m.
        yaw: Heading of the trunk at the start and the end of the step, rad.
    """

    footstep: Footstep
    com: Float[Array, "n 2"]
    yaw: Float[Array, "2"]


class BodyPose(NamedTuple):
    """Where hips and feet shall be at one time, in the frame of the plan or in the world (m, rad).

    Attributes:
        hips: Position (x, y, z) and yaw of the middle of the hips.
        left: Position (x, y, z) and yaw of the left sole, below the ankle.
        right: That of the right sole.
        turn: Share of a turn, -0.5 to 0.5, by which the left foot has turned outwards; the right foot has
            turned by the opposite. It rises while the left foot swings, and falls while the right one does.
    """

    hips: Float[Array, "4"]
    left: Float[Array, "4"]
    right: Float[Array, "4"]
    turn: Scalar


@checks.arguments
def body_pose(params: WalkParams, plan: StepPlan, phase: Scalar, *, robot: Robot = NAO) -> BodyPose:
    """Pose hips and feet at one time of a step.

    Args:
        params: Walking parameters.
        plan: The plan of the step.
        phase: Time over the duration of the step, 0 to 1.
        robot: Who walks.

    Returns:
        The pose of hips and feet.
    """
    phase = jnp.clip(phase, 0.0, 1.0)
    share = params.double_support / params.step_duration
    swing_phase = (phase - 0.5 * share) / (1.0 - share)
    swing, lift = swing_pose(
        plan.footstep.swing_start, plan.footstep.swing_end, params.swing_height, swing_phase
    )
    back = robot.zmp_ahead_of_ankle
    swing = _above_floor(swing, lift, back)
    support = _above_floor(plan.footstep.support, jnp.zeros_like(lift), back)

    node = phase * (plan.com.shape[0] - 1)
    index = jnp.minimum(node.astype(jnp.int32), plan.com.shape[0] - 2)
    remainder = node - index.astype(node.dtype)
    com = (1.0 - remainder) * plan.com[index] + remainder * plan.com[index + 1]
    height, _ = spring_height(phase, params.hip_height, params.amplitude, params.step_duration)
    turned, swung = smooth_step(phase), smooth_step(jnp.clip(swing_phase, 0.0, 1.0))
    yaw = (1.0 - turned) * plan.yaw[0] + turned * plan.yaw[1]
    forward = jnp.stack([jnp.cos(yaw), jnp.sin(yaw)])
    hips = com - robot.com_ahead_of_hip * forward
    supports_left = plan.footstep.supports_left
    return BodyPose(
        hips=jnp.concatenate([hips, jnp.stack([height + robot.ankle_height, yaw])]),
        left=jnp.where(supports_left, support, swing),
        right=jnp.where(supports_left, swing, support),
        turn=jnp.where(supports_left, 0.5 - swung, swung - 0.5),
    )


@checks.arguments
def stand_upright(pose: BodyPose, slope: Scalar, yaw: ScalarLike = 0.0) -> BodyPose:
    """Move the hips of a pose to where they stand above the feet as gravity has it.

    Args:
        pose: A pose planned for level ground, in a frame on the floor.
        slope: Angle by which the floor rises uphill, rad.
        yaw: Heading of the frame's x axis, from uphill, rad.

    Returns:
        The pose with the hips farther uphill, by the tangent of the slope times their height.
    """
    uphill = jnp.stack([jnp.cos(yaw), -jnp.sin(yaw)])
    return pose._replace(hips=pose.hips.at[:2].add(pose.hips[2] * jnp.tan(slope) * uphill))


def vertical_trunk(slope: ScalarLike, yaw: Scalar) -> Float[Array, "2"]:
    """Return roll and pitch of a vertical trunk, seen from a floor that rises by `slope`, rad.

    Args:
        slope: Angle by which the floor rises uphill, rad.
        yaw: Heading of the trunk, from uphill, rad.
    """
    roll = jnp.arcsin(jnp.sin(slope) * jnp.sin(yaw))
    return jnp.stack([roll, jnp.arctan2(jnp.sin(slope) * jnp.cos(yaw), jnp.cos(slope))])


def _above_floor(foot, height, back):
    """Place the sole below the ankle, so far behind a foot's centre of this planar pose and height."""
    x, y, yaw = foot
    return jnp.stack([x - back * jnp.cos(yaw), y - back * jnp.sin(yaw), height, yaw])


@checks.arguments
def pose_joints(
    params: WalkParams,
    pose: BodyPose,
    measured_rpy: Float[Array, "3"],
    *,
    last: Float[Array, " nu"] | None = None,
    vertical: Float[Array, "2"] | None = None,
    balance: Balance = Balance(),
    robot: Robot = NAO,
) -> Float[Array, " nu"]:
    """Pose the joints for a body pose and the measured orientation of the trunk.

    Args:
        params: Walking parameters.
        pose: Where hips and feet shall be.
        measured_rpy: Measured roll, pitch and yaw of the trunk, rad; the yaw relative to the planned
            heading's origin.
        last: Joint targets one control period before, rad, from which the inverse kinematics of a `Humanoid`
            start; None starts from the posture of standing.
        vertical: Roll and pitch of a vertical trunk, rad; zero by default, see `vertical_trunk`.
        balance: How steps answer to the measured orientation.
        robot: Who walks.

    Returns:
        Joint targets in the order of `robot.joint_names`, rad, within the joint limits.

    Raises:
        ValueError: If the measured orientation is not finite.
    """
    checks.finite("measured_rpy", measured_rpy)
    vertical = jnp.zeros(2, params.lean.dtype) if vertical is None else vertical
    intended = vertical.at[1].add(params.lean)
    roll, pitch = corrected_lean(intended, measured_rpy[:2], params.roll_gain, params.tilt_gain)
    R_level_trunk = rotation_y(pitch) @ rotation_x(roll)
    heading_error = jnp.clip(wrapped(pose.hips[3] - measured_rpy[2]), -1.0, 1.0)
    heading_step = balance.heading_gain * heading_error
    turn = jnp.clip(heading_step, -MAX_HEADING_STEP, MAX_HEADING_STEP) * pose.turn
    tilt = jnp.stack([measured_rpy[0] - vertical[0], measured_rpy[1] - intended[1]])
    roll_error, pitch_error = jnp.clip(tilt, -MAX_TILT, MAX_TILT)
    shift = params.hip_height * jnp.stack(
        [balance.forward_placement_gain * pitch_error, -balance.placement_gain * roll_error]
    )
    place = partial(_sole_in_torso, pose.hips, R_level_trunk=R_level_trunk, robot=robot)
    T_torso_left = place(pose.left, turn=turn, shift=(0.5 + pose.turn) * shift)
    T_torso_right = place(pose.right, turn=-turn, shift=(0.5 - pose.turn) * shift)
    left, right = solve_legs(T_torso_left, T_torso_right, last, robot=robot)
    ahead = jnp.cos(pose.hips[3]) * (pose.left[0] - pose.right[0]) + jnp.sin(pose.hips[3]) * (
        pose.left[1] - pose.right[1]
    )
    posture, arm_swing = (jnp.asarray(angles, ahead.dtype) for angles in (robot.posture, robot.arm_swing))
    # Each arm swings against the foot of its side.
    targets = posture + arm_swing * (0.5 * ahead)
    targets = targets.at[jnp.array(robot.left_leg)].set(left).at[jnp.array(robot.right_leg)].set(right)
    limits = (jnp.asarray(limit, targets.dtype) for limit in (robot.joint_lower, robot.joint_upper))
    return jnp.clip(targets, *limits)


def _sole_in_torso(hips, sole, *, R_level_trunk, turn, shift, robot):
    """Transform a sole from the world into the frame of a trunk that leans about the middle of its hips.

    The sole is turned by `turn` about the hips and shifted by `shift` forward and to the left, m.
    """
    R_trunk_level = R_level_trunk.T
    R_heading = rotation_z(turn - hips[3])
    x, z = robot.hip_centre
    hip_centre = jnp.array([x, 0.0, z], hips.dtype)
    from_hips = (R_heading @ (sole[:3] - hips[:3])).at[:2].add(shift)
    position = R_trunk_level @ from_hips + hip_centre
    return rigid_transform(R_trunk_level @ R_heading @ rotation_z(sole[3]), position)
