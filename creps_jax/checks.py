"""Check what users hand over, where it comes in: one `ValueError` that shows the value and what was expected.

Types and shapes are known while a program is traced, values are not: those of traced arrays pass. No check
adds anything to a compiled program.
"""

import math
import numbers
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from creps_jax.typing import Array

__all__ = [
    "LARGEST",
    "array",
    "count",
    "ends",
    "finite",
    "function",
    "grid",
    "instance",
    "key",
    "number",
    "number_of_keys",
    "shown",
    "vector",
]

LARGEST = 1e15
"""Size of numbers up to which products of two of them, and sums of those, are finite in float32."""
_MOST = 2**31 - 1
"""The largest count: indices have 32 bits."""
_MOST_POINTS = 10_000_000
"""The largest grid: its size is a power, and a slip would fill the memory."""
_FLOAT32_MAX = float(np.finfo(np.float32).max)
_WIDTH = 80
"""Characters of a value that errors show."""


def shown(value: Any) -> str:
    """Write a value as errors show it, in one short line: an array by its type and shape."""
    if isinstance(value, Tracer):
        return f"traced {value.dtype}{value.shape}"
    if isinstance(value, np.ndarray | jax.Array):
        text = repr(value.item()) if _is_number(value) else f"{value.dtype}{value.shape}"
    else:
        text = " ".join(repr(value).split())
    return text if len(text) <= _WIDTH else f"{text[: _WIDTH - 4]} ..."


def count(name: str, value: Any, *, least: int = 1) -> int:
    """Return a number of things, after checking that it is whole and neither too small nor beyond any index.

    Raises:
        ValueError: If it is not.
    """
    is_whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not is_whole or not least <= value <= _MOST:
        limit = f"at least {least}" if is_whole and value < least else f"at most {_MOST}"
        raise ValueError(f"{name} must be {limit if is_whole else 'a whole number'}, got {shown(value)}")
    return int(value)


def grid(name: str, num: Any, dim: int, *, least: int = 1) -> int:
    """Return how many points a grid has along each of its `dim` axes, after checking that all fit in memory.

    Raises:
        ValueError: If `num` is less than `least`, or there are too many points.
    """
    num = count(name, num, least=least)
    if num**dim > _MOST_POINTS:
        raise ValueError(
            f"{name} must leave at most {_MOST_POINTS} points in all, got {num} along each of {dim} axes"
        )
    return num


def number(name: str, value: Any, *, least: float = -math.inf, above: float = -math.inf) -> Any:
    """Return a setting, after checking that it is one real number, finite in float32 and in its limits.

    Raises:
        ValueError: If it is not.
    """
    if not _is_number(value):
        raise ValueError(f"{name} must be a number, got {shown(value)}")
    if isinstance(value, Tracer):
        return value
    value = value.item() if isinstance(value, np.ndarray | jax.Array) else value
    rounded = np.float32(value) if -_FLOAT32_MAX <= value <= _FLOAT32_MAX else np.float32(np.nan)
    if not (rounded >= least and rounded > above):
        note = ", which float32 cannot hold" if max(least, above) < value < math.inf else ""
        raise ValueError(f"{name} must be {_limits(least, above)}, got {shown(value)}{note}")
    return value


def vector(name: str, value: Any, *, may_be_infinite: bool = False) -> np.ndarray:
    """Return a setting that is a number or a vector, given outside of any trace, as an array of NumPy.

    Raises:
        ValueError: If it is something else, or an entry is not finite in float32.
    """
    try:
        values = np.asarray(value)
    except (TypeError, ValueError):  # traced, or ragged
        values = np.asarray(None)
    if values.dtype.kind not in "iuf" or values.ndim > 1 or values.size == 0:
        raise ValueError(f"{name} must be a number or a vector of numbers, got {shown(value)}")
    is_good = (np.abs(values) <= _FLOAT32_MAX) | (np.isinf(values) if may_be_infinite else False)
    if not is_good.all():
        wanted = "numbers" if may_be_infinite else "finite"
        raise ValueError(f"{name} must be {wanted}, got {values[~is_good][0]}")
    return values.astype(float)


