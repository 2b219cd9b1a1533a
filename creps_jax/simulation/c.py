"""Step a robot with position servos by C MuJoCo, one control step of the whole batch at a time."""

import contextlib
import copy
import operator
import os
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jax.experimental.buffer_callback import buffer_callback
from mujoco import rollout

from creps_jax import checks
from creps_jax.simulation.servos import read_servos
from creps_jax.simulation.state import ControlStep, RobotState, substep_shares
from creps_jax.simulation.world import World, changed_fields, world_of
from creps_jax.typing import Array, Float

__all__ = ["make_control_step"]

_LARGEST = 1e10
"""A state beyond this is taken for bad, as C MuJoCo takes it."""


@checks.arguments
def make_control_step(model: mujoco.MjModel, num_substeps: int) -> ControlStep:
    """Return the function that steps the robot through one control step, on the host's cores.

    It does what `simulation.mjx.make_control_step` does, but for rounding. A `jax.vmap` of it is one
    call for the whole batch. A robot whose state or set-points are not finite, or that C MuJoCo finds
    unstable (which it also writes to its log, MUJOCO_LOG.TXT), gets a state of NaN, and one that has such a
    state takes no time. There are no gradients, and later changes of the model are not seen.

    Args:
        model: A model all of whose actuators are position servos on joints.
        num_substeps: Physics steps in a control step.

    Returns:
        The control step, for one robot; vmap it for a batch.

    Raises:
        ValueError: If an actuator is no plain position servo on a joint, or there is no substep.
    """
    shares = substep_shares(num_substeps)
    servos = read_servos(model)
    model = _without_extras(model)
    # Devices call at the same time, each from threads that come and go.
    idle = []
    world_sizes = tuple(np.size(leaf) for leaf in world_of(model))
    # A row is a robot: its state, what its servos are told in each physics step, and the world it is in.
    sizes = (model.nq + model.nv, model.nv, num_substeps * model.nu)
    num_moved = model.nq + 2 * model.nv

    def step_batch(packed: np.ndarray, moved: np.ndarray) -> None:
        rows, moved = packed.reshape(-1, packed.shape[-1]), moved.reshape(-1, moved.shape[-1])
        with _borrowed(idle, partial(_Tools, model, num_substeps)) as tools:
            # As a rule all are sound, and nothing is copied to leave some out.
            if len(rows) and np.abs(rows).max() <= _LARGEST:
                step_rows(tools, rows, moved)
                return
            moved[:] = np.nan
            is_sound = (np.abs(rows[:, : sizes[0]]) <= _LARGEST).all(axis=1)
            is_sound &= np.isfinite(rows[:, sizes[0] : sum(sizes)]).all(axis=1)
            if is_sound.any():
                some = moved[is_sound]
                step_rows(tools, rows[is_sound], some)
                moved[is_sound] = some

    def step_rows(tools: _Tools, rows: np.ndarray, moved: np.ndarray) -> None:
        num = len(rows)
        start, warmstart, control, states = tools.arrays(num)
        state, warm, told, worlds = np.split(rows, np.cumsum(sizes), axis=1)
        # Before them in `start` is the time, 0, which nothing changes.
        start[:, 1:], warmstart[:], control.reshape(num, -1)[:] = state, warm, told
        tools.pool.rollout(
            _models(model, tools.copies, worlds, world_sizes) if worlds.size else [model] * num,
            tools.data,
            start,
            control,
            skip_checks=True,
            nstep=num_substeps,
            initial_warmstart=warmstart,
            state=states,
        )
        end, speeds = states[:, -1], states[:, :, 1 + model.nq :]
        moved[:, : sizes[0]] = end[:, 1:]
        # The solver starts near the last acceleration; what the velocities tell of it is a good guess.
        earlier = speeds[:, -2] if num_substeps > 1 else start[:, 1 + model.nq :]
        np.subtract(speeds[:, -1], earlier, out=warmstart)
        np.divide(warmstart, model.opt.timestep, out=moved[:, sizes[0] :], casting="same_kind")
        # C stands a robot up again whose state has become bad, with a new time, and leaves it there.
        is_lost = end[:, 0] < (num_substeps - 0.5) * model.opt.timestep
        is_lost |= ~(np.abs(end).max(axis=1) <= _LARGEST)
        if is_lost.any():
            moved[is_lost] = np.nan

    def step_buffers(context, moved, packed):
        del context
        step_batch(np.asarray(packed), np.asarray(moved))

    def step_array(packed):
        moved = np.empty((*packed.shape[:-1], num_moved), np.float32)
        step_batch(np.asarray(packed), moved)
        return moved

    def control_step(
        state: RobotState,
        before: Float[Array, " nu"],
        after: Float[Array, " nu"],
        speed: Float[Array, " nu"],
        world: World | None = None,
    ) -> RobotState:
        # One array each way: handing over many costs more than what is in them.
        leaves = () if world is None else (jnp.ravel(jnp.asarray(leaf, jnp.float32)) for leaf in world)
        controls = servos.controls(shares, before, after, speed)
        packed = jnp.concatenate([*state, controls.ravel(), *leaves])
        shape = jax.ShapeDtypeStruct((num_moved,), jnp.float32)
        # Not `jax.pure_callback` on a CPU: in jax 0.9 that copies large arguments on the devices' threads.
        # Where all devices do so at once, none has a thread left to copy with, and all wait for ever.
        moved = lax.platform_dependent(
            packed,
            cpu=buffer_callback(step_buffers, shape, vmap_method="broadcast_all"),
            default=partial(jax.pure_callback, step_array, shape, vmap_method="broadcast_all"),
        )
        return RobotState(*jnp.split(moved, np.cumsum([model.nq, model.nv])))

    return control_step


