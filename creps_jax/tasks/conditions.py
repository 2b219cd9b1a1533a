"""Conditions of a walk besides the commanded speed, each a variable of the context.

A condition is a record: a name, a range, and a function that writes its value into the circumstances of a
walk. `nao_walk(conditions=(slope(-5.0, 5.0), payload(0.0, 1.0)))` has the context (speed, slope, payload).
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from creps_jax import checks
from creps_jax.policies.space import Space
from creps_jax.simulation.world import World
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["Circumstances", "Condition", "friction", "payload", "push", "slope"]


class Circumstances(NamedTuple):
    """The values of all conditions of one walk.

    Attributes:
        world: The world of the robot, in the frame of the floor.
        push: Velocity to the left that a push adds to that of the robot, m/s.
        push_time: Time of the push, s; None without a push.
    """

    world: World
    push: ScalarLike = 0.0
    push_time: float | None = None


class Condition(NamedTuple):
    """One variable of the context.

    Attributes:
        name: Name of the condition.
        unit: Unit of its value.
        low: Lowest value.
        high: Highest value.
        apply: (circumstances, value) -> the circumstances with this value.
        begins: Time from which the condition acts, s.
    """

    name: str
    unit: str
    low: float
    high: float
    apply: Callable[[Circumstances, Scalar], Circumstances]
    begins: float = 0.0


@checks.arguments
def slope(low: float, high: float) -> Condition:
    """Let the floor rise along x of the world, by an angle in degrees; with a negative angle it descends.

    All positions, and so the speed, are in the frame of the floor; gravity is rotated about y instead. The
    robot starts along x, and knows the slope: its steps follow the floor, and its lean is measured from the
    vertical.

    Args:
        low: Lowest slope, deg; above -90.
        high: Highest slope, deg; below 90.

    Returns:
        The condition.

    Raises:
        ValueError: If the range is not in order, or not within -90 to 90 degrees.
    """

    def apply(circumstances: Circumstances, value: Scalar) -> Circumstances:
        angle = value * (math.pi / 180.0)
        strength = jnp.linalg.norm(jnp.asarray(circumstances.world.gravity))
        gravity = -strength * jnp.stack([jnp.sin(angle), jnp.zeros_like(angle), jnp.cos(angle)])
        return circumstances._replace(world=circumstances.world._replace(gravity=gravity))

    return _checked(Condition("slope", "deg", low, high, apply), above=-90.0, below=90.0)


@checks.arguments
def payload(low: float, high: float) -> Condition:
    """Add a mass to the torso at its centre of mass, in kg.

    Args:
        low: Lowest mass, kg; at least 0.
        high: Highest mass, kg.

    Returns:
        The condition.

    Raises:
        ValueError: If the range is not in order, or its lower end is below 0.
    """

    def apply(circumstances: Circumstances, value: Scalar) -> Circumstances:
        return circumstances._replace(world=circumstances.world._replace(payload=value))

    return _checked(Condition("payload", "kg", low, high, apply), least=0.0)


@checks.arguments
def friction(low: float, high: float) -> Condition:
    """Multiply the sliding friction of the robot's model, whose coefficient is 1 for the NAO.

    Args:
        low: Lowest factor; above 0.
        high: Highest factor.

    Returns:
        The condition.

    Raises:
        ValueError: If the range is not in order, or its lower end is not above 0.
    """

    def apply(circumstances: Circumstances, value: Scalar) -> Circumstances:
        return circumstances._replace(world=circumstances.world._replace(friction=value))

    return _checked(Condition("friction", "", low, high, apply), above=0.0)


@checks.arguments
def push(low: float, high: float, *, time: float = 3.0) -> Condition:
    """Push the robot once: add a velocity in m/s to the left to the whole robot at one time.

    The push is the impulse that causes this velocity in the air. On the ground the floor holds the standing
    foot.

    Args:
        low: Lowest velocity, m/s; a negative velocity is to the right.
        high: Highest velocity, m/s.
        time: Time of the push, s.

    Returns:
        The condition.

    Raises:
        ValueError: If the range is not in order, or the time is not positive.
    """
    checks.number("time", time, above=0.0)

    def apply(circumstances: Circumstances, value: Scalar) -> Circumstances:
        return circumstances._replace(push=value, push_time=time)

    return _checked(Condition("push", "m/s", low, high, apply, begins=time))


def with_conditions(space: Space, conditions: Sequence[Condition]) -> Space:
    """Return the space of contexts that hold the variables of a space and then the conditions."""
    return Space(
        (*space.names, *(c.name for c in conditions)),
        (*space.low, *(c.low for c in conditions)),
        (*space.high, *(c.high for c in conditions)),
        (*space.units, *(c.unit for c in conditions)),
    )


def check_conditions(conditions: Sequence[Condition], duration: float, period: float) -> None:
    """Check that a walk of this duration, in control steps of this period, can have these conditions.

    Args:
        conditions: The conditions.
        duration: Length of the walk, s.
        period: Duration of a control step, s. A walk is as long as the nearest number of control steps, and
            a condition begins with the nearest one.

    Raises:
        ValueError: If two have the same name (the second would replace the first), or one begins after the
            last control step.
    """
    if not isinstance(conditions, Sequence) or not all(isinstance(each, Condition) for each in conditions):
        raise ValueError(f"conditions must be a list of Condition, got {checks.shown(conditions)}")
    names = [condition.name for condition in conditions]
    if len(set(names)) < len(names):
        raise ValueError(f"every condition must have a name of its own, got {', '.join(names)}")
    for condition in conditions:
        if not round(condition.begins / period) < round(duration / period):
            raise ValueError(
                f"the {condition.name} must begin before the end at {duration} s, both rounded to control "
                f"steps of {period} s, got {condition.begins} s"
            )


def circumstances_of(
    conditions: Sequence[Condition], values: Float[Array, " k"], world: World
) -> Circumstances | None:
    """Return the circumstances of a walk with the value of each condition; None without conditions."""
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
    """Return the slope of the floor ahead, rad: also the lean of a vertical trunk from the floor's normal."""
    up = upward(world)
    return jnp.arctan2(up[0], up[2])


def _checked(
    condition: Condition, *, above: float = -np.inf, below: float = np.inf, least: float = -np.inf
) -> Condition:
    """Return a condition after checking that its range is in order and within these limits.

    Raises:
        ValueError: If the range is not.
    """
    name, _, low, high, *_ = condition
    checks.ends(low, high)
    if not (low > above and low >= least and high < below):
        limits = {"above": above, "at least": least, "below": below}
        wanted = " and ".join(f"{word} {limit:g}" for word, limit in limits.items() if np.isfinite(limit))
        raise ValueError(f"low and high of the {name} must be {wanted}, got {low} and {high}")
    return condition