def ends(low: Any, high: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends of a range as vectors of one length, after checking that the one is below the other.

    Raises:
        ValueError: If it is not, or they are no vectors of one length.
    """
    low, high = np.atleast_1d(vector("low", low)), np.atleast_1d(vector("high", high))
    if low.shape != high.shape:
        raise ValueError(f"low and high must be vectors of one length, got {low.shape} and {high.shape}")
    if not np.all(low.astype(np.float32) < high.astype(np.float32)):
        raise ValueError(f"low must be below high, got {low} and {high}")
    return low, high


def array(name: str, value: Any, shape: tuple[int | str, ...] | None = None) -> Array:
    """Return numbers as an array of floats, of 32 bits at least; one that is such is returned as it is.

    Args:
        name: What they are, for the error.
        value: Real numbers; those that are not finite pass, see `finite`.
        shape: The shape that they must have, if any; a letter stands for any number above zero.

    Raises:
        ValueError: If they are no real numbers, or have another shape.
    """
    try:
        result = value if isinstance(value, jax.Array) else jnp.asarray(value)
    except (TypeError, ValueError, OverflowError):
        result = None
    if result is None or not _is_real(result):
        raise ValueError(f"{name} must be an array of real numbers, got {shown(value)}")
    if shape is not None:
        fits = len(result.shape) == len(shape) and all(
            got == wanted or (isinstance(wanted, str) and got > 0)
            for got, wanted in zip(result.shape, shape, strict=True)
        )
        if not fits:
            wanted = f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
            raise ValueError(f"{name} must have shape {wanted}, got {result.shape}")
    is_wide_float = jnp.issubdtype(result.dtype, jnp.floating) and result.dtype.itemsize >= 4
    return result if is_wide_float else result.astype(jnp.float32)


def finite(
    name: str,
    values: Array | np.ndarray,
    *,
    least: float = -math.inf,
    above: float = -math.inf,
    largest: float | None = None,
) -> Array | np.ndarray:
    """Return an array as it is, after checking its entries, unless they are traced.

    Args:
        name: What they are, for the error.
        values: The array.
        least: The least that an entry may be.
        above: What entries have to be above.
        largest: How far from zero an entry may be, infinitely too; by default any finite distance.

    Raises:
        ValueError: If an entry is NaN, or out of its limits.
    """
    if not isinstance(values, Tracer):
        known = np.asarray(values)
        is_good = np.isfinite(known) if largest is None else np.abs(known) <= largest
        is_good &= (known >= least) & ((known > above) | (above == -math.inf))
        if not is_good.all():
            raise ValueError(f"{name} must be {_limits(least, above, largest)}, got {known[~is_good][0]}")
    return values


def key(name: str, value: Any) -> Any:
    """Return a random key as it is, after checking that it is one.

    Raises:
        ValueError: If it is something else, or several keys.
    """
    if _key_shape(value) != ():
        raise ValueError(f"{name} must be a random key, such as jax.random.key(0), got {shown(value)}")
    return value


def number_of_keys(name: str, value: Any) -> int:
    """Return how many random keys an array of them holds.

    Raises:
        ValueError: If it is something else, or holds none.
    """
    shape = _key_shape(value)
    if shape is None or len(shape) != 1 or shape[0] < 1:
        raise ValueError(
            f"{name} must be random keys, such as jax.random.split(jax.random.key(0), 5), got {shown(value)}"
        )
    return shape[0]


def function(name: str, value: Any, signature: str) -> None:
    """Refuse what cannot be called.

    Raises:
        ValueError: If it cannot.
    """
    if not callable(value):
        raise ValueError(f"{name} must be a function {signature}, got {shown(value)}")


def instance(name: str, value: Any, *kinds: type) -> None:
    """Refuse what is of none of these types.

    Raises:
        ValueError: If it is of none.
    """
    if not isinstance(value, kinds):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"{name} must be of type {wanted}, got {shown(value)}")


def _limits(least: float, above: float, largest: float | None = None) -> str:
    if largest is not None:
        return "numbers" if largest == math.inf else f"numbers of at most {largest:g} in size"
    if above > least:
        return f"finite and above {above:g}"
    return f"finite and at least {least:g}" if least > -math.inf else "finite"


def _is_number(value: Any) -> bool:
    if isinstance(value, np.ndarray | jax.Array):
        return value.ndim == 0 and _is_real(value)
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _is_real(values: np.ndarray | jax.Array) -> bool:
    return any(jnp.issubdtype(values.dtype, kind) for kind in (jnp.floating, jnp.integer, jnp.bool_))


def _key_shape(value: Any) -> tuple[int, ...] | None:
    """Return the shape of an array of keys, the new ones or rows of two uint32; None if it is none."""
    if not isinstance(value, np.ndarray | jax.Array):
        return None
    if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        return value.shape
    is_old = value.dtype == np.uint32 and value.shape[-1:] == (2,)
    return value.shape[:-1] if is_old else None
