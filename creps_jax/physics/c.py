"""Step a robot with position servos by C MuJoCo, one control step of the whole batch at a time."""

import contextlib
import copy
import operator
import os
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import rollout

from creps_jax import checks
from creps_jax.physics.servos import read_servos
from creps_jax.physics.state import ControlStep, RobotState, substep_shares
from creps_jax.physics.world import World, changed_fields, world_of
from creps_jax.typing import Array, Float

__all__ = ["make_control_step"]

_LARGEST = 1e10
"""A state beyond this is taken for bad, as C MuJoCo takes it."""


@checks.arguments
def make_control_step(model: mujoco.MjModel, num_substeps: int) -> ControlStep:
    """Return the function that steps the robot through one control step, on the host's cores.

    It does what `creps_jax.physics.mjx.make_control_step` does, but for rounding. A `jax.vmap` of it is one
    call for the whole batch. A robot whose state or set-points are not finite, or that C MuJoCo finds
    unstable (which it also writes to its log, MUJOCO_LOG.TXT), gets a state of NaN, and one that has such a
    state takes no time. There are no gradients.

    Args:
        model: A model all of whose actuators are position servos on joints.
        num_substeps: Physics steps in a control step.

    Returns:
        The control step, for one robot; vmap it for a batch.

    Raises:
        ValueError: If an actuator is no plain position servo on a joint, or there is no substep.
    """
    shares = substep_shares(num_substeps)[:, None]
    lead = read_servos(model).lead
    # Devices call at the same time, each from threads that come and go.
    idle = []

    def make():
        data = [mujoco.MjData(model) for _ in range(_threads())]
        # Without a thread of its own, a pool works in the one that calls.
        return _Tools(rollout.Rollout(nthread=len(data) if len(data) > 1 else 0), data, [])

    world_sizes = tuple(np.size(leaf) for leaf in world_of(model))
    sizes = (model.nq, model.nv, model.nv, model.nu, model.nu, model.nu)

    def step_batch(packed):
        rows = np.array(packed, float).reshape(-1, packed.shape[-1])
        qpos, qvel, warmstart, before, after, speed, worlds = np.split(rows, np.cumsum(sizes), axis=1)
        control = before[:, None] + shares * (after - before)[:, None] + (lead * speed)[:, None]
        start = np.concatenate([np.zeros((len(qpos), 1)), qpos, qvel], axis=1)
        moved = np.full((len(rows), sum(sizes[:3])), np.nan, np.float32)
        is_sound = (np.abs(start) <= _LARGEST).all(axis=1) & np.isfinite(control).all(axis=(1, 2))
        if not is_sound.any():
            return moved.reshape(*packed.shape[:-1], -1)
        start, control, warmstart, qvel, worlds = (
            array[is_sound] for array in (start, control, warmstart, qvel, worlds)
        )
        with _borrowed(idle, make) as (pool, data, copies):
            models = _models(model, copies, worlds, world_sizes) if worlds.size else [model] * len(start)
            states = np.empty((len(start), num_substeps, start.shape[1]))
            pool.rollout(
                models,
                data,
                start,
                control,
                skip_checks=True,
                nstep=num_substeps,
                initial_warmstart=warmstart,
                state=states,
            )
        # C stands a robot up again whose state has become bad, with a new time, and leaves it there.
        is_lost = states[:, -1, 0] < (num_substeps - 0.5) * model.opt.timestep
        is_lost |= ~(np.abs(states[:, -1]) <= _LARGEST).all(axis=1)
        states[is_lost] = np.nan
        end = states[:, -1, 1 + model.nq :]
        # The solver starts near the last acceleration; what the velocities tell of it is a good guess.
        earlier = states[:, -2, 1 + model.nq :] if num_substeps > 1 else qvel
        moved[is_sound] = np.concatenate([states[:, -1, 1:], (end - earlier) / model.opt.timestep], axis=1)
        return moved.reshape(*packed.shape[:-1], -1)

    def control_step(
        state: RobotState,
        before: Float[Array, " nu"],
        after: Float[Array, " nu"],
        speed: Float[Array, " nu"],
        world: World | None = None,
    ) -> RobotState:
        # One array each way: handing over many costs more than what is in them.
        leaves = () if world is None else (jnp.ravel(jnp.asarray(leaf, jnp.float32)) for leaf in world)
        packed = jnp.concatenate([*state, before, after, speed, *leaves])
        shape = jax.ShapeDtypeStruct((sum(sizes[:3]),), jnp.float32)
        moved = jax.pure_callback(step_batch, shape, packed, vmap_method="broadcast_all")
        return RobotState(*jnp.split(moved, np.cumsum(sizes[:2])))

    return control_step


class _Tools(NamedTuple):
    """What one call works with."""

    pool: rollout.Rollout
    data: list[mujoco.MjData]
    copies: list[mujoco.MjModel]
    """Models for robots in worlds of their own, as many as a call needed so far."""


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
