"""The position servos of a robot, read from its MuJoCo model."""

from typing import NamedTuple

import mujoco
import numpy as np

from creps_jax.typing import Array, Float, Int

__all__ = ["Servos", "read_servos"]


class Servos(NamedTuple):
    """The position servos of a robot, each on a joint with one degree of freedom.

    Attributes:
        stiffness: Torque per position error, N m/rad.
        damping: Torque per speed error, N m s/rad.
        joint_damping: Torque per speed with which the joint itself resists, N m s/rad.
        control_range: Lowest and highest set-points, rad.
        torque_range: Lowest and highest torques, N m.
        qpos_index: Index of each joint's position in qpos.
        qvel_index: Index of each joint's speed in qvel.
    """

    stiffness: Float[np.ndarray, " nu"]
    damping: Float[np.ndarray, " nu"]
    joint_damping: Float[np.ndarray, " nu"]
    control_range: Float[np.ndarray, "2 nu"]
    torque_range: Float[np.ndarray, "2 nu"]
    qpos_index: Int[np.ndarray, " nu"]
    qvel_index: Int[np.ndarray, " nu"]

    @property
    def lead(self) -> Float[np.ndarray, " nu"]:
        """Time by which a set-point must lead, so that the damping does not hold back the motion, s."""
        return (self.damping + self.joint_damping) / self.stiffness

    def controls(
        self,
        shares: Float[np.ndarray, " n"],
        before: Float[Array | np.ndarray, "*b nu"],
        after: Float[Array | np.ndarray, "*b nu"],
        speed: Float[Array | np.ndarray, "*b nu"],
    ) -> Float[Array | np.ndarray, "*b n nu"]:
        """Return the controls of the servos in each physics step of a control step, rad.

        They are the set-points, interpolated between both ends of the control step, ahead by `lead`.

        Args:
            shares: Share of the control step after each physics step, see `simulation.state.substep_shares`.
            before: Set-points at the start of the control step, rad.
            after: Set-points at its end, rad.
            speed: The set-points' speed, rad/s.
        """
        shares = shares.astype(before.dtype)
        first, way, ahead = (x[..., None, :] for x in (before, after - before, self.lead * speed))
        return first + shares[:, None] * way + ahead


def read_servos(model: mujoco.MjModel) -> Servos:
    """Read the servos of a model.

    Raises:
        ValueError: If an actuator is not a plain position servo on a joint; the message names them.
    """
    stiffness, damping = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
    is_servo = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    joint = np.where(is_servo, model.actuator_trnid[:, 0], 0)
    is_servo &= (model.actuator_gaintype == mujoco.mjtGain.mjGAIN_FIXED) & (stiffness > 0)
    is_servo &= model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    is_servo &= (model.actuator_biasprm[:, 0] == 0) & (model.actuator_biasprm[:, 1] == -stiffness)
    is_servo &= model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE
    is_servo &= (model.actuator_gear[:, 0] == 1) & (model.jnt_actfrclimited[joint] == 0)
    is_servo &= np.isin(model.jnt_type[joint], [mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE])
    if not is_servo.all():
        names = [model.actuator(i).name for i in np.flatnonzero(~is_servo)]
        raise ValueError(f"actuators must be position servos on joints, got others: {names}")
    control_range = _range(model.actuator_ctrllimited, model.actuator_ctrlrange)
    torque_range = _range(model.actuator_forcelimited, model.actuator_forcerange)
    return Servos(
        stiffness.astype(np.float32),
        damping.astype(np.float32),
        model.dof_damping[model.jnt_dofadr[joint]].astype(np.float32),
        control_range.astype(np.float32),
        torque_range.astype(np.float32),
        qpos_index=model.jnt_qposadr[joint],
        qvel_index=model.jnt_dofadr[joint],
    )


def _range(is_limited: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """Return the lowest and the highest value of each actuator (2, nu), infinite without limits."""
    return np.where(is_limited.astype(bool), limits.T, [[-np.inf], [np.inf]])
