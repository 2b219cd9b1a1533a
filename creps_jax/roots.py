"""Find where a monotone function crosses a value: the one scalar root finder of the library."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from creps_jax.typing import Array, Bool, Float, Int, Scalar, ScalarLike

__all__ = ["Crossing", "find_crossing"]


class Crossing(NamedTuple):
    """The bracket that a crossing lies in, as narrow as was asked for."""

    low: Float[Array, ""]
    """The lower end: at most the target if the function increases, above it if it decreases."""
    high: Float[Array, ""]
    """The upper end: above the target if the function increases, at most the target if it decreases."""
    is_inside: Bool[Array, ""]
    """False where all of the range is on one side of the target: `low` and `high` are then the end of the
    range that is nearest to it."""
    num_evaluations: Int[Array, ""]


class _Search(NamedTuple):
    low: Array
    high: Array
    below: Array  # how much the function is below the target at the low end, which secants scale
    above: Array  # and above it at the high end
    side: Array  # which end the last evaluation moved: -1 the low one, 1 the high one
    width: Array  # that of the bracket two evaluations ago
    num_evaluations: Array


def find_crossing(
    function: Callable[[Scalar], Scalar],
    low: ScalarLike,
    high: ScalarLike,
    target: ScalarLike,
    *,
    is_decreasing: bool = False,
    resolution: ScalarLike = 0.0,
    max_evaluations: int = 100,
) -> Crossing:
    """Narrow a range down to where a monotone function crosses a target.

    Both ends are evaluated first. Then follow steps of the Illinois method, a secant that halves the excess
    of an end that stays, and bisections where those do not halve the bracket in time. Flat parts, jumps and
    infinite values only make it slower.

    Args:
        function: The function; what is not a number counts as a value above the target.
        low: Lower end of the range.
        high: Upper end, above the lower one; computed with in the format of that.
        target: The value to cross.
        is_decreasing: Whether the function decreases; by default it increases.
        resolution: Width of the bracket that is narrow enough; by default the search ends where there is no
            number left inside.
        max_evaluations: Largest number of evaluations.

    Returns:
        The bracket; take the end on whose side of the target you have to be.

    Raises:
        ValueError: If `max_evaluations` is below 2.

    Source: Dowell and Jarratt 1971, A modified regula falsi method for computing the root of an equation.
    """
    if max_evaluations < 2:
        raise ValueError(f"max_evaluations must be at least 2, got {max_evaluations}")
    low = jnp.asarray(low)
    low = low if jnp.issubdtype(low.dtype, jnp.floating) else low.astype(jnp.float32)
    high, target, resolution = (jnp.asarray(x, low.dtype) for x in (high, target, resolution))

    def excess(point: Array) -> Array:
        """Return how much the function is above the target, in a sense in which it increases."""
        value = function(point) - target
        # Of a decreasing function, what is at most the target is at the upper end.
        return jnp.where(jnp.isnan(value), jnp.inf, value) * (-1.0 if is_decreasing else 1.0)

    def is_above(excess: Array) -> Array:
        return excess >= 0 if is_decreasing else excess > 0

    def is_open(search: _Search) -> Array:
        middle = 0.5 * search.low + 0.5 * search.high
        is_narrow = (
            (search.high - search.low <= resolution) | (middle <= search.low) | (middle >= search.high)
        )
        return ~is_narrow & (search.num_evaluations < max_evaluations)

    def advance(search: _Search) -> _Search:
        point = _next_point(search)
        value = excess(point)
        return _narrowed(search, point, value, is_above(value))

    at_low, at_high = excess(low), excess(high)
    is_inside = ~is_above(at_low) & is_above(at_high)
    # Where nothing is to be searched, both ends are the nearest one.
    nearest = jnp.where(is_above(at_low), low, high)
    ends = jnp.where(is_inside, low, nearest), jnp.where(is_inside, high, nearest)
    count = jnp.asarray(2, jnp.int32)
    start = _Search(*ends, -at_low, at_high, jnp.zeros((), jnp.int32), 4.0 * (high - low), count)
    search = lax.while_loop(is_open, advance, start)
    return Crossing(search.low, search.high, is_inside, search.num_evaluations)


def _next_point(search: _Search) -> Array:
    """Return the point of the secant, or the middle where secants are slow or lead nowhere."""
    width = search.high - search.low
    middle = 0.5 * search.low + 0.5 * search.high
    # The smaller of the two excesses over their sum: neither overflows.
    ratio = search.below / search.above
    point = search.low + width * jnp.where(ratio <= 1.0, ratio / (1.0 + ratio), 1.0 / (1.0 + 1.0 / ratio))
    is_fast = (width <= 0.5 * search.width) & jnp.isfinite(point)
    return jnp.where(is_fast & (point > search.low) & (point < search.high), point, middle)


def _narrowed(search: _Search, point: Array, excess: Array, is_above: Array) -> _Search:
    """Move one end to a point; the excess of an end that stays twice is halved."""
    below, above = -excess, excess
    kept_below = jnp.where(search.side == 1, 0.5, 1.0).astype(point.dtype) * search.below
    kept_above = jnp.where(search.side == -1, 0.5, 1.0).astype(point.dtype) * search.above
    return _Search(
        low=jnp.where(is_above, search.low, point),
        high=jnp.where(is_above, point, search.high),
        below=jnp.where(is_above, kept_below, below),
        above=jnp.where(is_above, above, kept_above),
        side=jnp.where(is_above, 1, -1).astype(jnp.int32),
        width=jnp.where(search.num_evaluations % 2 == 0, search.high - search.low, search.width),
        num_evaluations=search.num_evaluations + 1,
    )
