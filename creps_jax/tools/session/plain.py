"""Read dataclasses from plain JSON values, with a clear error for each mistake; write readable JSON."""

import dataclasses
import json
import types
import typing
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from creps_jax.errors import UserError, suggest

_LARGEST = float(np.finfo(np.float32).max)
"""The learner computes in single precision."""
_WIDTH = 110

T = TypeVar("T")


def read(kind: type[T], values: Any, name: object) -> T:
    """Make a dataclass from plain values, as in JSON.

    Args:
        kind: a dataclass whose fields are numbers, text, tuples, dicts or other such dataclasses, or unions
            of one of these with a tuple or None.
        values: a dict of its fields.
        name: the source of the values, for errors.

    Raises:
        UserError: if a field is unknown, missing or of a wrong kind, or if the dataclass refuses it.
    """
    try:
        return _read(kind, values, "")
    except UserError as error:
        raise UserError(f"{name}: {error}") from None


def to_text(values: Any, indent: str = "") -> str:
    """Write values as JSON: each row of numbers, and everything that fits, in one line."""
    line = json.dumps(values, ensure_ascii=False)
    nested = (dict, list, tuple)
    is_row = isinstance(values, list | tuple) and not any(isinstance(value, nested) for value in values)
    if is_row or not isinstance(values, nested) or len(indent + line) <= _WIDTH:
        return line
    inner = indent + "  "
    if isinstance(values, dict):
        parts = [f"{json.dumps(name)}: {to_text(value, inner)}" for name, value in values.items()]
    else:
        parts = [to_text(value, inner) for value in values]
    opening, closing = "{}" if isinstance(values, dict) else "[]"
    return f"{opening}\n{inner}" + f",\n{inner}".join(parts) + f"\n{indent}{closing}"


def shortest(values: Any) -> list[float]:
    """Return the shortest decimals that are read back as these numbers in single precision."""
    return [float(str(value)) for value in np.asarray(values, np.float32)]


def _read(kind: type[T], values: Any, place: str) -> T:
    fields = {field.name: field for field in dataclasses.fields(kind)}  # type: ignore[arg-type]
    if not isinstance(values, dict):
        raise UserError(_expected(place, f"an object with the fields {', '.join(fields)}", values))
    for name in values:
        if name not in fields:
            raise UserError(f"unknown field {_join(place, name)!r}{suggest(name, fields)}")
    for name, field in fields.items():
        if name not in values and field.default is field.default_factory is dataclasses.MISSING:
            raise UserError(f"{_join(place, name)} is missing")
    known = {name: _value(fields[name].type, value, _join(place, name)) for name, value in values.items()}
    try:
        return kind(**known)
    except UserError as error:
        raise UserError(f"{place}: {error}" if place else str(error)) from None


def _join(place: str, name: str) -> str:
    return f"{place}.{name}" if place else name


def _value(kind: Any, value: Any, place: str) -> Any:
    container, elements = typing.get_origin(kind), typing.get_args(kind)
    if container is types.UnionType:
        if value is None:
            return None
        is_list = isinstance(value, list | tuple)
        kinds = [each for each in elements if each is not types.NoneType]
        fitting = [each for each in kinds if (typing.get_origin(each) is tuple) == is_list]
        return _value((fitting or kinds)[0], value, place)
    if dataclasses.is_dataclass(kind):
        return _read(kind, value, place)  # type: ignore[arg-type]
    if container is tuple:
        if not isinstance(value, list | tuple):
            raise UserError(_expected(place, "a list", value))
        return tuple(_value(elements[0], item, f"{place}[{i}]") for i, item in enumerate(value))
    if container is dict:
        if not isinstance(value, dict):
            raise UserError(_expected(place, "an object", value))
        return {name: _value(elements[1], item, f"{place}.{name}") for name, item in value.items()}
    if kind is Any:
        return value
    meaning, is_right = _SIMPLE[kind]
    if not is_right(value):
        raise UserError(_expected(place, meaning, value))
    return kind(value)


def is_number(value: Any) -> bool:
    """Return whether a value is a number that is finite in single precision."""
    # The comparison is also false for NaN, and takes whole numbers of any length.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST


_SIMPLE: dict[Any, tuple[str, Callable[[Any], bool]]] = {
    float: ("a finite number", is_number),
    int: ("a whole number", lambda value: isinstance(value, int) and is_number(value)),
    str: ("text", lambda value: isinstance(value, str)),
    bool: ("true or false", lambda value: isinstance(value, bool)),
}


def _expected(place: str, meaning: str, value: Any) -> str:
    return f"{place or 'it'} must be {meaning}, got {value!r}"
