"""Check the arguments with which a humanoid is read from its model."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from creps_jax import checks
from creps_jax.errors import suggest
from creps_jax.robots.mjcf_servos import Servo
from creps_jax.robots.robot import GRAVITY

# Only `humanoid_from_mjcf` is public.
__all__: list[str] = []

# Largest speed of a joint if it is not given, rad/s.
_MAX_SPEED = 8.0
# The number of joints of a leg, with words for the error.
LEG = {5: "5", 6: "6 joints, from hip to ankle"}
# The number of feet.
FEET = {2: "2 bodies, the left and the right foot"}
# Joints that the inverse kinematics does not move.
OTHERS = "joints outside of the legs"
# Largest difference of an angle that is at its limit, rad.
ROUNDING = 1e-6


def checked_names(argument: str, values: Any, kinds: Mapping[int, str]) -> tuple[str, ...]:
    """Return names after checking their number, one of `kinds`, and that each is there once."""
    is_list = isinstance(values, Sequence) and not isinstance(values, str)
    if not is_list or len(values) not in kinds or not all(isinstance(value, str) for value in values):
        expected = " or ".join(kinds.values())
        raise ValueError(f"{argument} must be the names of {expected}, got {checks.shown(values)}")
    if len(set(values)) != len(values):
        raise ValueError(f"{argument} must have each name once, got {checks.shown(values)}")
    return tuple(values)


def named(argument: str, kind: str, name: str, known: Sequence[str]) -> str:
    """Return a name after checking that it is known.

    Args:
        argument: The argument with the name, for errors.
        kind: What the known names are.
        name: The name.
        known: The known names.

    Raises:
        ValueError: With the nearest name, if it is not.
    """
    if name not in known:
        if not known:
            raise ValueError(
                f"{argument} must name {kind} of the model, which has none, got {checks.shown(name)}"
            )
        side = _side_of(str(name)) or _side_of(argument)
        near = suggest(str(name), known, [each for each in known if _side_of(each) == side])
        raise ValueError(f"{argument} must name {kind} of the model, got {checks.shown(name)}{near}")
    return name


def _side_of(name: str) -> str | None:
    """Return the side that a name tells, by a word or by a letter that is a word."""
    for side in ("left", "right"):
        letter = side[0] + side[0].upper()
        if side in name.lower() or re.search(rf"(?:^|[^A-Za-z])[{letter}](?:$|[^a-z])", name):
            return side
    return None


def by_joint(
    argument: str, values: Any, kind: str, names: Sequence[str], *, above: float = -np.inf
) -> dict[str, float]:
    """Return numbers by joint after checking the names and the numbers."""
    values = {} if values is None else values
    if not isinstance(values, Mapping):
        raise ValueError(f"{argument} must be numbers by joint, got {checks.shown(values)}")
    return {
        named(argument, kind, joint, names): float(
            checks.number(f"{argument} of {joint}", value, above=above)
        )
        for joint, value in values.items()
    }


def checked_held(values: Any, names: Sequence[str], servos: Mapping[str, Servo]) -> dict[str, float]:
    """Return the angle at which each joint outside of the legs is held, rad: zero, if it can be."""
    given = by_joint("held", values, OTHERS, names)
    for joint, angle in given.items():
        low, high = servos[joint].low, servos[joint].high
        if not low - ROUNDING <= angle <= high + ROUNDING:
            raise ValueError(f"held of {joint} must be from {low:.2f} to {high:.2f} rad, got {angle:g}")
    return {joint: given.get(joint, min(max(0.0, servos[joint].low), servos[joint].high)) for joint in names}


def checked_max_speeds(max_speed: Any, names: Sequence[str]) -> tuple[float, ...]:
    """Return the largest speed of each joint, rad/s."""
    if isinstance(max_speed, Mapping):
        given = by_joint("max_speed", max_speed, "joints", names, above=0.0)
        return tuple(given.get(joint, _MAX_SPEED) for joint in names)
    fastest = _MAX_SPEED if max_speed is None else checks.number("max_speed", max_speed, above=0.0)
    return (float(fastest),) * len(names)


def check_size(leg: float, foot_spacing: float | int | None, speeds: tuple[float, float] | None) -> None:
    """Check distance of the feet and speeds against the length of the leg, m.

    Raises:
        ValueError: If the feet are farther apart than the leg is long, or the Froude number is above 1.
    """
    if foot_spacing is not None and not foot_spacing < leg:
        raise ValueError(
            f"foot_spacing must be below the length of the leg, {leg:.3f} m, got {checks.shown(foot_spacing)}"
        )
    fastest = np.sqrt(GRAVITY * leg)
    if speeds is not None and not speeds[1] <= fastest:
        raise ValueError(
            f"speeds must be at most {fastest:.2f} m/s, the fastest walk of a leg of {leg:.3f} m (Froude "
            f"number 1), got {speeds[1]:g}"
        )


def check_number(argument: str, value: Any, **limits: float) -> None:
    """Check a number that may be None, see `checks.number`."""
    if value is not None:
        checks.number(argument, value, **limits)


def checked_speeds(speeds: Any) -> tuple[float, float]:
    """Return the lowest and the highest speed after checking them, m/s."""
    values = checks.finite("speeds", checks.vector("speeds", speeds), above=0.0)
    if values.shape != (2,) or not values[0] < values[1]:
        raise ValueError(f"speeds must be two numbers, the lower first, got {checks.shown(speeds)}")
    return float(values[0]), float(values[1])
