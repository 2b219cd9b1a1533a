"""Roll out a batch of parameters for a task on several devices, and replace rewards that are not finite."""

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
"""Devices that share the rollouts; None means all local devices."""

ChosenDevices = tuple[jax.Device, ...]
"""Devices as a hashable tuple. If it is empty, programs run where their arrays are."""


def device_tuple(devices: Devices) -> ChosenDevices:
    """Return the devices as a hashable tuple; for None all local devices.

    If there is only one local device, None gives an empty tuple: arrays stay where they are.

    Raises:
        ValueError: If there is no device, an entry is not a device, or a device is given twice.
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
    """Roll out a batch on the devices.

    Args:
        task: The task.
        devices: Devices that share the rollouts. With fewer than two devices, rollouts run where the arrays
            are, see `replicate`.
        key: Random key; the key of a rollout follows from the number of the rollout, on any device.
        contexts: Context of each rollout.
        thetas: Parameters of each rollout.

    Returns:
        The task's outcomes (n, ...), in which rewards that are not finite are replaced by the task's worst;
        and which rollouts had such a reward.

    Raises:
        ValueError: If a rollout of the task does not return an outcome with one reward.
    """
    num = contexts.shape[0]
    keys = jax.vmap(jax.random.fold_in, (None, 0))(threefry(key), jnp.arange(num))
    rollouts = jax.vmap(lambda *arguments: check_outcome(task.rollout(*arguments)))
    if len(devices) > 1:
        rollouts = _distributed(rollouts, devices)
    outcomes = rollouts(keys, contexts, thetas)
    is_failed = ~jnp.isfinite(outcomes.reward)
    given = outcomes.reward.dtype
    is_float = jnp.issubdtype(given, jnp.floating) and given.itemsize >= 4
    reward = outcomes.reward.astype(given if is_float else jnp.float32)
    reward = jnp.where(is_failed, jnp.asarray(task.worst_reward, reward.dtype), reward)
    return outcomes._replace(reward=reward), is_failed


def compiled_roll_out(task: Task, devices: ChosenDevices) -> Callable:
    """Return `roll_out` of a task on devices as a compiled function of (key, contexts, thetas).

    The task keeps the program.
    """
    if devices not in task.programs:
        # A copy: the program must not keep alive the task that keeps it.
        task.programs[devices] = jax.jit(partial(roll_out, dataclasses.replace(task), devices))
    return task.programs[devices]


def replicate(tree: Any, devices: ChosenDevices) -> Any:
    """Copy arrays to all chosen devices, where `roll_out` leaves its results.

    An iteration would be compiled again if its state were on other devices than the state that it returns.
    In a traced program this function sets the devices of the program.
    """
    if not devices:
        return tree
    sharding = NamedSharding(_mesh(devices), PartitionSpec())
    if sharding.is_fully_addressable:
        return jax.device_put(tree, sharding)
    return jax.tree.map(partial(_put_everywhere, sharding), tree)


def from_host(tree: Any, devices: ChosenDevices) -> Any:
    """Convert arrays of the host to jax arrays; if one device was chosen, they are on this device.

    They are not committed to it, so that they can be compared with arrays of another run.
    """
    if len(devices) != 1:
        return jax.tree.map(jnp.asarray, tree)
    with jax.default_device(devices[0]):
        return jax.tree.map(jnp.asarray, tree)


def spread_rows(tree: Any, devices: ChosenDevices) -> Any:
    """Put rows of arrays on the devices on which `share_rows` uses them."""
    return jax.device_put(tree, NamedSharding(_mesh(devices), PartitionSpec("rows")))


def mean_outcome(outcomes: Any, is_counted: Bool[Array, " n"]) -> Any:
    """Average each field (n, ...) of outcomes over the counted rollouts; NaN if there are none."""

    def mean(field: Array) -> Array:
        mask = is_counted.reshape(is_counted.shape + (1,) * (field.ndim - 1))
        return jnp.mean(field.astype(jnp.float32), axis=0, where=mask)

    return jax.tree.map(mean, outcomes)


def share_rows(function: Callable, devices: ChosenDevices) -> Callable:
    """Distribute the rows of a function's arguments over devices, equally many to each device."""
    rows = PartitionSpec("rows")
    # Without the check, as it refuses rollouts whose loops start from constants.
    return jax.shard_map(function, mesh=_mesh(devices), in_specs=rows, out_specs=rows, check_vma=False)


def _put_everywhere(sharding: NamedSharding, array: Array) -> Array:
    """Copy an array to the devices of several processes; jax cannot do this with typed keys."""
    if not jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return jax.device_put(array, sharding)
    data = jax.device_put(jax.random.key_data(array), sharding)
    return jax.random.wrap_key_data(data, impl=jax.random.key_impl(array))


def _mesh(devices: ChosenDevices) -> Mesh:
    return Mesh(np.asarray(devices), ("rows",))


def _distributed(function: Callable, devices: ChosenDevices) -> Callable:
    """Distribute a batch over devices; copies of the last row fill it up to a multiple of their number."""
    sharded = share_rows(function, devices)

    def distributed(*batch: Array) -> Any:
        num = batch[0].shape[0]
        padded = -(-num // len(devices)) * len(devices)
        index = jnp.minimum(jnp.arange(padded), num - 1)
        results = sharded(*(x[index] for x in batch))
        # Each device gets all results, and computes the same update, which is small.
        results = lax.with_sharding_constraint(results, NamedSharding(_mesh(devices), PartitionSpec()))
        return jax.tree.map(lambda x: x[:num], results)

    return distributed
