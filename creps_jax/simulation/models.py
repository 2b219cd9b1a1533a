"""Load the MuJoCo model of a robot, and check that a model fits the robot that kinematics and engine use."""

from pathlib import Path

import mujoco
import numpy as np

from creps_jax import checks
from creps_jax.files import models_folder
from creps_jax.robots.humanoid import Humanoid
from creps_jax.robots.robot import NAO, NaoRobot, Robot
from creps_jax.typing import Float

__all__ = ["check_model", "load_model", "load_nao", "model_path"]

_TOLERANCE = 1e-3
"""Largest accepted difference of limits (rad), torques (N m) and positions (m) between model and robot."""


def load_nao(robot: Robot = NAO) -> mujoco.MjModel:
    """Load a NAO for simulation, from the checkout or from the installed package.

    Visual geometry is left out. So are the constraints of the joint limits, a third of all constraint rows:
    the set-points stay within the limits, and the servos hold the joints near the set-points.

    Args:
        robot: The simulated NAO, or `creps_jax.robots.robot.NAO_H25`, the real one.

    Raises:
        FileNotFoundError: If the model file does not exist.
    """
    spec = mujoco.MjSpec.from_file(str(model_path(robot)))
    spec.compiler.discardvisual = True
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    return spec.compile()


@checks.arguments
def load_model(robot: Robot) -> mujoco.MjModel:
    """Return the model in which a robot is simulated: that of a NAO's file, or that of a `Humanoid`.

    Raises:
        ValueError: If it is no robot.
        FileNotFoundError: If the file of a NAO does not exist.
    """
    return robot.model if isinstance(robot, Humanoid) else load_nao(robot)


def model_path(robot: Robot) -> Path:
    """Return the path of a robot's model file, in the checkout or in the installed package.

    Raises:
        FileNotFoundError: If the file does not exist.
    """
    path = models_folder() / robot.name / f"{robot.name}.xml"
    if not path.is_file():
        raise FileNotFoundError(f"the model of the robot {robot.name} must be in {path}, which is no file")
    return path


@checks.arguments
def check_model(model: mujoco.MjModel, robot: Robot) -> None:
    """Check that a model fits a robot.

    Args:
        model: The model; its first body is the torso.
        robot: The robot.

    Raises:
        ValueError: If the actuators drive other joints or in another order, the range of a joint does not
            include that of the robot, the torque of a servo differs, the model does not hold the yaw-pitch
            joints of the hips equal for a robot with one motor for both or does so for a robot with two, or
            the joints of the legs or the lowest points of the spheres under the feet are elsewhere at the
            zero pose.
    """
    names = tuple(model.joint(model.actuator(i).trnid[0]).name for i in range(model.nu))
    if names != robot.joint_names:
        raise ValueError(f"the model's actuators must drive {robot.joint_names} in this order, got {names}")
    _check_limits(model, robot)
    _check_torques(model, robot)
    if not isinstance(robot, NaoRobot):
        return
    _check_yaw_motors(model, robot)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    _check_leg_joints(data, robot)
    _check_soles(model, data, robot)


def _check_limits(model: mujoco.MjModel, robot: Robot) -> None:
    limits = zip(robot.joint_names, robot.joint_lower, robot.joint_upper, strict=True)
    for index, (name, low, high) in enumerate(limits):
        joint, actuator = model.joint(name), model.actuator(index)
        ranges = [joint.range] * int(joint.limited[0]) + [actuator.ctrlrange] * int(actuator.ctrllimited[0])
        for lowest, highest in ranges:
            if lowest > low + _TOLERANCE or highest < high - _TOLERANCE:
                raise ValueError(
                    f"the model's {name} must have the range of the robot {robot.name}, {low:.3f} to "
                    f"{high:.3f} rad, got {lowest:.3f} to {highest:.3f}"
                )


def _check_torques(model: mujoco.MjModel, robot: Robot) -> None:
    for index, (name, torque) in enumerate(zip(robot.joint_names, robot.max_joint_torque, strict=True)):
        actuator = model.actuator(index)
        low, high = actuator.forcerange if actuator.forcelimited[0] else (-np.inf, np.inf)
        if max(abs(low + torque), abs(high - torque)) > _TOLERANCE:
            raise ValueError(
                f"the servo of the model's {name} must have the torque of the robot {robot.name}, "
                f"{-torque:g} to {torque:g} N m, got {low:g} to {high:g}"
            )


def _check_yaw_motors(model: mujoco.MjModel, robot: NaoRobot) -> None:
    hips = {model.joint(f"{side}_hip_yaw_pitch").id for side in ("left", "right")}
    is_joint = (model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & (model.eq_active0 == 1)
    pairs = zip(model.eq_obj1id[is_joint], model.eq_obj2id[is_joint], strict=True)
    is_shared = any({int(first), int(second)} == hips for first, second in pairs)
    if is_shared != robot.has_one_yaw_motor:
        raise ValueError(
            f"the model must {'' if robot.has_one_yaw_motor else 'not '}hold left_hip_yaw_pitch and "
            f"right_hip_yaw_pitch equal: has_one_yaw_motor of the robot {robot.name} is "
            f"{robot.has_one_yaw_motor}, got {'one' if is_shared else 'no'} such constraint"
        )


def _check_leg_joints(data: mujoco.MjData, robot: NaoRobot) -> None:
    for name, position in _left_leg_joints(robot).items():
        for side, sign in (("left", 1.0), ("right", -1.0)):
            expected = position * np.array([1.0, sign, 1.0])
            found = data.joint(f"{side}_{name}").xanchor - data.xpos[1]
            if np.abs(found - expected).max() > _TOLERANCE:
                raise ValueError(
                    f"the model's {side}_{name} must be where the robot {robot.name} has it, at "
                    f"{np.round(expected, 4)} m from the torso, got {np.round(found, 4)}"
                )


def _check_soles(model: mujoco.MjModel, data: mujoco.MjData, robot: NaoRobot) -> None:
    for side in ("left", "right"):
        down = _foot_down(model, data, f"{side}_ankle_roll")
        if down is not None and abs(down - robot.geometry.foot_down) > _TOLERANCE:
            raise ValueError(
                f"the model's {side} sole must be as far below the ankle as the robot {robot.name} has it, "
                f"{robot.geometry.foot_down:g} m, got {down:g}"
            )


def _foot_down(model: mujoco.MjModel, data: mujoco.MjData, ankle: str) -> float | None:
    """Return the depth below the ankle, m, of the spheres that a foot stands on; None without spheres."""
    is_sole = model.geom_bodyid == model.jnt_bodyid[model.joint(ankle).id]
    is_sole &= model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    is_sole &= (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    if not is_sole.any():
        return None
    lowest = np.min(data.geom_xpos[is_sole, 2] - model.geom_size[is_sole, 0])
    return float(data.joint(ankle).xanchor[2] - lowest)


def _left_leg_joints(robot: NaoRobot) -> dict[str, Float[np.ndarray, "3"]]:
    """Return the positions of the left leg's joints in the torso frame at the zero pose, m."""
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
