"""Name the ways to keep parameters within their bounds, and write ranges; jax is not imported."""

from collections.abc import Sequence
from typing import Any

from creps_jax.errors import UserError

__all__ = [
    "CLIP",
    "NONE",
    "PENALTY",
    "RUN_CONSTRAINTS",
    "SESSION_CONSTRAINTS",
    "SIGMOID",
    "SPACE_CONSTRAINTS",
    "check_constraint",
    "range_error",
    "range_text",
]

SIGMOID = "sigmoid"
"""Squash free numbers into the bounds, Eq. 17."""
CLIP = "clip"
"""Cut off at the bounds what lies outside."""
NONE = "none"
"""Leave the numbers as they are."""
PENALTY = "penalty"
"""In learning, subtract a penalty from the reward outside of the bounds; learned policies are clipped."""
SPACE_CONSTRAINTS = (SIGMOID, CLIP, NONE)
"""How the numbers that a policy draws become parameters, see `Space`."""
SESSION_CONSTRAINTS = (SIGMOID, CLIP)
"""The constraints of a session with a real robot, which needs all parameters inside their bounds."""
RUN_CONSTRAINTS = (SIGMOID, PENALTY)
"""The constraints of learning in simulation."""


def check_constraint(constraint: Any, known: Sequence[str] = SPACE_CONSTRAINTS) -> None:
    """Check that a constraint is one of the known ones.

    Raises:
        UserError: If it is not.
    """
    if constraint not in known:
        raise UserError(f"constraint must be one of {', '.join(known)}, got {constraint!r}")


def range_text(low: float, high: float, unit: str) -> str:
    """Write a range with its unit, such as "0.1 to 0.6 m/s"."""
    return f"{low:g} to {high:g} {unit}".rstrip()


def range_error(name: str, value: float, low: float, high: float, unit: str) -> UserError:
    """Return the error of a variable that is out of its range."""
    return UserError(f"{name} must be within its range, {range_text(low, high, unit)}, got {value}")
