"""Roll out a batch of parameters for a task, shared out over devices, and see to failures."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from creps_jax.keys import threefry
from creps_jax.tasks.base import Task, check_outcome
from creps_jax.typing import Array, Bool, Float, PRNGKey

__all__ = [
    "Devices",
    "compiled_roll_out",
    "device_tuple",
    "from_host",
    "mean_outcome",
    "replicate",
    "roll_out",
    "share_rows",
    "spread_rows",
]

Devices = Sequence[jax.Device] | None
"""Devices that share the rollouts; None stands for all local ones."""

ChosenDevices = tuple[jax.Device, ...]
"""Devices in a form that can be compiled for; none of them: wherever the arrays are."""


def device_tuple(devices: Devices) -> ChosenDevices:
    """Return the devices in a form that can be compiled for; all local ones for None.

    Where there is only one local device, None chooses nothing: arrays stay where they are.

    Raises:
        ValueError: If there is no device, or something else among them, or one of them twice.
    """
    if devices is None:
        local = tuple(jax.local_devices())
        return local if len(local) > 1 else ()
    given = tuple(devices) if isinstance(devices, Iterable) else ()
    if not given or not all(isinstance(device, jax.Device) for device in given):
        raise ValueError(f"devices must be one device or more, as jax.devices() has them, got {devices!r}")
    if len(set(given)) < len(given):
        raise ValueError(f"devices must be given once each, got {devices!r}")
    return given


def roll_out(
    task: Task,
    devices: ChosenDevices,
    key: PRNGKey,
    contexts: Float[Array, "n s"],
    thetas: Float[Array, "n d"],
) -> tuple[Any, Bool[Array, " n"]]:
    """Roll out a batch over the devices.

    Args:
        task: What to roll out.
        devices: Devices that share the rollouts. With fewer than two they run where the arrays are, see
            `replicate`.
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
    keys = jax.vmap(jax.random.fold_in, (None, 0))(threefry(key), jnp.arange(num))
    rollouts = jax.vmap(lambda *arguments: check_outcome(task.rollout(*arguments)))
    if len(devices) > 1:
        rollouts = _shared_out(rollouts, devices)
    outcomes = rollouts(keys, contexts, thetas)
    is_failed = ~jnp.isfinite(outcomes.reward)
    given = outcomes.reward.dtype
    is_float = jnp.issubdtype(given, jnp.floating) and given.itemsize >= 4
    reward = outcomes.reward.astype(given if is_float else jnp.float32)
    reward = jnp.where(is_failed, jnp.asarray(task.worst_reward, reward.dtype), reward)
    return outcomes._replace(reward=reward), is_failed


def compiled_roll_out(task: Task, devices: ChosenDevices) -> Callable:
    """Return `roll_out` of a task over devices, compiled: (key, contexts, thetas). The task keeps it."""
    if devices not in task.programs:
        # A copy: the program must not keep alive the task that keeps it.
        task.programs[devices] = jax.jit(partial(roll_out, dataclasses.replace(task), devices))
    return task.programs[devices]


def replicate(tree: Any, devices: ChosenDevices) -> Any:
    """Put arrays on all chosen devices, where `roll_out` leaves its results, from wherever they are.

    A state that an iteration finds elsewhere than it leaves it would have the next one compiled anew. While a
    program is traced, this says on which devices it runs.
    """
    if not devices:
        return tree
    sharding = NamedSharding(_mesh(devices), PartitionSpec())
    if sharding.is_fully_addressable:
        return jax.device_put(tree, sharding)
    return jax.tree.map(partial(_put_everywhere, sharding), tree)


def from_host(tree: Any, devices: ChosenDevices) -> Any:
    """Make jax arrays of those of the host; where one device was chosen, it holds them.

    They are not bound to it, so that they can be compared with those of another run.
    """
    if len(devices) != 1:
        return jax.tree.map(jnp.asarray, tree)
    with jax.default_device(devices[0]):
        return jax.tree.map(jnp.asarray, tree)


def spread_rows(tree: Any, devices: ChosenDevices) -> Any:
    """Put the rows of arrays on the devices to which `share_rows` gives them."""
    return jax.device_put(tree, NamedSharding(_mesh(devices), PartitionSpec("rows")))


def mean_outcome(outcomes: Any, is_counted: Bool[Array, " n"]) -> Any:
    """Average each field (n, ...) of outcomes over the rollouts that count; NaN if none does."""

    def mean(field: Array) -> Array:
        mask = is_counted.reshape(is_counted.shape + (1,) * (field.ndim - 1))
        return jnp.mean(field.astype(jnp.float32), axis=0, where=mask)

    return jax.tree.map(mean, outcomes)


def share_rows(function: Callable, devices: ChosenDevices) -> Callable:
    """Share the rows of a function's arguments out over devices, which have to divide their number."""
    rows = PartitionSpec("rows")
    # Unchecked, so that a rollout may start its loops from constants, as it may on one device.
    return jax.shard_map(function, mesh=_mesh(devices), in_specs=rows, out_specs=rows, check_vma=False)


def _put_everywhere(sharding: NamedSharding, array: Array) -> Array:
    """Put an array on the devices of several processes, which jax does not do with typed keys."""
    if not jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return jax.device_put(array, sharding)
    data = jax.device_put(jax.random.key_data(array), sharding)
    return jax.random.wrap_key_data(data, impl=jax.random.key_impl(array))


def _mesh(devices: ChosenDevices) -> Mesh:
    return Mesh(np.asarray(devices), ("rows",))


def _shared_out(function: Callable, devices: ChosenDevices) -> Callable:
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
