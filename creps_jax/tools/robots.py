"""The robots that the commands know, by name, each with the ranges in which it learns to walk."""

from collections.abc import Mapping
from typing import NamedTuple

from creps_jax.errors import UserError, suggest
from creps_jax.robots import robot as robots
from creps_jax.robots.robot import NAO, NAO_H25, Robot
from creps_jax.walking.params import NAO_BOUNDS, NAO_H25_BOUNDS

Bounds = tuple[tuple[float, ...], tuple[float, ...]]


class RobotRanges(NamedTuple):
    """A robot and the ranges of speeds and parameters in which it learns to walk.

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


_RANGES = {NAO.name: (0.1, 0.6, NAO_BOUNDS), NAO_H25.name: (0.05, 0.3, NAO_H25_BOUNDS)}
ROBOTS: Mapping[str, RobotRanges] = {
    name: RobotRanges(robot, *_RANGES[name]) for name, robot in robots.ROBOTS.items()
}


def find_robot(name: str) -> RobotRanges:
    """Return a robot and its ranges by the robot's name.

    Raises:
        UserError: with the nearest name and all known names, if the name is unknown.
    """
    if name not in ROBOTS:
        raise UserError(f"unknown robot {name!r}{suggest(name, ROBOTS)}")
    return ROBOTS[name]
