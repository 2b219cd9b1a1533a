"""Keep the last L samples in a ring buffer of fixed shape (Abdolmaleki et al. 2016, Section 4).

Rewards that are more precise than the archive are stored as a rounded value and a remainder.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from creps_jax import checks
from creps_jax.search.dual_scaling import ROUNDING
from creps_jax.typing import Array, Bool, Float, Int, IntScalar, Scalar, ScalarLike

__all__ = ["Archive", "Batch", "centred_reward", "empty_archive", "push", "split_reward"]


class Batch(NamedTuple):
    """Samples as drawn and measured; a sample with a value that is not finite is not used."""

    context: Float[Array, "n s"]
    theta: Float[Array, "n d"]
    reward: Float[Array, " n"]


class Archive(NamedTuple):
    """The last L samples, where `batch` has L slots.

    Attributes:
        batch: The slots, not ordered by age. Slots never written, and values that were not finite, hold
            zeros.
        next_index: The slot of the next sample.
        size: Number of slots that have been written, at most L.
        age: Number of batches that were pushed after the batch of each slot.
        is_valid: Which slots hold a sample whose values were all finite.
        reward_rest: Each given reward minus its value in the precision of the archive: float64 rewards keep
            their differences in a float32 archive even with a large common offset.
        reward_rounding: Rounding error of each reward in the format in which it was given.
    """

    batch: Batch
    next_index: IntScalar
    size: IntScalar
    age: Int[Array, " L"]
    is_valid: Bool[Array, " L"]
    reward_rest: Float[Array, " L"]
    reward_rounding: Float[Array, " L"]


@checks.arguments
def empty_archive(
    archive_size: int, context_dim: int, theta_dim: int, dtype: DTypeLike = jnp.float32
) -> Archive:
    """Make an archive of `archive_size` empty slots, with numbers in the given precision.

    Raises:
        ValueError: If `archive_size` is not a whole number of at least 1.
    """
    numbers = jnp.zeros(archive_size, dtype)
    zero = jnp.zeros((), jnp.int32)
    return Archive(
        batch=Batch(
            context=jnp.zeros((archive_size, context_dim), dtype),
            theta=jnp.zeros((archive_size, theta_dim), dtype),
            reward=numbers,
        ),
        next_index=zero,
        size=zero,
        age=jnp.zeros(archive_size, jnp.int32),
        is_valid=jnp.zeros(archive_size, bool),
        reward_rest=numbers,
        reward_rounding=numbers,
    )


def push(
    archive: Archive,
    batch: Batch,
    reward_rest: Float[Array, " n"] | None = None,
    reward_eps: ScalarLike | None = None,
) -> Archive:
    """Add a batch of samples, which replace the oldest ones once the archive is full.

    If the batch is larger than the archive, its last L samples stay, as if they were added one by one.

    Args:
        archive: The archive.
        batch: The samples, in the precision of the archive.
        reward_rest: Given rewards minus their values in that precision, see `split_reward`; zero by default.
        reward_eps: Machine epsilon of the format in which the rewards were given; by default the format of
            the archive.

    Returns:
        The new archive.
    """
    archive_size = archive.batch.reward.shape[0]
    num_new = batch.reward.shape[0]
    first_kept = max(0, num_new - archive_size)
    slots = (archive.next_index + jnp.arange(first_kept, num_new, dtype=jnp.int32)) % archive_size
    is_finite = _is_finite(batch)
    # NaN would stop a program that runs with `jax_debug_nans`.
    batch = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x), x, jnp.zeros_like(x)), batch)
    eps = jnp.finfo(batch.reward.dtype).eps
    rest = jnp.zeros_like(batch.reward)
    if reward_rest is not None:
        rest = jnp.where(is_finite, reward_rest, rest)
    given_eps = eps if reward_eps is None else jnp.asarray(reward_eps, batch.reward.dtype)
    rounding = given_eps * jnp.abs(batch.reward) + eps * jnp.abs(rest)

    def put(old: Array, new: Array) -> Array:
        return old.at[slots].set(new[first_kept:])

    return Archive(
        batch=jax.tree.map(put, archive.batch, batch),
        next_index=(archive.next_index + num_new) % archive_size,
        size=jnp.minimum(archive.size + num_new, archive_size),
        age=(archive.age + 1).at[slots].set(0),
        is_valid=put(archive.is_valid, is_finite),
        reward_rest=put(archive.reward_rest, rest),
        reward_rounding=put(archive.reward_rounding, rounding),
    )


def split_reward(
    reward: Array | np.ndarray, dtype: DTypeLike
) -> tuple[Array | np.ndarray, Array | np.ndarray]:
    """Split rewards into a value in the precision of an archive, and a remainder.

    Args:
        reward: Rewards (n,), of any precision; NumPy splits NumPy arrays, before jax narrows them.
        dtype: The precision of the archive.

    Returns:
        Rounded rewards and remainders; their sum is the given reward, to about twice as many digits.
    """
    # A reward too large for the format becomes infinite, and its sample is not valid.
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = reward.astype(dtype)
        return rounded, (reward - rounded.astype(reward.dtype)).astype(dtype)


def centred_reward(archive: Archive) -> tuple[Float[Array, " L"], Scalar]:
    """Return the rewards minus the largest valid one, and the largest rounding error of a reward.

    The subtraction changes no weight of a sample. It uses the remainders, which a sum of reward and remainder
    would lose. Rewards of slots that are not valid are zero.
    """
    reward, rest, is_valid = archive.batch.reward, archive.reward_rest, archive.is_valid
    largest = jnp.max(jnp.where(is_valid, reward, -jnp.inf))
    rest_of_largest = jnp.max(jnp.where(is_valid & (reward == largest), rest, -jnp.inf))
    largest, rest_of_largest = (jnp.where(jnp.any(is_valid), x, 0.0) for x in (largest, rest_of_largest))
    # Half of each: the difference of two finite numbers may be infinite.
    limit = 0.5 * jnp.finfo(reward.dtype).max
    halves = jnp.maximum(0.5 * reward - 0.5 * largest, -limit)
    difference = 2.0 * halves + (rest - rest_of_largest)
    centred = jnp.maximum(difference, -2.0 * limit)
    rounding = ROUNDING * jnp.max(archive.reward_rounding, where=is_valid, initial=0.0)
    return jnp.where(is_valid, centred, 0.0), rounding


def _is_finite(batch: Batch) -> Bool[Array, " n"]:
    context, theta, reward = batch
    return (
        jnp.isfinite(reward) & jnp.all(jnp.isfinite(context), axis=1) & jnp.all(jnp.isfinite(theta), axis=1)
    )
