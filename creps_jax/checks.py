"""Check what users hand over, where it comes in: one `ValueError` that shows the value and what was expected.

Types and shapes are known while a program is traced, values are not: those of traced arrays pass. No check
adds anything to a compiled program.
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
"""The smallest number above zero that compiled programs do not take for zero."""
LARGEST = 1e15
"""Size of numbers up to which products of two of them, and sums of those, are finite in float32."""
NARROWEST = 1e-30
"""The least width of a range: float32 can hold parts of it too, such as a millionth."""
_MOST = 2**31 - 1
"""The largest count: indices have 32 bits."""
_MOST_POINTS = 10_000_000
"""The largest grid: its size is a power, and a slip would fill the memory."""
_WIDTH = 80
"""Characters of a value that errors show."""

F = TypeVar("F", bound=Callable[..., Any])
A = TypeVar("A", Array, np.ndarray)
_Arrays = dict[str, tuple[list[str], tuple[int, ...]]]
"""Names and sizes of the axes of arguments."""
_SMALLEST_WEIGHT = 1e-30
"""Size of the largest weight, or the inverse of it, from which on weights are scaled."""


def arguments(function: F) -> F:
    """Check the arguments of a function by its annotations, whenever it is called.

    Arrays (`Float[Array, "n 3"]`) become floats of the shape that is written there, in which a name has one
    size throughout. Numbers (`float`, `ScalarLike`) have to be finite, an `int` is a count, a `PRNGKey` one
    key, and of other classes, such as records, a value is an instance. Other annotations are not looked at.

    Raises:
        ValueError: By the function, if an argument is something else.
    """
    signature, annotations = inspect.signature(function), inspect.get_annotations(function, eval_str=True)

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        try:
            bound, arrays = signature.bind(*args, **kwargs), {}
        except TypeError as error:
            raise TypeError(f"{function.__name__}() {error}") from None  # as Python has it
        for name, value in bound.arguments.items():
            bound.arguments[name] = _checked_argument(name, value, annotations.get(name), arrays)
        return function(*bound.args, **bound.kwargs)

    return checked  # type: ignore[return-value]


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
    if not is_whole or not least <= int(value) <= _MOST:
        limit = f"at least {least}" if is_whole and int(value) < least else f"at most {_MOST}"
        raise ValueError(f"{name} must be {limit if is_whole else 'a whole number'}, got {shown(value)}")
    return int(value)


def grid(name: str, num: Any, dim: int, *, least: int = 1) -> tuple[int, ...]:
    """Return how many points a grid has along each of its `dim` axes, after checking that all fit in memory.

    Args:
        name: What errors call the number.
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
    """Return a number, after checking that it is a real one, finite in float32 and in its limits.

    That of an array without axes is returned as Python has it.

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
    """Return a setting that is a number or a vector, given outside of any trace, as an array of NumPy.

    Raises:
        ValueError: If it is something else, or an entry is farther from zero than `largest`.
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
    """Return both ends of a range as vectors of one length, after checking that the one is below the other.

    Raises:
        ValueError: If it is not, or by less than `NARROWEST`, or they are no vectors of one length.
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
    """Return numbers as `array` does, but leave those that are not of jax with NumPy, in their precision.

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
    """Return numbers as an array of floats, of 32 bits at least; one that is such is returned as it is.

    Args:
        name: What they are, for the error.
        value: Real numbers; those that are not finite pass, see `finite`.
        shape: The shape that they must have, if any; a letter stands for any number above zero.
        note: Why, for the error.

    Raises:
        ValueError: If they are no real numbers, or have another shape.
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
    """Return an array as it is, after checking its entries, unless they are traced.

    Args:
        name: What they are, for the error.
        values: The array.
        least: The least that an entry may be.
        above: What entries have to be above.
        largest: How far from zero an entry may be, infinitely far too; by default any finite distance.

    Raises:
        ValueError: If an entry is NaN, or out of its limits.
    """
    if not isinstance(values, Tracer):
        known = np.asarray(values)
        is_good = (np.abs(known) <= largest) & (known >= least) & ((known > above) | (above == -math.inf))
        if not is_good.all():
            raise ValueError(f"{name} must be {_limits(least, above, largest)}, got {known[~is_good][0]}")
    return values


def in_range(weights: Any) -> Any:
    """Return weights, of which only ratios matter, in the range of single precision, as exp(-200) is not."""
    if isinstance(weights, np.ndarray) and weights.dtype == np.float64 and np.isfinite(weights).all():
        largest = weights.max(initial=0.0)
        if largest > 0 and not _SMALLEST_WEIGHT < largest < 1.0 / _SMALLEST_WEIGHT:
            return weights / largest
    return weights


def key(name: str, value: Any, *, num_axes: int = 0) -> Any:
    """Return a random key as it is, or an array of keys, after checking that it is one.

    Typed keys may be of any implementation; raw ones, of uint32, are of the default one.

    Raises:
        ValueError: If it is something else, or has another number of axes.
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


def _check_shape(name: str, got: tuple[int, ...], wanted: tuple[int | str, ...], note: str) -> None:
    fits = len(got) == len(wanted) and all(
        size == limit or (isinstance(limit, str) and size > 0)
        for size, limit in zip(got, wanted, strict=True)
    )
    if not fits:
        text = f"({', '.join(map(str, wanted))}{',' if len(wanted) == 1 else ''})"
        raise ValueError(f"{name} must have shape {text}{note}, got {got}")


def _checked_argument(name: str, value: Any, kind: Any, arrays: _Arrays) -> Any:
    """Return an argument as it is annotated; `arrays` holds the axes of those so far."""
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
    """Return an array of jax, by way of NumPy where that can: jax takes letters in a list for types."""
    with contextlib.suppress(TypeError, ValueError):  # traced, or ragged
        value = np.asarray(value)
    # What is too large for the format becomes infinite, and needs no warning besides.
    with np.errstate(over="ignore"):
        return jnp.asarray(value)


def _limits(least: float, above: float, largest: float = FLOAT32_MAX) -> str:
    """Say in words which numbers are wanted."""
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
    """Convert an array; what has that type is returned as it is, as even an idle conversion takes time."""
    if values.dtype == dtype and not getattr(values, "weak_type", False):
        return values
    with np.errstate(over="ignore"):  # What is too large for the format becomes infinite: not valid.
        return values.astype(dtype)
