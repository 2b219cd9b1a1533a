"""Simulate a robot with position servos by MJX, one control step at a time."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
from jax import lax
from jax.scipy.linalg import cho_factor, cho_solve
from mujoco import mjx

from creps_jax import checks
from creps_jax.simulation.servos import Servos, read_servos
from creps_jax.simulation.state import ControlStep, RobotState, substep_shares
from creps_jax.simulation.world import World, changed_fields
from creps_jax.typing import Array, Float

__all__ = ["make_control_step"]

_POSITION_STAGES = (mjx.kinematics, mjx.com_pos, mjx.crb, mjx.collision, mjx.make_constraint)
_VELOCITY_STAGES = (mjx.com_vel, mjx.passive, mjx.rne)


@checks.arguments
def make_control_step(model: mujoco.MjModel, num_substeps: int) -> ControlStep:
    """Return the function that simulates one control step of the robot.

    The set-points of the servos move linearly from those before to those after. Each servo also receives the
    speed of its set-point, rad/s: its damping then acts on the speed error and not on the motion itself.

    Args:
        model: A model with the implicitfast integrator and the Newton solver, whose actuators are all
            position servos on joints. External forces, tendons and sensors are ignored.
        num_substeps: Number of physics steps in a control step.

    Returns:
        The control step for one robot; vmap it for a batch.

    Raises:
        ValueError: If an actuator is not a plain position servo on a joint, the integrator or the solver is
            another one, or `num_substeps` is below 1.
    """
    shares, servos = substep_shares(num_substeps), read_servos(model)
    step = _make_step(model, servos)
    device_model = mjx.put_model(model)

    def control_step(
        state: RobotState,
        before: Float[Array, " nu"],
        after: Float[Array, " nu"],
        speed: Float[Array, " nu"],
        world: World | None = None,
    ) -> RobotState:
        here = device_model
        if world is not None:
            # As jax arrays: of NumPy arrays MJX requires that they are equal for all bodies.
            here = here.tree_replace(jax.tree.map(jnp.asarray, changed_fields(model, world)))

        def substep(state, control):
            return step(here, state, control), None

        controls = servos.controls(shares, before, after, speed)
        return lax.scan(substep, state, controls)[0]

    return control_step


def _make_step(model: mujoco.MjModel, servos: Servos) -> Callable[[mjx.Model, RobotState, Array], RobotState]:
    """Return `mj_step` as a function of (model, state, controls of the servos), composed of stages of MJX.

    `mjx.step` has more stages, which take time and have no effect on a robot with plain servos and without
    external forces: Jacobians of all bodies for such forces, and moment matrices of the actuators.
    """
    for name, found, expected in (
        ("integrator", model.opt.integrator, mujoco.mjtIntegrator.mjINT_IMPLICITFAST),
        ("solver", model.opt.solver, mujoco.mjtSolver.mjSOL_NEWTON),
    ):
        if found != expected:
            raise ValueError(f"the {name} must be {expected.name}, got {type(expected)(found).name}")
    # The damping is made implicit below, as in implicitfast; `mjx.euler` then only integrates.
    integrates_only = {"opt.disableflags": model.opt.disableflags | mujoco.mjtDisableBit.mjDSBL_EULERDAMP}
    # A loop over steps carries only the state; the rest of mjx.Data is created in each step at no cost.
    blank = mjx.make_data(model)
    timestep = float(model.opt.timestep)

    def step(device_model: mjx.Model, state: RobotState, control: Array) -> RobotState:
        data = blank.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart)
        for stage in _POSITION_STAGES + _VELOCITY_STAGES:
            data = stage(device_model, data)
        torque, damping = _servo_torques(servos, data, control)
        inertia = mjx.full_m(device_model, data)
        qfrc_smooth = data.qfrc_passive - data.qfrc_bias + torque
        qacc_smooth = cho_solve(cho_factor(inertia, lower=True), qfrc_smooth)
        data = data.replace(qfrc_smooth=qfrc_smooth, qacc_smooth=qacc_smooth)
        data = mjx.solve(device_model, data)
        # implicitfast: the damping acts on the velocity at the end of the step.
        damped = inertia + timestep * jnp.diag(damping + device_model.dof_damping)
        qacc = cho_solve(cho_factor(damped, lower=True), qfrc_smooth + data.qfrc_constraint)
        moved = mjx.euler(device_model.tree_replace(integrates_only), data.replace(qacc=qacc))
        return RobotState(moved.qpos, moved.qvel, data.qacc)

    return step


def _servo_torques(servos: Servos, data: mjx.Data, control: Array) -> tuple[Array, Array]:
    """Return torques and damping coefficients of the servos, one for each degree of freedom."""
    control = jnp.clip(control, *servos.control_range)
    wanted = servos.stiffness * (control - data.qpos[servos.qpos_index])
    wanted = wanted - servos.damping * data.qvel[servos.qvel_index]
    torque = jnp.clip(wanted, *servos.torque_range)
    # A torque at its limit does not depend on the velocity.
    damping = jnp.where(torque == wanted, servos.damping, 0.0)
    zeros = jnp.zeros_like(data.qvel)
    return zeros.at[servos.qvel_index].add(torque), zeros.at[servos.qvel_index].add(damping)
