"""Simulate a robot with position servos by C MuJoCo, one control step of the whole batch at a time."""

import contextlib
import copy
import operator
import os
from collections.abc import Iterator
from functools import partial
from typing import Any

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
from creps_jax.simulation.world import World, changed_fields
from creps_jax.typing import Array, Float

__all__ = ["make_control_step"]

_LARGEST = 1e10
"""Largest sound entry of a state, as in C MuJoCo (mjMAXVAL)."""


@checks.arguments
def make_control_step(model: mujoco.MjModel, num_substeps: int) -> ControlStep:
    """Return the function that simulates one control step of the robot on the cores of the host.

    Its results equal those of `simulation.mjx.make_control_step` up to rounding. A `jax.vmap` of it is one
    call for the whole batch. A robot gets a state of NaN if its state or its set-points are not finite, or if
    C MuJoCo finds it unstable (and writes so to its log, MUJOCO_LOG.TXT); a robot in such a state takes no
    time. There are no gradients. Later changes of the model have no effect.

    Args:
        model: A model whose actuators are all position servos on joints.
        num_substeps: Number of physics steps in a control step.

    Returns:
        The control step for one robot; vmap it for a batch.

    Raises:
        ValueError: If an actuator is not a plain position servo on a joint, or `num_substeps` is below 1.
    """
    shares, servos = substep_shares(num_substeps), read_servos(model)
    simulator = _Simulator(_without_extras(model), num_substeps)
    shape = jax.ShapeDtypeStruct((model.nq + 2 * model.nv,), jnp.float32)

    def control_step(
        state: RobotState,
        before: Float[Array, " nu"],
        after: Float[Array, " nu"],
        speed: Float[Array, " nu"],
        world: World | None = None,
    ) -> RobotState:
        # One array in each direction: the number of arrays costs more than their size.
        leaves = () if world is None else (jnp.ravel(jnp.asarray(leaf, jnp.float32)) for leaf in world)
        controls = servos.controls(shares, before, after, speed)
        packed = jnp.concatenate([*state, controls.ravel(), *leaves])
        # Not `jax.pure_callback` on a CPU: in jax 0.9 it copies large arguments on the threads of the
        # devices. If all devices call it at once, no thread is left for the copies, and all wait for ever.
        moved = lax.platform_dependent(
            packed,
            cpu=buffer_callback(simulator.step_buffers, shape, vmap_method="broadcast_all"),
            default=partial(jax.pure_callback, simulator.step_array, shape, vmap_method="broadcast_all"),
        )
        return RobotState(*jnp.split(moved, np.cumsum([model.nq, model.nv])))

    return control_step


class _Workspace:
    """Threads with their data, copies of the model, and arrays; all grow to the largest call so far."""

    def __init__(self, model: mujoco.MjModel, num_substeps: int) -> None:
        self.data = [mujoco.MjData(model) for _ in range(_num_threads())]
        # A pool without threads of its own works in the thread of the caller.
        self.pool = rollout.Rollout(nthread=len(self.data) if len(self.data) > 1 else 0)
        self._model = model
        self._copies: list[mujoco.MjModel] = []
        size = 1 + model.nq + model.nv
        self._shapes = ((size,), (model.nv,), (num_substeps, model.nu), (num_substeps, size))
        self._arrays = [np.zeros((0, *shape)) for shape in self._shapes]

    def arrays(self, num: int) -> list[np.ndarray]:
        """Return arrays for a number of robots: first states, warm starts, controls and all states."""
        if num > len(self._arrays[0]):
            self._arrays = [np.zeros((num, *shape)) for shape in self._shapes]
        return [array[:num] for array in self._arrays]

    def models(self, worlds: np.ndarray) -> list[mujoco.MjModel]:
        """Return a model for each row of packed worlds (n, w); with w = 0 all are the unchanged model."""
        num = len(worlds)
        if not worlds.size:
            return [self._model] * num
        self._copies.extend(copy.copy(self._model) for _ in range(num - len(self._copies)))
        for model, (*gravity, payload, friction) in zip(self._copies, worlds, strict=False):
            world = World(np.array(gravity), payload, friction)
            for name, value in changed_fields(self._model, world).items():
                operator.attrgetter(name)(model)[:] = value
        return self._copies[:num]


