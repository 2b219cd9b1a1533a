"""Describe contexts and parameters, and keep parameters within their bounds."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from creps_jax import checks
from creps_jax.errors import UserError
from creps_jax.policies.bounds import CLIP, SIGMOID, check_constraint, range_error
from creps_jax.typing import Array, Float, ScalarLike, VectorLike

__all__ = ["Space", "penalty", "sigmoid_gate", "sigmoid_gate_inverse", "violation"]

_WIDE = 1e37
"""Width of a box above which the width, or its inverse, can be outside the range of float32."""


@dataclasses.dataclass(frozen=True)
class Space:
    """The variables of a context, or of a parameter vector: names, units and ranges.

    Attributes:
        names: A name for each of the n variables.
        low: Lower ends; minus infinity for no end.
        high: Upper ends; infinity for no end.
        units: Units, by default none.
        constraint: How the numbers that a search draws become parameters within their bounds: "sigmoid"
            squashes them, as `sigmoid_constrained` does in learning, "clip" cuts them off at the bounds,
            "none" leaves them.

    Raises:
        ValueError: If names are missing or equal, there is not one end and one unit for each name, an end is
            not a number, a lower end is above the upper end, or a sigmoid has an infinite end.
    """

    names: tuple[str, ...]
    low: tuple[float | int, ...]
    high: tuple[float | int, ...]
    units: tuple[str, ...] = ()
    constraint: str = CLIP

    def __post_init__(self) -> None:
        """Check the fields, and convert sequences to tuples."""
        if not isinstance(self.names, str | tuple | list):
            raise ValueError(f"names must be a sequence of texts, got {checks.shown(self.names)}")
        names = (self.names,) if isinstance(self.names, str) else tuple(self.names)
        units = (self.units,) if isinstance(self.units, str) else tuple(self.units)
        low, high = (self._ends(side, len(names)) for side in ("low", "high"))
        for field, values in (("names", names), ("units", units or ("",) * len(names))):
            if not all(isinstance(value, str) for value in values):
                raise ValueError(f"{field} must be texts, got {checks.shown(values)}")
            object.__setattr__(self, field, values)
        if not names or len(set(names)) < len(names) or not all(name.strip() for name in names):
            raise ValueError(f"names must be different names, at least one, got {names}")
        if len(self.units) != len(names):
            raise ValueError(f"units must be one for each of {', '.join(names)}, got {self.units}")
        for name, bottom, top in zip(names, low, high, strict=True):
            if not bottom <= top:
                raise ValueError(f"low of {name} must not exceed its high, got {bottom:g} and {top:g}")
        object.__setattr__(self, "low", low)
        object.__setattr__(self, "high", high)
        check_constraint(self.constraint)
        if self.constraint == SIGMOID and not all(abs(end) <= checks.FLOAT32_MAX for end in (*low, *high)):
            raise ValueError(f"low and high must be finite in float32 for a sigmoid, got {low} and {high}")

    @classmethod
    def unbounded(cls, names: tuple[str, ...], units: tuple[str, ...] = ()) -> "Space":
        """Return the space of variables that may be any number.

        Args:
            names: A name for each of the variables.
            units: Units, by default none.

        Raises:
            ValueError: As for other spaces.
        """
        num = len(names) if isinstance(names, tuple | list) else 1
        return cls(names, (-math.inf,) * num, (math.inf,) * num, units)

    @property
    def size(self) -> int:
        """The number of variables."""
        return len(self.names)

    def inside(self, free: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
        """Turn free numbers, which a search draws, into parameters within the bounds.

        Raises:
            ValueError: If there is not a number for each variable along the last axis.

        Source: Abdolmaleki et al. 2016, Eq. 17, for a sigmoid.
        """
        free = self._rows("free", free)
        if self.constraint == SIGMOID:
            return sigmoid_gate(free, self.low, self.high)
        if self.constraint == CLIP:
            ends = (jnp.asarray(end, free.dtype) for end in (self.low, self.high))
            low, high = (jnp.broadcast_to(end, free.shape) for end in ends)
            return jnp.clip(free, low, high)
        return free

    def free(self, parameters: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
        """Turn parameters into the free numbers that `inside` maps to them, to begin a search there.

        `start_policy(features, space.size, mean=space.free(known))` has the mean `known` in every context.

        Raises:
            ValueError: If there is not a number for each variable along the last axis.
        """
        parameters = self._rows("parameters", parameters)
        if self.constraint == SIGMOID:
            return sigmoid_gate_inverse(parameters, self.low, self.high)
        return parameters

    def numbers(self, values: Sequence[Any]) -> np.ndarray:
        """Return a number for each variable as an array (n,).

        Raises:
            ValueError: If there is not a number for each variable.
        """
        try:
            numbers = np.array([float(value) for value in values])
        except (TypeError, ValueError):
            numbers = np.zeros(0)
        if len(numbers) != self.size:
            each = list(values) if isinstance(values, tuple) else [values]
            is_plain = not any(hasattr(value, "shape") for value in each)
            given = checks.shown(each) if is_plain else ", ".join(map(checks.shown, each))
            raise UserError(f"values must be a number for each of {', '.join(self.names)}, got {given}")
        return numbers

    def contains(self, values: Sequence[Any]) -> bool:
        """Return whether each number is within its range, up to the rounding of single precision."""
        return self._outside(self.numbers(values)) is None

    def checked(self, values: Sequence[Any]) -> np.ndarray:
        """Return numbers (n,) after checking that they are within the ranges.

        Raises:
            ValueError: If there is not a number for each variable, or one is out of its range.
        """
        numbers = self.numbers(values)
        found = self._outside(numbers)
        if found is not None:
            low, high, unit = self.low[found], self.high[found], self.units[found]
            raise range_error(self.names[found], numbers[found], low, high, unit)
        return numbers

    def _outside(self, numbers: np.ndarray) -> int | None:
        """Return the index of the first variable that is out of its range."""
        for index, (value, low, high) in enumerate(zip(numbers, self.low, self.high, strict=True)):
            slack = 1e-6 * (high - low) if math.isfinite(high - low) else 0.0
            if not (low - slack <= value <= high + slack and math.isfinite(value)):
                return index
        return None

    def _rows(self, name: str, numbers: Array) -> Array:
        numbers = checks.array(name, numbers)
        if numbers.shape[-1:] != (self.size,):
            raise ValueError(f"{name} must have {self.size} numbers along the last axis, got {numbers.shape}")
        return numbers

    def _ends(self, side: str, num: int) -> tuple[float, ...]:
        values = np.ravel(np.asarray(getattr(self, side), object)).tolist()
        try:
            ends = tuple(float(value) for value in values)
        except (TypeError, ValueError):
            ends = ()
        if len(ends) != num or any(map(math.isnan, ends)):
            raise ValueError(f"{side} must be {num} numbers, one for each name, got {getattr(self, side)}")
        return ends


def sigmoid_gate(theta: Float[Array, "*b d"], low: VectorLike, high: VectorLike) -> Float[Array, "*b d"]:
    """Squash free parameters into a box.

    Args:
        theta: Free parameters, any real numbers.
        low: Lower bounds, in the units of the result.
        high: Upper bounds; a parameter whose bounds are equal in float32, or differ by less than its smallest
            number, is fixed at them.

    Returns:
        Parameters in [low, high]; zero goes to the middle of the box.

    Raises:
        ValueError: If bounds do not fit the parameters or each other, or a value is not a number.

    Source: Abdolmaleki et al. 2016, Eq. 17.
    """
    theta, low, high = _box(theta, low, high)
    # The unit is a power of two: results are the same to the bit.
    unit = jnp.where(high - low > _WIDE, 16.0, 1.0).astype(theta.dtype)
    # In print: theta' = 1 / (1 + exp(-theta)) (UB - LB) + LB
    gated = (low / unit + jax.nn.sigmoid(theta) * (high / unit - low / unit)) * unit  # Eq. 17
    # Rounding can put the last bit outside the box.
    return jnp.clip(gated, low, high)


def sigmoid_gate_inverse(
    theta: Float[Array, "*b d"], low: VectorLike, high: VectorLike
) -> Float[Array, "*b d"]:
    """Find the free parameters that `sigmoid_gate` squashes to the given ones.

    Args:
        theta: Parameters inside the box; those outside are moved to the nearest bound.
        low: Lower bounds.
        high: Upper bounds.

    Returns:
        Free parameters. A parameter at a bound, which only infinity reaches, gets the largest number whose
        result differs from the bound in float32 (about 16); a fixed parameter gets zero.

    Raises:
        ValueError: If bounds do not fit the parameters or each other, or a value is not a number.
    """
    theta, low, high = _box(theta, low, high)
    width = high - low
    is_wide = width > _WIDE
    is_free = (width >= float(jnp.finfo(width.dtype).tiny)) & ~is_wide
    fraction = jnp.where(is_free, (theta - low) / jnp.where(is_free, width, 1.0), 0.5)
    # Without the width of a wide box, which overflows, and whose inverse compiled programs round to zero.
    inside = jnp.clip(theta, low, high)
    below, above = 0.5 * inside - 0.5 * low, 0.5 * high - 0.5 * inside
    fraction = jnp.where(is_wide, below / jnp.where(is_wide, below + above, 1.0), fraction)
    margin = float(jnp.finfo(theta.dtype).epsneg)
    return jax.scipy.special.logit(jnp.clip(fraction, margin, 1.0 - margin))


def violation(theta: Float[Array, "*b d"], low: VectorLike, high: VectorLike) -> Float[Array, "*b d"]:
    """Measure how far each parameter lies outside its bounds: zero inside, positive and finite outside.

    Raises:
        ValueError: If bounds do not fit the parameters or each other, or a value is not a number.
    """
    theta, low, high = _box(theta, low, high, largest=math.inf)
    distance = jnp.maximum(jnp.maximum(low - theta, theta - high), 0.0)
    return jnp.minimum(distance, float(jnp.finfo(theta.dtype).max))


def penalty(violation: Float[Array, "*b c"], size: ScalarLike) -> Float[Array, "*b"]:
    """Return `size` where any constraint is violated by any amount, else zero.

    Source: Abdolmaleki et al. 2016, Eq. 18 (its last term).
    """
    is_violated = jnp.any(violation > 0.0, axis=-1)
    return jnp.where(is_violated, jnp.asarray(size, violation.dtype), jnp.zeros((), violation.dtype))


def _box(
    theta: Array, low: VectorLike, high: VectorLike, *, largest: float = checks.FLOAT32_MAX
) -> tuple[Array, Array, Array]:
    """Return parameters and bounds as arrays of one shape and type, after checking them."""
    theta = checks.array("theta", theta)
    low, high = (checks.array(name, end).astype(theta.dtype) for name, end in (("low", low), ("high", high)))
    if theta.ndim < 1 or not {low.shape, high.shape} <= {(), theta.shape[-1:]}:
        raise ValueError(
            "theta must be vectors, and the bounds low and high numbers or vectors of their length, "
            f"got shapes {theta.shape}, {low.shape} and {high.shape}"
        )
    checks.finite("theta", theta, largest=math.inf)
    for name, end in (("low", low), ("high", high)):
        checks.finite(name, end, largest=largest)
    is_known = not (isinstance(low, Tracer) or isinstance(high, Tracer))
    if is_known and np.any(np.asarray(low) > np.asarray(high)):
        raise ValueError(f"low must not exceed high, got {low} and {high}")
    return theta, jnp.broadcast_to(low, theta.shape), jnp.broadcast_to(high, theta.shape)
