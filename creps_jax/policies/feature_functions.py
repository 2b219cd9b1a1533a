"""Compute features of a context: linear, quadratic, polynomial, radial basis functions, a kernel.

Each function is a record of numbers: records with equal numbers are equal, and can be copied and pickled.
"""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from creps_jax import checks
from creps_jax.numerics.linalg import exact_dot
from creps_jax.typing import Array, Float, VectorLike

__all__ = [
    "Kernel",
    "Linear",
    "Polynomial",
    "Quadratic",
    "Radial",
    "ScaledPolynomial",
    "grid_of_centers",
    "inducing_contexts",
]

_FAR = 1e20
"""Largest distance from the range, in bandwidths. A context farther away is moved to this distance, so that
squares do not overflow."""
_LARGE = 1e30
"""Size of the ends of a range above which differences can overflow, and compiled programs, which multiply by
the inverse of a bandwidth, can round that inverse to zero."""
_NARROW = 1e-9
"""Bandwidth, relative to the range, below which squares of distances can overflow. Centres are then at least
a hundred bandwidths apart, and only the nearest one has a weight."""


_FARTHEST = 1e17
"""Largest distance from the middle of the range for a kernel, which adds squares of several variables."""
_JITTER = 1e-6
"""Added to the kernel matrix of the inducing contexts, whose smallest eigenvalues are below the rounding."""


@dataclasses.dataclass(frozen=True)
class Linear:
    """Compute the features [1, s]."""

    dim: int

    def __call__(self, context: Float[Array, " s"]) -> Float[Array, " m"]:
        """Return the features of a context."""
        context = _checked_context(context, self.dim)
        return jnp.concatenate([jnp.ones_like(context[:1]), context])


@dataclasses.dataclass(frozen=True)
class Quadratic:
    """Compute the features [s, s^2]."""

    dim: int

    def __call__(self, context: Float[Array, " s"]) -> Float[Array, " m"]:
        """Return the features of a context."""
        context = _checked_context(context, self.dim)
        return jnp.concatenate([context, _kept_finite(context**2)])


@dataclasses.dataclass(frozen=True)
class Polynomial:
    """Compute all monomials up to a degree."""

    dim: int
    degree: int

    def __call__(self, context: Float[Array, " s"]) -> Float[Array, " m"]:
        """Return the features of a context."""
        context = _checked_context(context, self.dim)
        monomials = [jnp.ones_like(context[:1])]
        rows: dict[tuple[int, ...], int] = {(): 0}
        for degree in range(1, self.degree + 1):
            # Each monomial is one of the degree below, times its last variable.
            combinations = list(itertools.combinations_with_replacement(range(self.dim), degree))
            factors = np.array([rows[variables[:-1]] for variables in combinations])
            last = np.array([variables[-1] for variables in combinations])
            monomials.append(_kept_finite(monomials[-1][factors] * context[last]))
            rows = {variables: row for row, variables in enumerate(combinations)}
        return jnp.concatenate(monomials)


@dataclasses.dataclass(frozen=True)
class ScaledPolynomial:
    """Compute all monomials up to a degree of the context, scaled from a range to -1 to 1."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    degree: int

    def __call__(self, context: Float[Array, " s"]) -> Float[Array, " m"]:
        """Return the features of a context."""
        context = _checked_context(context, len(self.low))
        middle, half = (
            jnp.asarray(numbers, context.dtype) for numbers in middle_and_half(self.low, self.high)
        )
        return Polynomial(len(self.low), self.degree)((context - middle) / half)


@dataclasses.dataclass(frozen=True)
class Radial:
    """Compute normalised radial basis functions."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    num_centers: tuple[int, ...]
    width: tuple[float, ...]

    def __call__(self, context: Float[Array, " s"]) -> Float[Array, " m"]:
        """Return the features of a context."""
        context = _checked_context(context, len(self.low))
        low, high, width = (np.asarray(numbers) for numbers in (self.low, self.high, self.width))
        centers = grid_of_centers(low, high, self.num_centers)
        is_narrow = width < _NARROW * (high - low)
        width = np.where(is_narrow, high - low, width)
        # A power of two: where it is not needed, results are the same to the bit.
        unit = np.where(np.maximum(np.abs(low), np.abs(high)) > _LARGE, 16.0, 1.0)
        # Compilers change the order of multiplications, in which extreme numbers can overflow or become zero.
        is_extreme = np.any(is_narrow | (unit > 1) | (width < 1 / checks.LARGEST) | (width > checks.LARGEST))

        def in_order(numbers: Array) -> Array:
            return jnp.asarray(lax.optimization_barrier(numbers)) if is_extreme else numbers

        low, high, width, centers, unit = (
            jnp.asarray(numbers, context.dtype)
            for numbers in (low / unit, high / unit, width / unit, centers / unit, unit)
        )
        context = in_order(context / unit)
        nearest = jnp.clip(context, low, high)
        inside = in_order((nearest[None, :] - centers) / width[None, :])
        outside = in_order(jnp.clip((context - nearest) / width, -_FAR, _FAR))
        # (s - c)^2 / 2 sigma^2 without the term that all centres share: far outside the range the others
        # would be lost in its rounding.
        costs = 0.5 * inside**2 + outside[None, :] * inside
        if is_narrow.any():
            distance = jnp.abs(inside)
            is_nearest = distance == jnp.min(distance, axis=0)[None, :]
            costs = jnp.where(is_narrow[None, :], jnp.where(is_nearest, 0.0, jnp.inf), costs)
        # Without the barrier, compilers compute all costs again for each term of the sum over them.
        # In print: psi_j / sum of psi, psi_j = exp(-(s - c_j)^2 / (2 sigma^2))
        return jax.nn.softmax(jnp.asarray(lax.optimization_barrier(-jnp.sum(costs, axis=1))))  # Eq. 16


