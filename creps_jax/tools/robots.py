"""The robots that learn to walk, by name, each with what it can do."""

from collections.abc import Mapping
from typing import NamedTuple

from creps_jax.errors import UserError, suggest
from creps_jax.robots.robot import NAO, NAO_H25, Robot
from creps_jax.walking.params import NAO_BOUNDS, NAO_H25_BOUNDS

Bounds = tuple[tuple[float, ...], tuple[float, ...]]


class Walker(NamedTuple):
    """A robot and the range in which it learns to walk.

    Attributes:
        robot: the robot.
        low: lowest speed, m/s.
        high: highest speed, m/s.
        bounds: lower and upper bounds of the walking parameters.
    """

    robot: Robot
    low: float
    high: float
    bounds: Bounds


WALKERS: Mapping[str, Walker] = {
    walker.robot.name: walker
    for walker in (Walker(NAO, 0.1, 0.6, NAO_BOUNDS), Walker(NAO_H25, 0.05, 0.3, NAO_H25_BOUNDS))
}


def find_walker(name: str) -> Walker:
    """Return the walker of a robot's name.

    Raises:
        UserError: with the nearest name, and all of them, if there is none.
    """
    if name not in WALKERS:
        raise UserError(f"unknown robot {name!r}{suggest(name, WALKERS)}")
    return WALKERS[name]
