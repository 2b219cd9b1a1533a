"""Check the arguments of public functions: a `ValueError` shows the value and what was expected.

While a program is traced, types and shapes are known, but values are not: the values of traced arrays are not
checked. Checks add nothing to a compiled program.
"""

import contextlib
import functools
import inspect
import math
import numbers
import operator
from collections.abc import Callable, Sequence
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from creps_jax.keys import key_shape
from creps_jax.typing import Array, PRNGKey, ScalarLike

__all__ = [
    "FLOAT32_MAX",
    "FLOAT32_TINY",
    "LARGEST",
    "NARROWEST",
    "arguments",
    "array",
    "count",
    "ends",
    "finite",
    "function",
    "grid",
    "host_array",
    "instance",
    "key",
    "number",
    "shown",
    "vector",
]

FLOAT32_MAX = float(np.finfo(np.float32).max)
"""The largest finite number."""
FLOAT32_TINY = float(np.finfo(np.float32).tiny)
"""The smallest number above zero that compiled programs do not round to zero."""
LARGEST = 1e15
"""Largest size of numbers whose products, and sums of products, are finite in float32."""
NARROWEST = 1e-30
"""The least width of a range: float32 can also hold a millionth of it."""
_MOST = 2**31 - 1
"""The largest count: indices have 32 bits."""
_MOST_POINTS = 10_000_000
"""The largest number of points of a grid; more would fill the memory."""
_WIDTH = 80
"""Largest number of characters of a value in an error."""

F = TypeVar("F", bound=Callable[..., Any])
A = TypeVar("A", Array, np.ndarray)
_Arrays = dict[str, tuple[list[str], tuple[int, ...]]]
"""Names and sizes of the axes of arguments."""
_SMALLEST_WEIGHT = 1e-30
"""If the largest weight is not between this number and its inverse, weights are scaled."""


def arguments(function: F) -> F:
    """Check the arguments of a function against its annotations in each call.

    An argument `Float[Array, "n 3"]` is converted to an array of floats and must have this shape; a name is
    the same size in all arguments. Numbers (`float`, `ScalarLike`) must be finite, an `int` must be a count,
    a `PRNGKey` a single key, and a value of another class, such as a record, an instance. Other annotations
    are ignored.

    Raises:
        ValueError: In a call of the function, if an argument does not fit its annotation.
    """
    signature, annotations = inspect.signature(function), inspect.get_annotations(function, eval_str=True)

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        try:
            bound, arrays = signature.bind(*args, **kwargs), {}
        except TypeError as error:
            raise TypeError(f"{function.__name__}() {error}") from None  # the message of Python
        for name, value in bound.arguments.items():
            bound.arguments[name] = _checked_argument(name, value, annotations.get(name), arrays)
        return function(*bound.args, **bound.kwargs)

    return checked  # type: ignore[return-value]


def shown(value: Any) -> str:
    """Return the text of a value in an error, one short line; for an array its type and shape."""
    if isinstance(value, Tracer):
        return f"traced {value.dtype}{value.shape}"
    if isinstance(value, np.ndarray | jax.Array):
        text = repr(value.item()) if _is_number(value) else f"{value.dtype}{value.shape}"
    else:
        text = " ".join(repr(value).split())
    return text if len(text) <= _WIDTH else f"{text[: _WIDTH - 4]} ..."


def count(name: str, value: Any, *, least: int = 1) -> int:
    """Return a count, after checking that it is whole, at least `least`, and not above the largest index.

    Raises:
        ValueError: If it is not.
    """
    is_whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    if not is_whole or not least <= int(value) <= _MOST:
        limit = f"at least {least}" if is_whole and int(value) < least else f"at most {_MOST}"
        raise ValueError(f"{name} must be {limit if is_whole else 'a whole number'}, got {shown(value)}")
    return int(value)


def grid(name: str, num: Any, dim: int, *, least: int = 1) -> tuple[int, ...]:
    """Return the number of points of a grid along each axis, after checking that all points fit in memory.

    Args:
        name: Name of the number in errors.
        num: One number for all axes, or a sequence with one for each.
        dim: Number of axes.
        least: The least number along an axis.

    Raises:
        ValueError: If a number is less than `least`, there is not one for each axis, or there are too many
            points.
    """
    is_one = not isinstance(num, Sequence | np.ndarray) or isinstance(num, str) or np.ndim(num) == 0
    if is_one:
        nums = (count(name, num, least=least),) * dim
    elif all(isinstance(value, numbers.Integral) and least <= int(value) <= _MOST for value in num):
        nums = tuple(map(int, num))
    else:
        raise ValueError(f"{name} must be whole numbers of at least {least}, got {shown(num)}")
    if len(nums) != dim:
        raise ValueError(f"{name} must be one number or {dim}, one for each axis, got {shown(num)}")
    if math.prod(nums) > _MOST_POINTS:
        each = f" along each of {dim} axes" if is_one else ""
        raise ValueError(f"{name} must leave at most {_MOST_POINTS} points in all, got {num}{each}")
    return nums


