"""Draw contexts for learning, and lay out grids of contexts for evaluation."""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax import checks
from creps_jax.typing import Array, Float, PRNGKey, VectorLike

__all__ = ["context_grid", "ellipsoid_contexts", "gaussian_contexts", "uniform_contexts"]

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
        std: Standard deviation of each context, by default a quarter of its range: then 95 of 100 contexts
            lie within the range.
        clip: Whether to move contexts outside the range to its ends.

    Returns:
        A function (key) -> context (s,).

    Raises:
        ValueError: If the ends do not fit each other, or a standard deviation is not positive.

    Source: Abdolmaleki et al. 2016, Section 4; the paper gives no mean and no spread.
    """
    low, high = _checked_range(low, high)
    scale = high / 4 - low / 4 if std is None else np.atleast_1d(checks.vector("std", std).astype(np.float32))
    if scale.shape not in [(1,), low.shape] or not np.all(scale >= checks.FLOAT32_TINY):
        raise ValueError(f"std must be positive, a number or of shape {low.shape}, got {std}")
    scale = np.broadcast_to(scale, low.shape)
    # Draws beyond the largest number of the format are moved to it.
    largest = np.full_like(low, checks.FLOAT32_MAX)
    limits = (low, high) if clip else (-largest, largest)
    return _Gaussian(*map(_numbers, (low / 2 + high / 2, scale, *limits)))


def uniform_contexts(low: VectorLike, high: VectorLike) -> Sampler:
    """Draw contexts uniformly from a range.

    Args:
        low: Lower end of each context's range; a number is a context of one dimension.
        high: Upper end of each context's range.

    Returns:
        A function (key) -> context (s,).

    Raises:
        ValueError: If the ends do not fit each other.
    """
    return _Uniform(*map(_numbers, _checked_range(low, high)))


def ellipsoid_contexts(low: VectorLike, high: VectorLike) -> Sampler:
    """Draw contexts evenly from the ellipsoid that touches the sides of a box.

    Args:
        low: Lower end of each context's range; a number is a context of one dimension.
        high: Upper end of each context's range.

    Returns:
        A function (key) -> context (s,).

    Raises:
        ValueError: If the ends do not fit each other.
    """
    return _Ellipsoid(*map(_numbers, _checked_range(low, high)))


@checks.arguments
def context_grid(low: VectorLike, high: VectorLike, num: int | Sequence[int]) -> Float[Array, "n s"]:
    """Lay out a grid of contexts over a range, both ends included, to evaluate a policy on.

    Args:
        low: Lower end of each context's range; a number is a context of one dimension.
        high: Upper end of each context's range.
        num: Number of contexts along each of the s dimensions: one for all, or one for each.

    Returns:
        All combinations, `num ** s` for one number, the last dimension varying fastest.

    Raises:
        ValueError: If the ends do not fit each other, or `num` is below 2 or gives too many contexts.
    """
    low, high = _checked_range(low, high)
    counts = checks.grid("num", num, low.size, least=2)
    half = _halves(low, high)
    ends = zip(low * half, high * half, strict=True)
    axes = [
        np.linspace(start, stop, count, dtype=np.float32)
        for (start, stop), count in zip(ends, counts, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))
    return jnp.asarray(grid / half)


@dataclasses.dataclass(frozen=True)
class _Gaussian:
    """Draw from a Gaussian, and clip to the limits."""

    mean: tuple[float, ...]
    std: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]

    @checks.arguments
    def __call__(self, key: PRNGKey) -> Float[Array, " s"]:
        mean, std, low, high = map(_vector, (self.mean, self.std, self.low, self.high))
        return jnp.clip(jnp.asarray(mean) + std * jax.random.normal(key, mean.shape), low, high)


@dataclasses.dataclass(frozen=True)
class _Uniform:
    """Draw uniformly from a range."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    @checks.arguments
    def __call__(self, key: PRNGKey) -> Float[Array, " s"]:
        low, high = _vector(self.low), _vector(self.high)
        half = _halves(low, high)
        return jax.random.uniform(key, low.shape, minval=low * half, maxval=high * half) / half


@dataclasses.dataclass(frozen=True)
class _Ellipsoid:
    """Draw evenly from the ellipsoid inside a range."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    @checks.arguments
    def __call__(self, key: PRNGKey) -> Float[Array, " s"]:
        low, high = _vector(self.low), _vector(self.high)
        direction_key, radius_key = jax.random.split(key)
        direction = jax.random.normal(direction_key, low.shape)
        direction = direction / jnp.maximum(jnp.linalg.norm(direction), checks.FLOAT32_TINY)
        radius = jax.random.uniform(radius_key) ** (1.0 / low.size)
        return jnp.clip(low / 2 + high / 2 + (high / 2 - low / 2) * radius * direction, low, high)


def _halves(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return 0.5 for ranges near or beyond the largest number, and 1 for others.

    Both are powers of two: results are the same to the bit.
    """
    width = high.astype(float) - low
    return np.where(width > checks.FLOAT32_MAX / 2, np.float32(0.5), np.float32(1.0))


def _vector(numbers: tuple[float, ...]) -> np.ndarray:
    return np.asarray(numbers, np.float32)


def _numbers(values: np.ndarray) -> tuple[float, ...]:
    return tuple(values.tolist())


def _checked_range(low: VectorLike, high: VectorLike) -> tuple[np.ndarray, np.ndarray]:
    low, high = checks.ends(low, high)
    return low.astype(np.float32), high.astype(np.float32)