class _Tools:
    """What one call works with: threads, their data, and models and arrays for the largest call so far."""

    def __init__(self, model: mujoco.MjModel, num_substeps: int) -> None:
        self.data = [mujoco.MjData(model) for _ in range(_threads())]
        # Without a thread of its own, a pool works in the one that calls.
        self.pool = rollout.Rollout(nthread=len(self.data) if len(self.data) > 1 else 0)
        # Models for robots in worlds of their own, as many as a call needed so far.
        self.copies: list[mujoco.MjModel] = []
        size = 1 + model.nq + model.nv
        self._shapes = ((size,), (model.nv,), (num_substeps, model.nu), (num_substeps, size))
        self._arrays = [np.zeros((0, *shape)) for shape in self._shapes]

    def arrays(self, num: int) -> list[np.ndarray]:
        """Return arrays for a number of robots: first states, accelerations, controls and states."""
        if num > len(self._arrays[0]):
            self._arrays = [np.zeros((num, *shape)) for shape in self._shapes]
        return [array[:num] for array in self._arrays]


def _without_extras(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of the model that moves as it does, in a tenth less time."""
    model = copy.copy(model)
    # Sensors only read, and nobody reads them here.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
    # What touches one tree is one island: nothing but sleep needs it to be found.
    if model.ntree == 1 and not model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return model


def _models(model, copies, worlds, sizes):
    """Return a copy of the model for each row of worlds, changed accordingly."""
    copies.extend(copy.copy(model) for _ in range(len(worlds) - len(copies)))
    for here, row in zip(copies, worlds, strict=False):
        leaves = np.split(row, np.cumsum(sizes)[:-1])
        for name, value in changed_fields(model, World(leaves[0], *(leaf[0] for leaf in leaves[1:]))).items():
            operator.attrgetter(name)(here)[:] = value
    return copies[: len(worlds)]


@contextlib.contextmanager
def _borrowed(idle, make):
    """Take something that no one else uses, or make it, and give it back."""
    try:
        item = idle.pop()
    except IndexError:
        item = make()
    try:
        yield item
    finally:
        idle.append(item)


def _threads() -> int:
    """Return the threads of one call: devices call at the same time, and share the cores."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // jax.local_device_count())