def number(name: str, value: Any, *, least: float = -math.inf, above: float = -math.inf) -> Any:
    """Return a number, after checking that it is real, finite in float32 and within its limits.

    An array without axes is returned as a number of Python.

    Raises:
        ValueError: If it is not.
    """
    if not _is_number(value):
        raise ValueError(f"{name} must be a number, got {shown(value)}")
    if isinstance(value, Tracer):
        return value
    value = value.item() if isinstance(value, np.ndarray | jax.Array) else value
    rounded = np.float32(value) if -FLOAT32_MAX <= value <= FLOAT32_MAX else np.float32(np.nan)
    if not (rounded >= least and rounded > above):
        note = ", which float32 cannot hold" if max(least, above) < value < math.inf else ""
        raise ValueError(f"{name} must be {_limits(least, above)}, got {shown(value)}{note}")
    return value


def vector(name: str, value: Any, *, largest: float = FLOAT32_MAX) -> np.ndarray:
    """Return a number or vector, which must not be traced, as a NumPy array.

    Raises:
        ValueError: If it is something else, or the size of an entry is above `largest`.
    """
    try:
        values = np.asarray(value)
    except (TypeError, ValueError):  # traced, or ragged
        values = np.asarray(None)
    if values.dtype.kind not in "iuf" or values.ndim > 1 or values.size == 0:
        raise ValueError(f"{name} must be a number or a vector of numbers, got {shown(value)}")
    values = finite(name, values.astype(float), largest=largest)
    finite(name, values[np.isfinite(values)])  # none that float32 would make infinite
    return values


