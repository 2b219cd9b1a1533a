"""See that a MuJoCo model is the one of a robot, whose figures kinematics and engine count on."""

import mujoco
import numpy as np

from creps_jax import checks
from creps_jax.motion.nao_geometry import JOINT_NAMES
from creps_jax.motion.robots import Robot
from creps_jax.typing import Float

__all__ = ["check_fit"]

_SLACK = 1e-3
"""How far limits (rad) and places (m) of a model may be from those of its robot."""


def check_fit(model: mujoco.MjModel, robot: Robot) -> None:
    """Refuse a model that is not the robot's.

    Args:
        model: The model; its first body is the torso.
        robot: The robot.

    Raises:
        ValueError: If it is driven by other joints or in another order, a joint cannot go wherever the
            robot's can, or the joints of the legs are elsewhere at the zero pose.
    """
    checks.instance("model", model, mujoco.MjModel)
    names = tuple(model.joint(model.actuator(i).trnid[0]).name for i in range(model.nu))
    if names != JOINT_NAMES:
        raise ValueError(f"the model's actuators must drive {JOINT_NAMES} in this order, got {names}")
    _check_limits(model, robot)
    _check_legs(model, robot)


def _check_limits(model: mujoco.MjModel, robot: Robot) -> None:
    limits = zip(JOINT_NAMES, robot.joint_lower, robot.joint_upper, strict=True)
    for index, (name, low, high) in enumerate(limits):
        joint, actuator = model.joint(name), model.actuator(index)
        ranges = [joint.range] * int(joint.limited[0]) + [actuator.ctrlrange] * int(actuator.ctrllimited[0])
        for lowest, highest in ranges:
            if lowest > low + _SLACK or highest < high - _SLACK:
                raise ValueError(
                    f"the model's {name} must have the range of the robot {robot.name}, {low:.3f} to "
                    f"{high:.3f} rad, got {lowest:.3f} to {highest:.3f}"
                )


def _check_legs(model: mujoco.MjModel, robot: Robot) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for name, place in _leg_joints(robot).items():
        for side, sign in (("left", 1.0), ("right", -1.0)):
            expected = place * np.array([1.0, sign, 1.0])
            found = data.joint(f"{side}_{name}").xanchor - data.xpos[1]
            if np.abs(found - expected).max() > _SLACK:
                raise ValueError(
                    f"the model's {side}_{name} must be where the robot {robot.name} has it, at "
                    f"{np.round(expected, 4)} m from the torso, got {np.round(found, 4)}"
                )


def _leg_joints(robot: Robot) -> dict[str, Float[np.ndarray, "3"]]:
    """Return where the joints of the left leg are in the frame of the torso at the zero pose, m."""
    g = robot.geometry
    hip = np.array([g.hip_x, g.hip_y, g.hip_z])
    knee = hip + np.array([g.thigh_forward, 0.0, -g.thigh_down])
    ankle = knee - np.array([0.0, 0.0, g.shank_down])
    return {
        "hip_yaw_pitch": hip,
        "hip_roll": hip,
        "hip_pitch": hip,
        "knee": knee,
        "ankle_pitch": ankle,
        "ankle_roll": ankle - np.array([0.0, 0.0, g.ankle_drop]),
    }