@dataclasses.dataclass(frozen=True)
class Kernel:
    """Compute a constant and the features of a sparse Gaussian process."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    num: int
    bandwidth: tuple[float, ...]

    def __call__(self, context: Float[Array, " s"]) -> Float[Array, " m"]:
        """Return the features of a context."""
        context = _checked_context(context, len(self.low))
        middle, half = middle_and_half(self.low, self.high)
        ratio = half / np.asarray(self.bandwidth)
        points, root = _from_middle(half.size, self.num) * ratio, self.inverse_root()
        middle, half, ratio, points, root = (
            jnp.asarray(numbers, context.dtype) for numbers in (middle, half, ratio, points, root)
        )
        scaled = jnp.clip((context - middle) / half * ratio, -_FARTHEST, _FARTHEST)
        distance = scaled[None, :] - points
        covariance = jnp.exp(-0.5 * jnp.sum(distance**2, axis=1))
        return jnp.concatenate([jnp.ones_like(covariance[:1]), exact_dot(covariance, root)])

    def inducing(self) -> Float[np.ndarray, "n s"]:
        """Return the inducing contexts."""
        middle, half = middle_and_half(self.low, self.high)
        return middle + half * _from_middle(half.size, self.num)

    def inverse_root(self) -> Float[np.ndarray, "n n"]:
        """Return the inverse root of the kernel matrix of the inducing contexts."""
        _, half = middle_and_half(self.low, self.high)
        return _inverse_root(self.num, tuple((half / np.asarray(self.bandwidth)).tolist()))


def middle_and_half(
    low: VectorLike, high: VectorLike
) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, " s"]]:
    """Return the middle of a range and half its size; the difference of large numbers would overflow."""
    lows, highs = 0.5 * np.asarray(low), 0.5 * np.asarray(high)
    return highs + lows, highs - lows


def inducing_contexts(dim: int, num: int) -> np.ndarray:
    """Return the first points (num, dim) of the Halton sequence, which fill the cube from 0 to 1 evenly."""
    return np.stack([_radical_inverse(np.arange(1, num + 1), base) for base in _primes(dim)], axis=1)


def _from_middle(dim: int, num: int) -> np.ndarray:
    """Return the inducing contexts, scaled from the range to -1 to 1."""
    return 2.0 * inducing_contexts(dim, num) - 1.0


def _primes(num: int) -> list[int]:
    primes: list[int] = []
    for number in itertools.count(2):
        if len(primes) == num:
            return primes
        if all(number % prime for prime in primes):
            primes.append(number)
    return primes


def _radical_inverse(index: np.ndarray, base: int) -> np.ndarray:
    """Return the digits of indices in a base as fractions, the last digit first."""
    result, place = np.zeros(index.shape), 1.0
    while index.any():
        index, digit = np.divmod(index, base)
        place /= base
        result = result + digit * place
    return result


@functools.lru_cache(maxsize=8)
def _inverse_root(num: int, scale: tuple[float, ...]) -> np.ndarray:
    """Return the inverse root of the kernel matrix of the inducing contexts, scaled to bandwidths of one."""
    points = _from_middle(len(scale), num) * np.array(scale)
    covariance = np.exp(-0.5 * np.sum((points[:, None] - points[None]) ** 2, axis=2))
    values, axes = np.linalg.eigh(covariance + _JITTER * np.eye(num))
    return (axes / np.sqrt(np.maximum(values, _JITTER))) @ axes.T


def grid_of_centers(low: np.ndarray, high: np.ndarray, num_centers: tuple[int, ...]) -> np.ndarray:
    """Return a row for each centre, in the order of the features."""
    places = [np.linspace(0.0, 1.0, num) if num > 1 else np.array([0.5]) for num in num_centers]
    grid = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).reshape(-1, low.size)
    return low + grid * (high - low)


def _kept_finite(features: Array) -> Array:
    """Replace infinity by the largest number, whose product with zero is a number."""
    largest = float(jnp.finfo(features.dtype).max)
    return jnp.clip(features, -largest, largest)


def _checked_context(context: Array, dim: int) -> Array:
    return checks.finite("context", checks.array("context", context, (dim,)))
