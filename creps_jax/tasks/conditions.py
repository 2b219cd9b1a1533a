"""What a walk may meet besides the speed it is asked for, each a variable of the context.

A condition is a value: a name, a range, and a function that puts a number into the circumstances of a walk.
`nao_walk(conditions=(slope(-5.0, 5.0), payload(0.0, 1.0)))` has the context (speed, slope, payload).
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from creps_jax import checks
from creps_jax.simulation.world import World
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["Circumstances", "Condition", "friction", "payload", "push", "slope"]


class Circumstances(NamedTuple):
    """What a walk meets.

    Attributes:
        world: The world it goes through, in the frame of the floor.
        push: What is added to the robot's velocity to the left, m/s.
        push_time: When that is, s; None where there is no push.
    """

    world: World
    push: ScalarLike = 0.0
    push_time: float | None = None


class Condition(NamedTuple):
    """One variable of the context.

    Attributes:
        name: What it is.
        unit: Its unit.
        low: Its lowest value.
        high: Its highest value.
        apply: (circumstances, value) -> the circumstances with it.
        begins: From when on it is felt, s.
    """

    name: str
    unit: str
    low: float
    high: float
    apply: Callable[[Circumstances, Scalar], Circumstances]
    begins: float = 0.0


@checks.arguments
def slope(low: float, high: float) -> Condition:
    """Let the floor rise ahead of the robot, by an angle in degrees; below zero it falls.

    All positions, and so the speed, stay in the frame of the floor: gravity turns about y instead. The robot
    is told the slope. Its steps follow the floor, and its lean counts from the vertical.

    Args:
        low: Lowest slope, deg; above -90.
        high: Highest slope, deg; below 90.

    Returns:
        The condition.

    Raises:
        ValueError: If the range is not in order, or not within 90 degrees.
    """

    def apply(circumstances: Circumstances, value: Scalar) -> Circumstances:
        angle = value * (math.pi / 180.0)
        strength = jnp.linalg.norm(jnp.asarray(circumstances.world.gravity))
        gravity = -strength * jnp.stack([jnp.sin(angle), jnp.zeros_like(angle), jnp.cos(angle)])
        return circumstances._replace(world=circumstances.world._replace(gravity=gravity))

    return _checked(Condition("slope", "deg", low, high, apply), above=-90.0, below=90.0)


@checks.arguments
def payload(low: float, high: float) -> Condition:
    """Load the torso with a mass at its centre, in kg.

    Raises:
        ValueError: If the range is not in order, or begins below zero.
    """

    def apply(circumstances: Circumstances, value: Scalar) -> Circumstances:
        return circumstances._replace(world=circumstances.world._replace(payload=value))

    return _checked(Condition("payload", "kg", low, high, apply), least=0.0)


@checks.arguments
def friction(low: float, high: float) -> Condition:
    """Multiply the friction of the robot's model, whose coefficient is 1 for the NAO.

    Raises:
        ValueError: If the range is not in order, or does not stay above zero.
    """

    def apply(circumstances: Circumstances, value: Scalar) -> Circumstances:
        return circumstances._replace(world=circumstances.world._replace(friction=value))

    return _checked(Condition("friction", "", low, high, apply), above=0.0)


@checks.arguments
def push(low: float, high: float, *, time: float = 3.0) -> Condition:
    """Push the robot once: all of it moves faster to the left at once, by a velocity in m/s.

    That is the impulse which would do so in the air. On the ground the floor holds the standing foot.

    Args:
        low: Lowest velocity, m/s; below zero it is to the right.
        high: Highest velocity, m/s.
        time: When it is pushed, s.

    Returns:
        The condition.

    Raises:
        ValueError: If the range is not in order, or the time is not positive.
    """
    checks.number("time", time, above=0.0)

    def apply(circumstances: Circumstances, value: Scalar) -> Circumstances:
        return circumstances._replace(push=value, push_time=time)

    return _checked(Condition("push", "m/s", low, high, apply, begins=time))


def check_conditions(conditions: Sequence[Condition], duration: float) -> None:
    """Refuse conditions that a walk of this duration, in s, cannot have.

    Raises:
        ValueError: If two have one name, of which the last would count, or one begins after the end.
    """
    if not isinstance(conditions, Sequence) or not all(isinstance(each, Condition) for each in conditions):
        raise ValueError(f"conditions must be a list of Condition, got {checks.shown(conditions)}")
    names = [condition.name for condition in conditions]
    if len(set(names)) < len(names):
        raise ValueError(f"every condition must have a name of its own, got {', '.join(names)}")
    for condition in conditions:
        if not condition.begins < duration:
            raise ValueError(
                f"the {condition.name} must begin before the end at {duration} s, got {condition.begins} s"
            )


def circumstances_of(
    conditions: Sequence[Condition], values: Float[Array, " k"], world: World
) -> Circumstances | None:
    """Put the values of all conditions into the circumstances of a walk; None without conditions."""
    if not conditions:
        return None
    circumstances = Circumstances(world)
    for condition, value in zip(conditions, values, strict=True):
        circumstances = condition.apply(circumstances, value)
    return circumstances


def upward(world: World) -> Float[Array, "3"]:
    """Return the direction against gravity, in the frame of the floor."""
    gravity = jnp.asarray(world.gravity)
    return -gravity / jnp.linalg.norm(gravity)


def slope_angle(world: World) -> Scalar:
    """Return by how much the floor rises ahead, rad: as far forward a trunk leans from it that is upright."""
    up = upward(world)
    return jnp.arctan2(up[0], up[2])


def _checked(
    condition: Condition, *, above: float = -np.inf, below: float = np.inf, least: float = -np.inf
) -> Condition:
    """Return a condition whose range is in order and within these limits.

    Raises:
        ValueError: If it is not.
    """
    name, _, low, high, *_ = condition
    checks.ends(low, high)
    if not (low > above and low >= least and high < below):
        limits = {"above": above, "at least": least, "below": below}
        wanted = " and ".join(f"{word} {limit:g}" for word, limit in limits.items() if np.isfinite(limit))
        raise ValueError(f"low and high of the {name} must be {wanted}, got {low} and {high}")
    return condition