class _Simulator:
    """Simulate one control step of a batch of robots; each row of the arrays is one robot.

    A row of `packed` holds its state, the controls of all physics steps, and its world if it has its own.
    A row of `moved` receives its next state.
    """

    def __init__(self, model: mujoco.MjModel, num_substeps: int) -> None:
        self._model, self._num_substeps = model, num_substeps
        # In `packed`: position and velocity, warm start, controls. The rest of the row is the world.
        self._sizes = (model.nq + model.nv, model.nv, num_substeps * model.nu)
        # Several devices call at the same time, from threads that are not kept.
        self._idle: list[_Workspace] = []

    def step_buffers(self, context: Any, moved: Any, packed: Any) -> None:
        """Step a batch between buffers of jax."""
        del context
        self._step(np.asarray(packed), np.asarray(moved))

    def step_array(self, packed: Any) -> np.ndarray:
        """Step a batch of packed rows, and return the moved rows."""
        moved = np.empty((*packed.shape[:-1], self._model.nq + 2 * self._model.nv), np.float32)
        self._step(np.asarray(packed), moved)
        return moved

    def _step(self, packed: np.ndarray, moved: np.ndarray) -> None:
        rows, moved = packed.reshape(-1, packed.shape[-1]), moved.reshape(-1, moved.shape[-1])
        with self._workspace() as workspace:
            # Usually all rows are sound, and none has to be copied.
            if len(rows) and np.abs(rows).max() <= _LARGEST:
                self._step_sound(workspace, rows, moved)
                return
            moved[:] = np.nan
            is_sound = self._is_sound(rows)
            if is_sound.any():
                moved_sound = moved[is_sound]
                self._step_sound(workspace, rows[is_sound], moved_sound)
                moved[is_sound] = moved_sound

    def _is_sound(self, rows: np.ndarray) -> np.ndarray:
        """Return which rows have a state within C MuJoCo's limits, and finite warm starts and controls."""
        num_state, num_known = self._sizes[0], sum(self._sizes)
        is_bounded = (np.abs(rows[:, :num_state]) <= _LARGEST).all(axis=1)
        return np.logical_and(is_bounded, np.isfinite(rows[:, num_state:num_known]).all(axis=1))

    def _step_sound(self, workspace: _Workspace, rows: np.ndarray, moved: np.ndarray) -> None:
        num, nq, timestep = len(rows), self._model.nq, self._model.opt.timestep
        start, warmstart, control, states = workspace.arrays(num)
        state, packed_warmstart, packed_control, worlds = np.split(rows, np.cumsum(self._sizes), axis=1)
        # The first column of `start` is the time, which stays 0.
        start[:, 1:], warmstart[:] = state, packed_warmstart
        control.reshape(num, -1)[:] = packed_control
        workspace.pool.rollout(
            workspace.models(worlds),
            workspace.data,
            start,
            control,
            skip_checks=True,
            nstep=self._num_substeps,
            initial_warmstart=warmstart,
            state=states,
        )
        end, speeds = states[:, -1], states[:, :, 1 + nq :]
        moved[:, : self._sizes[0]] = end[:, 1:]
        # The solver starts near the last acceleration; the difference of velocities is a good estimate of it.
        earlier = speeds[:, -2] if self._num_substeps > 1 else start[:, 1 + nq :]
        np.subtract(speeds[:, -1], earlier, out=warmstart)
        np.divide(warmstart, timestep, out=moved[:, self._sizes[0] :], casting="same_kind")
        # C MuJoCo resets a robot whose state has become bad: its time starts again at 0.
        is_lost = end[:, 0] < (self._num_substeps - 0.5) * timestep
        is_lost |= ~(np.abs(end).max(axis=1) <= _LARGEST)
        if is_lost.any():
            moved[is_lost] = np.nan

    @contextlib.contextmanager
    def _workspace(self) -> Iterator[_Workspace]:
        """Lend an idle workspace, or a new one."""
        try:
            workspace = self._idle.pop()
        except IndexError:
            workspace = _Workspace(self._model, self._num_substeps)
        try:
            yield workspace
        finally:
            self._idle.append(workspace)


def _without_extras(model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of the model that moves in the same way and takes a tenth less time."""
    model = copy.copy(model)
    # Nothing here reads the sensors.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
    # The contacts of a single tree are one island; finding it serves only MuJoCo's sleep.
    if model.ntree == 1 and not model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return model


def _num_threads() -> int:
    """Return the number of threads of one call: devices call at the same time, and share the cores."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // jax.local_device_count())
