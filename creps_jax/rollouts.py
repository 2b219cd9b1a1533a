"""Roll out a batch of parameters for a task, shared out over devices, and see to failures."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from creps_jax.tasks.base import Task, check_outcome
from creps_jax.typing import Array, Bool, Float, PRNGKey

__all__ = ["Devices", "device_tuple", "mean_outcome", "replicate", "roll_out", "share_rows", "spread_rows"]

Devices = Sequence[jax.Device] | None
"""Devices that share the rollouts; None stands for all local ones."""


def device_tuple(devices: Devices) -> tuple[jax.Device, ...]:
    """Return the devices in a form that can be compiled for; all local ones for None.

    Raises:
        ValueError: If there is no device, or something else among them.
    """
    if devices is None:
        return tuple(jax.local_devices())
    given = tuple(devices) if isinstance(devices, Iterable) else ()
    if not given or not all(isinstance(device, jax.Device) for device in given):
        raise ValueError(f"devices must be one device or more, as jax.devices() has them, got {devices!r}")
    return given


@partial(jax.jit, static_argnums=(0, 1))
def roll_out(
    task: Task,
    devices: tuple[jax.Device, ...],
    key: PRNGKey,
    contexts: Float[Array, "n s"],
    thetas: Float[Array, "n d"],
) -> tuple[Any, Bool[Array, " n"]]:
    """Roll out a batch over the devices.

    Args:
        task: What to roll out.
        devices: Devices that share the rollouts.
        key: Random key; that of a rollout follows from its number, whatever device it runs on.
        contexts: Context of each rollout.
        thetas: Parameters of each rollout.

    Returns:
        The task's outcomes (n, ...), where rewards that are not finite are replaced by the task's
        worst, and which rollouts failed so.

    Raises:
        ValueError: If a rollout of the task gives anything but an outcome with one reward.
    """
    num = contexts.shape[0]
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(num))
    rollouts = jax.vmap(lambda *arguments: check_outcome(task.rollout(*arguments)))
    if len(devices) > 1:
        rollouts = _shared_out(rollouts, devices)
    outcomes = rollouts(keys, contexts, thetas)
    is_failed = ~jnp.isfinite(outcomes.reward)
    reward = jnp.where(is_failed, jnp.float32(task.worst_reward), outcomes.reward.astype(jnp.float32))
    return outcomes._replace(reward=reward), is_failed


def replicate(tree: Any, devices: tuple[jax.Device, ...]) -> Any:
    """Put arrays on all devices, where `roll_out` leaves its results.

    A state that an iteration finds elsewhere than it leaves it would have the next one compiled anew.
    """
    if len(devices) == 1:
        return tree
    return jax.device_put(tree, NamedSharding(_mesh(devices), PartitionSpec()))


def spread_rows(tree: Any, devices: tuple[jax.Device, ...]) -> Any:
    """Put the rows of arrays on the devices to which `share_rows` gives them."""
    return jax.device_put(tree, NamedSharding(_mesh(devices), PartitionSpec("rows")))


def mean_outcome(outcomes: Any, is_counted: Bool[Array, " n"]) -> Any:
    """Average each field (n, ...) of outcomes over the rollouts that count; NaN if none does."""

    def mean(field: Array) -> Array:
        mask = is_counted.reshape(is_counted.shape + (1,) * (field.ndim - 1))
        return jnp.mean(field.astype(jnp.float32), axis=0, where=mask)

    return jax.tree.map(mean, outcomes)


def share_rows(function: Callable, devices: tuple[jax.Device, ...]) -> Callable:
    """Share the rows of a function's arguments out over devices, which have to divide their number."""
    rows = PartitionSpec("rows")
    # Unchecked, so that a rollout may start its loops from constants, as it may on one device.
    return jax.shard_map(function, mesh=_mesh(devices), in_specs=rows, out_specs=rows, check_vma=False)


def _mesh(devices: tuple[jax.Device, ...]) -> Mesh:
    return Mesh(np.asarray(devices), ("rows",))


def _shared_out(function: Callable, devices: tuple[jax.Device, ...]) -> Callable:
    """Share a batch out over devices; the last row fills up what does not divide."""
    sharded = share_rows(function, devices)

    def shared_out(*batch: Array) -> Any:
        num = batch[0].shape[0]
        padded = -(-num // len(devices)) * len(devices)
        index = jnp.minimum(jnp.arange(padded), num - 1)
        results = sharded(*(x[index] for x in batch))
        # Every device goes on with all results: the update is small, and equal on each of them.
        results = lax.with_sharding_constraint(results, NamedSharding(_mesh(devices), PartitionSpec()))
        return jax.tree.map(lambda x: x[:num], results)

    return shared_out
