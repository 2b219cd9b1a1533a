"""Check the arguments with which a humanoid is read from its model."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from creps_jax import checks
from creps_jax.errors import suggest
from creps_jax.robots.mjcf_servos import Servo
from creps_jax.robots.robot import GRAVITY
from creps_jax.typing import Float

# Only `humanoid_from_mjcf` is public.
__all__: list[str] = []

# Largest speed of a joint if it is not given, and the largest that can be given, rad/s.
_MAX_SPEED, _FASTEST = 8.0, 100.0
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
    if twice := [value for value in dict.fromkeys(values) if values.count(value) > 1]:
        raise ValueError(f"{argument} must have each name once, got {', '.join(map(repr, twice))} repeatedly")
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
        for joint, speed in given.items():
            _check_fastest(f"max_speed of {joint}", speed)
        return tuple(given.get(joint, _MAX_SPEED) for joint in names)
    fastest = _MAX_SPEED if max_speed is None else checks.number("max_speed", max_speed, above=0.0)
    _check_fastest("max_speed", fastest)
    return (float(fastest),) * len(names)


def _check_fastest(argument: str, speed: float | int) -> None:
    if speed > _FASTEST:
        raise ValueError(
            f"{argument} must be at most {_FASTEST:g} rad/s, got {speed:g}: convert degrees to radians"
        )


def check_name(name: Any) -> None:
    """Check the name of a robot, which is printed and stands in the comments of exported code."""
    checks.instance("name", name, str)
    if not name.strip() or not name.isprintable():
        raise ValueError(f"name must be one line of printable characters, got {checks.shown(name)}")


def check_size(
    leg: float, inner: float, foot_spacing: float | int | None, speeds: tuple[float, float] | None
) -> None:
    """Check distance of the feet and speeds against the lengths of the robot.

    Args:
        leg: The length of the leg, m.
        inner: How far a foot reaches inwards from its ankle, m.
        foot_spacing: Distance between the ankles, m, if it is given.
        speeds: Lowest and highest speed, m/s, if they are given.

    Raises:
        ValueError: If the feet are farther apart than the leg is long or overlap, or the Froude number is
            above 1.
    """
    if foot_spacing is not None and not foot_spacing < leg:
        raise ValueError(
            f"foot_spacing must be below the length of the leg, {leg:.3f} m, got {checks.shown(foot_spacing)}"
        )
    if foot_spacing is not None and not foot_spacing > 2.0 * inner:
        raise ValueError(
            f"foot_spacing must be above {2.0 * inner:.3f} m, so that the feet, which reach {inner:.3f} m "
            f"inwards from the ankles, do not overlap, got {checks.shown(foot_spacing)}"
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
    expected = "be two numbers, the lower first"
    values = checks.finite("speeds", numbers("speeds", speeds, 2, expected), above=0.0)
    if not values[0] < values[1]:
        raise ValueError(f"speeds must {expected}, got {checks.shown(speeds)}")
    return float(values[0]), float(values[1])


def numbers(argument: str, values: Any, count: int, expected: str) -> Float[np.ndarray, " count"]:
    """Return a vector of `count` numbers.

    Raises:
        ValueError: That the argument must be what is `expected`, or that a number is not finite.
    """
    try:
        found = np.asarray(values)
    except (TypeError, ValueError):  # traced, or ragged
        found = np.asarray(None)
    if found.dtype.kind not in "iuf" or found.shape != (count,):
        raise ValueError(f"{argument} must {expected}, got {checks.shown(values)}")
    return checks.vector(argument, found)