def ends(low: Any, high: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return both ends of a range as vectors of one length, after checking that `low` is below `high`.

    Raises:
        ValueError: If it is not, or by less than `NARROWEST`, or if they are not vectors of one length.
    """
    low, high = np.atleast_1d(vector("low", low)), np.atleast_1d(vector("high", high))
    if low.shape != high.shape:
        raise ValueError(f"low and high must be vectors of one length, got {low.shape} and {high.shape}")
    width = high.astype(np.float32).astype(float) - low.astype(np.float32)
    if not np.all(width > 0):
        raise ValueError(f"low must be below high, got {low} and {high}")
    if not np.all(width >= NARROWEST):
        raise ValueError(f"low must be below high by at least {NARROWEST:g}, got {low} and {high}")
    return low, high


def host_array(
    name: str, value: Any, shape: tuple[int | str, ...] | None = None, *, note: str = ""
) -> Array | np.ndarray:
    """Return numbers as `array` does, but convert those that are not jax arrays to NumPy, in their precision.

    Raises:
        ValueError: As `array` does.
    """
    if isinstance(value, jax.Array):
        return array(name, value, shape, note=note)
    try:
        values = np.asarray(value)
    except (TypeError, ValueError):  # traced, or ragged
        return array(name, value, shape, note=note)
    if not _is_real(values):
        return array(name, value, shape, note=note)
    if shape is not None:
        _check_shape(name, values.shape, shape, note)
    is_wide_float = values.dtype.kind == "f" and values.dtype.itemsize >= 4
    return values if is_wide_float else values.astype(np.float64)


def array(name: str, value: Any, shape: tuple[int | str, ...] | None = None, *, note: str = "") -> Array:
    """Return numbers as an array of floats of at least 32 bits; such an array is returned unchanged.

    Args:
        name: Name of the array in errors.
        value: Real numbers; infinite numbers and NaN are allowed, see `finite`.
        shape: The required shape; a letter is any size above zero. None allows any shape.
        note: Reason for the shape, which errors add.

    Raises:
        ValueError: If the values are not real numbers, or have another shape.
    """
    try:
        result = value if isinstance(value, jax.Array) else _converted(value)
    except (TypeError, ValueError, OverflowError):
        result = None
    if result is None or not _is_real(result):
        raise ValueError(f"{name} must be an array of real numbers, got {shown(value)}")
    if shape is not None:
        _check_shape(name, result.shape, shape, note)
    is_wide_float = jnp.issubdtype(result.dtype, jnp.floating) and result.dtype.itemsize >= 4
    return result if is_wide_float else result.astype(jnp.float32)


def finite(
    name: str,
    values: A,
    *,
    least: float = -math.inf,
    above: float = -math.inf,
    largest: float = FLOAT32_MAX,
) -> A:
    """Return an array unchanged, after checking its entries, unless they are traced.

    Args:
        name: Name of the array in errors.
        values: The array.
        least: Lower limit of the entries, which is allowed.
        above: Lower limit of the entries, which is not allowed.
        largest: Upper limit of the size of the entries; may be infinity. By default entries must be finite.

    Raises:
        ValueError: If an entry is NaN, or outside the limits.
    """
    if not isinstance(values, Tracer):
        known = np.asarray(values)
        is_good = (np.abs(known) <= largest) & (known >= least) & ((known > above) | (above == -math.inf))
        if not is_good.all():
            raise ValueError(f"{name} must be {_limits(least, above, largest)}, got {known[~is_good][0]}")
    return values


def in_range(weights: Any) -> Any:
    """Return weights, scaled into the range of float32 if they are outside; only their ratios matter."""
    if isinstance(weights, np.ndarray) and weights.dtype == np.float64 and np.isfinite(weights).all():
        largest = weights.max(initial=0.0)
        if largest > 0 and not _SMALLEST_WEIGHT < largest < 1.0 / _SMALLEST_WEIGHT:
            return weights / largest
    return weights


def key(name: str, value: Any, *, num_axes: int = 0) -> Any:
    """Return a random key, or an array of keys, unchanged, after checking it.

    Typed keys can be of any implementation; raw keys of uint32 are of the default implementation.

    Raises:
        ValueError: If it is not a key, or has another number of axes.
    """
    shape = key_shape(value)
    if shape is None or len(shape) != num_axes or 0 in shape:
        examples = (
            "a random key, such as jax.random.key(0)",
            "random keys, such as jax.random.split(key, 5)",
        )
        raise ValueError(f"{name} must be {examples[num_axes]}, got {shown(value)}")
    return value


def function(name: str, value: Any, signature: str) -> None:
    """Check that a value can be called; `signature` is shown in the error.

    Raises:
        ValueError: If it cannot.
    """
    if not callable(value):
        raise ValueError(f"{name} must be a function {signature}, got {shown(value)}")


def instance(name: str, value: Any, *kinds: type) -> None:
    """Check that a value has one of these types.

    Raises:
        ValueError: If it does not.
    """
    if not isinstance(value, kinds):
        wanted = " or ".join(kind.__name__ for kind in kinds)
        raise ValueError(f"{name} must be of type {wanted}, got {shown(value)}")


def _check_shape(name: str, got: tuple[int, ...], wanted: tuple[int | str, ...], note: str) -> None:
    fits = len(got) == len(wanted) and all(
        size == limit or (isinstance(limit, str) and size > 0)
        for size, limit in zip(got, wanted, strict=True)
    )
    if not fits:
        text = f"({', '.join(map(str, wanted))}{',' if len(wanted) == 1 else ''})"
        raise ValueError(f"{name} must have shape {text}{note}, got {got}")


def _checked_argument(name: str, value: Any, kind: Any, arrays: _Arrays) -> Any:
    """Return an argument as its annotation requires; `arrays` holds the axes of earlier arguments."""
    kinds = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    if type(None) in kinds:
        if value is None:
            return None
        kinds = tuple(each for each in kinds if each is not type(None))
        kind = functools.reduce(operator.or_, kinds)
    if kind in (float, float | int):
        return number(name, value)
    if kind == ScalarLike:
        number(name, value)
    elif kind is int:
        return count(name, value)
    elif kind == PRNGKey:
        key(name, value)
    elif "float32" in getattr(kind, "dtypes", ()):
        return _checked_array(name, value, kind.dim_str.split(), arrays)
    elif all(inspect.isclass(each) and each is not Any and not hasattr(each, "dtypes") for each in kinds):
        instance(name, value, *kinds)
    return value


def _checked_array(name: str, value: Any, axes: list[str], arrays: _Arrays) -> Array:
    if axes and axes[0].startswith("*"):
        return array(name, value)
    known, note = {}, ""
    for other, (names, shape) in arrays.items():
        shared = {axis: size for axis, size in zip(names, shape, strict=True) if axis in axes}
        note += f" beside {other} {shape}" if shared else ""
        known |= shared
    shape = tuple(int(axis) if axis.isdigit() else known.get(axis, axis) for axis in axes)
    result = array(name, value, shape, note=note)
    arrays[name] = [axis if axis.isalpha() else "" for axis in axes], result.shape
    return result


def _converted(value: Any) -> Array:
    """Return a jax array, if possible by way of NumPy: jax reads letters in a list as types."""
    with contextlib.suppress(TypeError, ValueError):  # traced, or ragged
        value = np.asarray(value)
    # A number that is too large for the format becomes infinite, without a warning.
    with np.errstate(over="ignore"):
        return jnp.asarray(value)


def _limits(least: float, above: float, largest: float = FLOAT32_MAX) -> str:
    """Describe the allowed numbers in words."""
    words = {FLOAT32_MAX: "finite", math.inf: "numbers"}.get(largest, f"at most {largest:g} in size")
    if above > least:
        return f"{words} and above {above:g}"
    return f"{words} and at least {least:g}" if least > -math.inf else words


def _is_number(value: Any) -> bool:
    if isinstance(value, np.ndarray | jax.Array):
        return value.ndim == 0 and _is_real(value)
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _is_real(values: np.ndarray | jax.Array) -> bool:
    return any(jnp.issubdtype(values.dtype, kind) for kind in (jnp.floating, jnp.integer, jnp.bool_))


def converted(values: Any, dtype: jnp.dtype) -> Any:
    """Convert an array; an array of this type is returned unchanged, as each conversion takes time."""
    if values.dtype == dtype and not getattr(values, "weak_type", False):
        return values
    with np.errstate(over="ignore"):  # A number that is too large for the format becomes infinite.
        return values.astype(dtype)
