"""Draw contexts to learn from, and lay out contexts to evaluate on."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax import checks
from creps_jax.typing import Array, Float, PRNGKey, VectorLike

__all__ = ["context_grid", "gaussian_contexts", "uniform_contexts"]

Sampler = Callable[[PRNGKey], Array]
"""(key) -> context (s,)."""


@checks.arguments
def gaussian_contexts(
    low: VectorLike, high: VectorLike, *, std: VectorLike | None = None, clip: bool = False
) -> Sampler:
    """Draw contexts from a Gaussian around the middle of a range.

    Args:
        low: Lower end of each context's range; a number is a context of one dimension.
        high: Upper end of each context's range.
        std: Standard deviation of each context, by default a quarter of its range, so that 95 of
            100 lie within it.
        clip: Whether to move contexts outside the range to its ends.

    Returns:
        A function (key) -> context (s,).

    Raises:
        ValueError: If the ends do not fit each other, or a standard deviation is not positive.

    Source: Abdolmaleki et al. 2016, Section 4; the paper gives no mean and no spread.
    """
    low, high = _checked_range(low, high)
    scale = (high - low) / 4 if std is None else np.atleast_1d(checks.vector("std", std).astype(np.float32))
    if scale.shape not in [(1,), low.shape] or not np.all(scale > 0):
        raise ValueError(f"std must be positive, a number or of shape {low.shape}, got {std}")
    middle, scale = (low + high) / 2, np.broadcast_to(scale, low.shape)

    @checks.arguments
    def sample_context(key: PRNGKey) -> Float[Array, " s"]:
        context = jnp.asarray(middle) + scale * jax.random.normal(key, low.shape)
        return jnp.clip(context, low, high) if clip else context

    return sample_context


def uniform_contexts(low: VectorLike, high: VectorLike) -> Sampler:
    """Draw contexts evenly from a range.

    Args:
        low: Lower end of each context's range; a number is a context of one dimension.
        high: Upper end of each context's range.

    Returns:
        A function (key) -> context (s,).

    Raises:
        ValueError: If the ends do not fit each other.
    """
    low, high = _checked_range(low, high)

    @checks.arguments
    def sample_context(key: PRNGKey) -> Float[Array, " s"]:
        return jax.random.uniform(key, low.shape, minval=low, maxval=high)

    return sample_context


@checks.arguments
def context_grid(low: VectorLike, high: VectorLike, num: int) -> Float[Array, "n s"]:
    """Lay out contexts evenly over a range, both ends included, to evaluate a policy on.

    Args:
        low: Lower end of each context's range; a number is a context of one dimension.
        high: Upper end of each context's range.
        num: Number of contexts along each of the s dimensions.

    Returns:
        All `num ** s` combinations, the last dimension varying fastest.

    Raises:
        ValueError: If the ends do not fit each other, or `num` is less than 2 or far too many.
    """
    low, high = _checked_range(low, high)
    num = checks.grid("num", num, low.size, least=2)
    axes = [np.linspace(start, stop, num, dtype=np.float32) for start, stop in zip(low, high, strict=True)]
    return jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes)))


def _checked_range(low: VectorLike, high: VectorLike) -> tuple[np.ndarray, np.ndarray]:
    low, high = checks.ends(low, high)
    return low.astype(np.float32), high.astype(np.float32)
