"""Read the motors of a model: the torque and the range of each joint."""

from typing import NamedTuple

import mujoco
import numpy as np

# Only `humanoid_from_mjcf` is public.
__all__: list[str] = []

_HINGE = mujoco.mjtJoint.mjJNT_HINGE


class Servo(NamedTuple):
    """What a joint's motor can do, read from the model: torque, N m, and the range of angles, rad."""

    torque: float
    low: float
    high: float


def read_servos_of(model: mujoco.MjModel, max_torque: float | int | None) -> dict[str, Servo]:
    """Read the motor of each hinge joint: its torque limit and its range.

    As in MuJoCo, the torques of the actuators of a joint add up, and the joint limits their sum.

    Args:
        model: The compiled robot.
        max_torque: Torque of the motors whose limit the model does not state, N m.

    Raises:
        ValueError: If a joint is no hinge, or has no name, no actuator or no torque limit.
    """
    servos = {}
    for joint in range(model.njnt):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            continue
        name = model.joint(joint).name
        if model.jnt_type[joint] != _HINGE:
            raise ValueError(f"all joints of the robot must be hinges, got {name!r}, which is none")
        if not name:
            body = model.body(model.jnt_bodyid[joint]).name
            raise ValueError(f"each joint of the robot must have a name, got none for one of body {body!r}")
        is_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        actuators = np.flatnonzero(is_joint & (model.actuator_trnid[:, 0] == joint))
        if not len(actuators):
            missing = repr(name) if is_joint.any() else "any joint"
            raise ValueError(f"each joint must have an actuator in the model, got none for {missing}")
        torque = _torque_limit(model, joint, actuators)
        if not np.isfinite(torque):
            if max_torque is None:
                raise ValueError(
                    f"the torque of {name!r} must have a limit: its joint has no actuatorfrcrange, and its "
                    "actuator has neither a forcerange nor, as a motor, a ctrlrange; state one in the model, "
                    "or max_torque in the description"
                )
            torque = float(max_torque)
        if torque <= 0.0:
            raise ValueError(
                f"the torque of {name!r} must have a limit above 0 in both directions, got {torque:g}"
            )
        servos[name] = Servo(torque, *_range_of(model, joint, actuators))
    return servos


def _torque_limit(model: mujoco.MjModel, joint: int, actuators: np.ndarray) -> float:
    """Return the largest torque that a joint can have in both directions, N m."""
    low, high = np.sum([_torques(model, each) for each in actuators.tolist()], axis=0)
    if model.jnt_actfrclimited[joint]:
        least, most = model.jnt_actfrcrange[joint]
        low, high = max(low, least), min(high, most)
    return float(min(0.0 - low, high))


def _torques(model: mujoco.MjModel, actuator: int) -> tuple[float, float]:
    """Return the lowest and the highest torque of an actuator at its joint, N m."""
    gear = model.actuator_gear[actuator, 0]
    if gear == 0.0:
        return 0.0, 0.0
    low, high = -np.inf, np.inf
    if model.actuator_forcelimited[actuator]:
        low, high = model.actuator_forcerange[actuator]
    is_motor = model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
    if is_motor and model.actuator_ctrllimited[actuator]:
        ends = model.actuator_gainprm[actuator, 0] * model.actuator_ctrlrange[actuator]
        low, high = max(low, ends.min()), min(high, ends.max())
    return min(gear * low, gear * high), max(gear * low, gear * high)


def _range_of(model: mujoco.MjModel, joint: int, actuators: np.ndarray) -> tuple[float, float]:
    """Return the range of a joint, or that of the set-points of its position servo, or a whole turn."""
    ranges = [model.jnt_range[joint]] if model.jnt_limited[joint] else []
    for each in actuators:
        is_servo = model.actuator_biastype[each] == mujoco.mjtBias.mjBIAS_AFFINE
        is_servo &= model.actuator_biasprm[each, 1] == -model.actuator_gainprm[each, 0] != 0
        gear = model.actuator_gear[each, 0]
        if is_servo and model.actuator_ctrllimited[each] and gear != 0.0:
            # The set-point of a servo is the angle times the gear.
            ranges.append(np.sort(model.actuator_ctrlrange[each] / gear))
    low = max((float(low) for low, _ in ranges), default=-np.pi)
    high = min((float(high) for _, high in ranges), default=np.pi)
    return low, high
