"""Step a robot with position servos by MJX, one control step at a time."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from mujoco import mjx

from creps_jax.typing import Array, Float

__all__ = ["ControlStep", "RobotState", "initial_state", "make_control_step"]


class RobotState(NamedTuple):
    """All that MuJoCo carries from one step to the next.

    Attributes:
        qpos: Generalised positions (free joint first: position, wxyz quaternion), m and rad.
        qvel: Generalised velocities, m/s and rad/s.
        qacc_warmstart: Acceleration from which the contact solver starts.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    qacc_warmstart: Float[Array, " nv"]


ControlStep = Callable[[RobotState, Array, Array], RobotState]
"""(state, set-points before, set-points after) -> state one control step later."""


def initial_state(qpos: Float[Array, " nq"], num_velocities: int) -> RobotState:
    """Return the state at rest in a position."""
    zeros = jnp.zeros(num_velocities, qpos.dtype)
    return RobotState(qpos, zeros, zeros)


def make_control_step(model: mujoco.MjModel, num_substeps: int) -> ControlStep:
    """Return the function that steps the robot through one control step.

    The set-points of the servos move at constant speed from the ones before to the ones after. Each servo
    is told that speed too, so that its damping acts on the error of the speed and not on the motion
    itself.

    Args:
        model: A model all of whose actuators are position servos.
        num_substeps: Physics steps in a control step.

    Returns:
        The control step, for one robot; vmap it for a batch.

    Raises:
        ValueError: If an actuator is no position servo, or there is no substep.
    """
    if num_substeps < 1:
        raise ValueError(f"num_substeps must be at least 1, got {num_substeps}")
    speed_lead = _speed_lead(model)
    device_model = mjx.put_model(model)
    # Only what the state holds goes round the loop; the rest of mjx.Data is made anew in each step and
    # costs nothing.
    blank = mjx.make_data(model)
    control_period = num_substeps * model.opt.timestep

    def control_step(
        state: RobotState, before: Float[Array, " nu"], after: Float[Array, " nu"]
    ) -> RobotState:
        lead = jnp.asarray(speed_lead, before.dtype) * (after - before) / control_period

        def substep(state, share):
            data = blank.replace(
                qpos=state.qpos,
                qvel=state.qvel,
                qacc_warmstart=state.qacc_warmstart,
                ctrl=before + share * (after - before) + lead,
            )
            data = mjx.step(device_model, data)
            return RobotState(data.qpos, data.qvel, data.qacc_warmstart), None

        shares = jnp.arange(1, num_substeps + 1, dtype=before.dtype) / num_substeps
        return lax.scan(substep, state, shares)[0]

    return control_step


def _speed_lead(model: mujoco.MjModel) -> np.ndarray:
    """Return by how much, per speed, a set-point is to run ahead: damping over stiffness of the servo, s."""
    stiffness, damping = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
    is_servo = (model.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE) & (stiffness > 0)
    is_servo &= model.actuator_biasprm[:, 1] == -stiffness
    if not is_servo.all():
        names = [model.actuator(i).name for i in np.flatnonzero(~is_servo)]
        raise ValueError(f"every actuator must be a position servo, these are not: {names}")
    return damping / stiffness
