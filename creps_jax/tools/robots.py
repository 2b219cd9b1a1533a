"""The robots that the commands know: by name, or by a TOML file that describes them."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from creps_jax.errors import UserError, suggest
from creps_jax.robots import robot as robots
from creps_jax.robots.humanoid import Humanoid
from creps_jax.robots.robot import NAO, NAO_H25, Robot
from creps_jax.robots.spec import humanoid_from_toml, model_file
from creps_jax.walking.params import NAO_BOUNDS, NAO_H25_BOUNDS, Bounds, humanoid_bounds

__all__ = ["ROBOTS", "Bounds", "RobotRanges", "find_robot", "is_spec", "robot_id"]

SPEC_SUFFIX = ".toml"


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


def is_spec(name: str) -> bool:
    """Return whether a robot is named by the file that describes it."""
    return name.endswith(SPEC_SUFFIX)


def robot_id(name: str) -> str:
    """Return what identifies a robot in settings and results: its name, or the full path of its file."""
    return str(Path(name).resolve()) if is_spec(name) else name


def find_robot(name: str) -> RobotRanges:
    """Return a robot and its ranges by the robot's name, or by the TOML file that describes it.

    Raises:
        UserError: with the nearest name and all known names, if the name is unknown, or if the file does not
            describe a robot.
    """
    if is_spec(name):
        path = robot_id(name)
        return _read_spec(path, _last_changes(path))
    if name.endswith((".xml", ".mjcf", ".urdf")):
        raise UserError(f"a robot must be described by a {SPEC_SUFFIX} file that names its model, got {name}")
    if name not in ROBOTS:
        raise UserError(f"unknown robot {name!r}{suggest(name, ROBOTS)}, or name a {SPEC_SUFFIX} file")
    return ROBOTS[name]


def _last_changes(path: str) -> tuple[int, ...]:
    """Return when a description and its model were written, ns; nothing if they cannot be found."""
    try:
        return tuple(file.stat().st_mtime_ns for file in (Path(path), model_file(Path(path))))
    except (OSError, ValueError):
        # The error is that of reading the robot.
        return ()


@functools.lru_cache(maxsize=16)
def _read_spec(path: str, _: tuple[int, ...]) -> RobotRanges:
    """Read a robot once in a process, unless its description or its model file was written again."""
    robot: Humanoid = humanoid_from_toml(path)
    if robot.name in ROBOTS:
        raise UserError(f"{path} must give its robot a name of its own, got {robot.name!r}")
    return RobotRanges(robot, *robot.speeds, humanoid_bounds(robot))
