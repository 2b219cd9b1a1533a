"""Keep parameters inside a box: by squashing them into it, or by a price for leaving it."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from creps_jax import checks
from creps_jax.typing import Array, Float, ScalarLike, VectorLike

__all__ = ["penalty", "sigmoid_gate", "sigmoid_gate_inverse", "violation"]

_WIDE = 1e37
"""Width of a box from which it, or its inverse, can be out of the range of float32."""


def sigmoid_gate(theta: Float[Array, "*b d"], low: VectorLike, high: VectorLike) -> Float[Array, "*b d"]:
    """Squash free parameters into a box.

    Args:
        theta: Free parameters, any real numbers.
        low: Lower bounds, in the units of the result.
        high: Upper bounds; a parameter whose bounds are equal, or so close that float32 takes their
            difference for zero, is fixed at them.

    Returns:
        Parameters in [low, high]; zero goes to the middle of the box.

    Raises:
        ValueError: If bounds do not fit the parameters or each other, or a number is none.

    Source: Abdolmaleki et al. 2016, Eq. 17.
    """
    theta, low, high = _box(theta, low, high)
    # Divided by a power of two, results are the same to the bit.
    unit = jnp.where(high - low > _WIDE, 16.0, 1.0).astype(theta.dtype)
    gated = (low / unit + jax.nn.sigmoid(theta) * (high / unit - low / unit)) * unit
    # The clip takes back the last bit that rounding can put outside the box.
    return jnp.clip(gated, low, high)


def sigmoid_gate_inverse(
    theta: Float[Array, "*b d"], low: VectorLike, high: VectorLike
) -> Float[Array, "*b d"]:
    """Find the free parameters that `sigmoid_gate` squashes to the given ones.

    Args:
        theta: Parameters inside the box; outside it they count as at the nearest bound.
        low: Lower bounds.
        high: Upper bounds.

    Returns:
        Free parameters. A parameter at a bound, which only infinity reaches, gets the last finite
        value that float32 tells from the bound (about 16); a fixed parameter gets zero.

    Raises:
        ValueError: If bounds do not fit the parameters or each other, or a number is none.
    """
    theta, low, high = _box(theta, low, high)
    width = high - low
    is_wide = width > _WIDE
    is_free = (width >= float(jnp.finfo(width.dtype).tiny)) & ~is_wide
    fraction = jnp.where(is_free, (theta - low) / jnp.where(is_free, width, 1.0), 0.5)
    # Without the width of a wide box, which overflows: compiled programs take its inverse for zero.
    inside = jnp.clip(theta, low, high)
    below, above = 0.5 * inside - 0.5 * low, 0.5 * high - 0.5 * inside
    fraction = jnp.where(is_wide, below / jnp.where(is_wide, below + above, 1.0), fraction)
    margin = float(jnp.finfo(theta.dtype).epsneg)
    return jax.scipy.special.logit(jnp.clip(fraction, margin, 1.0 - margin))


def violation(theta: Float[Array, "*b d"], low: VectorLike, high: VectorLike) -> Float[Array, "*b d"]:
    """Measure how far each parameter lies outside its bounds: zero inside, positive and finite outside.

    Raises:
        ValueError: If bounds do not fit the parameters or each other, or a number is none.
    """
    theta, low, high = _box(theta, low, high, largest=math.inf)
    distance = jnp.maximum(jnp.maximum(low - theta, theta - high), 0.0)
    return jnp.minimum(distance, float(jnp.finfo(theta.dtype).max))


def penalty(violation: Float[Array, "*b c"], size: ScalarLike) -> Float[Array, "*b"]:
    """Charge `size` where any constraint is violated, however little.

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
