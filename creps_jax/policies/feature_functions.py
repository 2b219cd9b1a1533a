"""Compute features of a context: linear, quadratic, polynomial, normalised radial basis functions.

Each function is a record of numbers: records with equal numbers are equal, and can be copied and pickled.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from creps_jax import checks
from creps_jax.typing import Array, Float

__all__ = ["Linear", "Polynomial", "Quadratic", "Radial", "grid_of_centers"]

_FAR = 1e20
"""Largest distance from the range, in bandwidths. A context farther away is moved to this distance, so that
squares do not overflow."""
_LARGE = 1e30
"""Size of the ends of a range above which differences can overflow, and compiled programs, which multiply by
the inverse of a bandwidth, can round that inverse to zero."""
_NARROW = 1e-9
"""Bandwidth, relative to the range, below which squares of distances can overflow. Centres are then at least
a hundred bandwidths apart, and only the nearest one has a weight."""


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
