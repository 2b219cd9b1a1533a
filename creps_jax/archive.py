"""Keep the last L samples in a ring buffer of fixed shape (Abdolmaleki et al. 2016, Section 4)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from creps_jax import checks
from creps_jax.typing import Array, Bool, Float, Int, IntScalar

__all__ = ["Archive", "Batch", "empty_archive", "push", "valid"]


class Batch(NamedTuple):
    """Samples as they were drawn and measured; those with anything non-finite carry no information."""

    context: Float[Array, "n s"]
    theta: Float[Array, "n d"]
    reward: Float[Array, " n"]


class Archive(NamedTuple):
    """The last L samples, where `batch` has L slots.

    Attributes:
        batch: The slots, in no particular order of age; slots never written hold zeros.
        next_index: The slot that the next sample goes to.
        size: How many slots have been written, at most L.
        age: How many batches were pushed after that of each slot.
    """

    batch: Batch
    next_index: IntScalar
    size: IntScalar
    age: Int[Array, " L"]


@checks.arguments
def empty_archive(archive_size: int, context_dim: int, theta_dim: int) -> Archive:
    """Make an archive of `archive_size` empty slots.

    Raises:
        ValueError: If `archive_size` is no whole number of at least 1.
    """
    batch = Batch(
        context=jnp.zeros((archive_size, context_dim), jnp.float32),
        theta=jnp.zeros((archive_size, theta_dim), jnp.float32),
        reward=jnp.zeros(archive_size, jnp.float32),
    )
    zero = jnp.zeros((), jnp.int32)
    return Archive(batch, next_index=zero, size=zero, age=jnp.zeros(archive_size, jnp.int32))


def push(archive: Archive, batch: Batch) -> Archive:
    """Add a batch of samples, each in the place of the oldest once the archive is full.

    Of a batch larger than the archive its last L samples stay, as if they were added one by one.
    """
    archive_size = archive.batch.reward.shape[0]
    num_new = batch.reward.shape[0]
    first_kept = max(0, num_new - archive_size)
    slots = (archive.next_index + jnp.arange(first_kept, num_new, dtype=jnp.int32)) % archive_size
    return Archive(
        batch=jax.tree.map(lambda old, new: old.at[slots].set(new[first_kept:]), archive.batch, batch),
        next_index=(archive.next_index + num_new) % archive_size,
        size=jnp.minimum(archive.size + num_new, archive_size),
        age=(archive.age + 1).at[slots].set(0),
    )


def valid(archive: Archive) -> Bool[Array, " L"]:
    """Tell which slots can be learned from: those written with finite numbers only."""
    context, theta, reward = archive.batch
    is_written = jnp.arange(reward.shape[0], dtype=jnp.int32) < archive.size
    is_finite = (
        jnp.isfinite(reward) & jnp.all(jnp.isfinite(context), axis=1) & jnp.all(jnp.isfinite(theta), axis=1)
    )
    return is_written & is_finite
