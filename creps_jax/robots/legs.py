"""The joint angles of both legs for poses of the soles, by the kinematics of the robot."""

import jax.numpy as jnp

from creps_jax.robots.humanoid import Humanoid
from creps_jax.robots.nao_geometry import LEFT, RIGHT
from creps_jax.robots.nao_kinematics import leg_ik
from creps_jax.robots.robot import NaoRobot, Robot
from creps_jax.robots.screw_kinematics import chain_ik
from creps_jax.typing import Array, Float

__all__ = ["solve_legs"]

# Newton steps from the posture of standing, and from the joint angles of one control period before.
FIRST_ITERATIONS, ITERATIONS = 30, 3


def solve_legs(
    T_torso_left: Float[Array, "4 4"],
    T_torso_right: Float[Array, "4 4"],
    last: Float[Array, " nu"] | None,
    *,
    robot: Robot,
) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
    """Return the joint angles of the left and the right leg.

    Args:
        T_torso_left: Pose of the left sole in the frame of the trunk, m.
        T_torso_right: Pose of the right sole.
        last: Joint vector one control period before, rad; None if there is none. A NAO's legs are solved in
            closed form and do not need it.
        robot: Whose legs.
    """
    if isinstance(robot, NaoRobot):
        return _solve_nao(T_torso_left, T_torso_right, robot)
    if not isinstance(robot, Humanoid):
        raise ValueError(f"robot must be a NaoRobot or a Humanoid, whose kinematics are known, got {robot!r}")
    posture = jnp.asarray(robot.posture, T_torso_left.dtype)
    start, iterations = (posture, FIRST_ITERATIONS) if last is None else (last, ITERATIONS)
    left, right = (
        chain_ik(pose, start[jnp.array(joints)], chain, iterations=iterations)
        for pose, joints, chain in (
            (T_torso_left, robot.left_leg, robot.left),
            (T_torso_right, robot.right_leg, robot.right),
        )
    )
    return left, right


def _solve_nao(T_torso_left: Array, T_torso_right: Array, robot: NaoRobot) -> tuple[Array, Array]:
    """Solve the legs of a NAO; where they share a motor, each gives half of the way."""
    left, right = leg_ik(T_torso_left, LEFT, robot=robot), leg_ik(T_torso_right, RIGHT, robot=robot)
    if not robot.has_one_yaw_motor:
        return left, right
    yaws = (robot.left_leg[0], robot.right_leg[0])
    low, high = max(robot.joint_lower[i] for i in yaws), min(robot.joint_upper[i] for i in yaws)
    # Within what the joint can do: clipped after `leg_ik`, it would take the soles from their places.
    shared = jnp.clip(0.5 * (left[0] + right[0]), low, high)
    return (
        leg_ik(T_torso_left, LEFT, robot=robot, yaw_pitch=shared),
        leg_ik(T_torso_right, RIGHT, robot=robot, yaw_pitch=shared),
    )
