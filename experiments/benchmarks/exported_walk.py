"""Compare an exported walk in C with the same walk in Python: set-points, speed, falls, and time of a step.

    python -m experiments.benchmarks.exported_walk [POLICY.npz] [--runs N] [--robot ROBOT]

A robot in plain MuJoCo walks in closed loop, without noise, by commands that change. Without a file the
policy is the shipped one that can be steered. Needs a C compiler, `cc`.
"""

import ctypes
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import mujoco
import numpy as np
import tyro

from creps_jax.errors import UserError
from creps_jax.policies.learned import Learned
from creps_jax.robots.robot import Robot
from creps_jax.simulation.models import load_model
from creps_jax.simulation.servos import read_servos
from creps_jax.tasks.closed_loop import CONTROL_PERIOD
from creps_jax.tools import tables
from creps_jax.tools.command_line import answer
from creps_jax.tools.drive import default_policy
from creps_jax.tools.export import walk_c
from creps_jax.tools.play import load_walking_policy, robot_of
from creps_jax.walking.gaits import learned_walker

COMPILER = shutil.which("cc")
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror")
SECONDS = 20.0
"""Length of a run, s."""
EQUAL = 1e-4
"""Difference up to which set-points count as equal, rad."""
_HOLD = 75
_TIMED = 2000
Controller = Callable[[np.ndarray, tuple[float, float, float]], np.ndarray]


class CompiledWalk:
    """The exported C code of a walk, compiled with all warnings as errors."""

    def __init__(self, folder: Path, policy: Learned, robot: Robot, period: float = CONTROL_PERIOD):
        if COMPILER is None:
            raise UserError("there is no C compiler, cc")
        self._robot = robot
        walk_c.save(folder / "walk.c", policy, robot=robot, period=period)
        library = folder / "walk.so"
        command = [COMPILER, *STRICT, "-O2", "-shared", "-fPIC", folder / "walk.c", "-o", library, "-lm"]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode != 0:
            raise UserError(f"{COMPILER} refuses the exported code: {done.stderr}")
        functions = ctypes.CDLL(str(library))
        prefix = walk_c.prefix_of(robot, "walk")
        self._step = getattr(functions, f"{prefix}_step")
        self._step.argtypes = [ctypes.c_void_p, ctypes.c_void_p, *[ctypes.c_float] * 3, ctypes.c_void_p]
        self._state = ctypes.create_string_buffer(8192)
        self._out = np.zeros(robot.num_joints, np.float32)
        start = getattr(functions, f"{prefix}_start")
        start(self._state, ctypes.c_void_p(self._out.ctypes.data))

    @property
    def set_point(self) -> np.ndarray:
        """Last set-points, with the signs of the simulation, rad."""
        return self._out * np.array(self._robot.own_signs, np.float32)

    def step(self, command: np.ndarray, rpy: tuple[float, float, float]) -> np.ndarray:
        """Walk on by one period; return the set-points, rad."""
        command = np.asarray(command, np.float32)
        self._step(self._state, command.ctypes.data, *map(float, rpy), self._out.ctypes.data)
        return self.set_point


class PythonWalk:
    """The same walk by the jitted `Walker.step`."""

    def __init__(self, policy: Learned, robot: Robot):
        walker = learned_walker(policy, robot=robot)
        self._step, self._state = jax.jit(walker.step), walker.start()

    @property
    def set_point(self) -> np.ndarray:
        """Last set-points, rad."""
        return np.asarray(self._state.set_point)

    def step(self, command: np.ndarray, rpy: tuple[float, float, float]) -> np.ndarray:
        """Walk on by one period; return the set-points, rad."""
        self._state, set_point = self._step(self._state, command, np.asarray(rpy, np.float32))
        return np.asarray(set_point)


class Simulation:
    """A robot in plain MuJoCo, with the servos of its model."""

    def __init__(self, robot: Robot, set_point: np.ndarray):
        self._model = load_model(robot)
        self._data = mujoco.MjData(self._model)
        self._data.qpos[2] = robot.torso_height
        self._data.qpos[read_servos(self._model).qpos_index] = set_point
        mujoco.mj_forward(self._model, self._data)
        # Down until the lowest point of the robot is on the floor.
        self._data.qpos[2] -= min(self._heights())
        self._last = set_point
        self._positions: list[np.ndarray] = []

    def walk(self, controller: Controller, commands: np.ndarray) -> np.ndarray:
        """Walk by a controller: (command, rpy) -> set-points. Return all set-points (n, nu), rad."""
        set_points = []
        for command in commands:
            set_points.append(controller(command, self._rpy()))
            self._step(set_points[-1])
        return np.array(set_points)

    def lowest(self) -> float:
        """Return the lowest height of the torso so far, m."""
        return float(np.min(np.array(self._positions)[:, 2]))

    def speeds(self) -> np.ndarray:
        """Return the distance that the torso moves in each two seconds over the time, m/s."""
        positions = np.array(self._positions)[:: round(2.0 / CONTROL_PERIOD), :2]
        return np.linalg.norm(np.diff(positions, axis=0), axis=1) / 2.0

    def _heights(self) -> list[float]:
        """Return the height of the lowest point of each solid geom, m."""
        model = self._model
        is_solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        is_floor = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        floor = int(np.flatnonzero(is_floor)[0])
        solids = np.flatnonzero(is_solid & ~is_floor)
        farthest = 10.0
        return [mujoco.mj_geomDistance(model, self._data, floor, int(i), farthest, None) for i in solids]

    def _rpy(self) -> tuple[float, float, float]:
        w, x, y, z = self._data.qpos[3:7]
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        return roll, pitch, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    def _step(self, set_point: np.ndarray) -> None:
        substeps = round(CONTROL_PERIOD / self._model.opt.timestep)
        for index in range(substeps):
            self._data.ctrl[:] = self._last + (index + 1) / substeps * (set_point - self._last)
            mujoco.mj_step(self._model, self._data)
        self._last = set_point
        self._positions.append(self._data.qpos[:3].copy())


def changing_commands(num: int, seed: int = 0) -> np.ndarray:
    """Return commands (num, 3), a new one every 75 control steps, with a stop in the middle."""
    rng = np.random.default_rng(seed)
    drawn = rng.uniform([-0.2, -0.1, -0.5], [0.4, 0.1, 0.5], (-(-num // _HOLD), 3))
    commands = np.repeat(drawn, _HOLD, axis=0)[:num]
    commands[num // 3 : num // 2] = 0.0
    return commands.astype(np.float32)


def main(policy: tyro.conf.Positional[Path | None] = None, runs: int = 5, robot: str | None = None) -> None:
    """Measure a policy and print its table.

    Args:
        policy: Policy file; the shipped one by default.
        runs: Number of runs of 20 s, each with other commands.
        robot: The robot of the policy, or the TOML file that describes it; by default the one it names.
    """
    learned = load_walking_policy(policy or default_policy(), robot, can_steer=True)
    who = robot_of(learned, robot)
    columns: dict[str, list[object]] = {name: [] for name in _COLUMNS}
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(runs):
            commands = changing_commands(round(SECONDS / CONTROL_PERIOD), seed)
            walks = CompiledWalk(Path(folder), learned, who), PythonWalk(learned, who)
            simulations = [Simulation(who, walks[1].set_point) for _ in walks]
            found = [each.walk(walk.step, commands) for each, walk in zip(simulations, walks, strict=True)]
            parts = np.abs(found[0] - found[1]).max(axis=1) > EQUAL
            row = [
                f"{parts.argmax() * CONTROL_PERIOD:.1f} s" if parts.any() else "20 s",
                *(f"{each.speeds().mean():.3f} m/s" for each in simulations),
                *(f"{each.lowest():.3f} m" for each in simulations),
            ]
            for name, value in zip(_COLUMNS, row, strict=True):
                columns[name].append(value)
        print(tables.to_markdown(columns))
        in_c = 1e6 * _time_of_step(CompiledWalk(Path(folder), learned, who).step)
        in_python = 1e6 * _time_of_step(PythonWalk(learned, who).step)
        print(
            f"one control step, with its call from Python: C {in_c:.0f} us, jitted Python {in_python:.0f} us"
        )


_COLUMNS = (
    "set-points equal to 1e-4 rad for",
    "speed, C",
    "speed, Python",
    "lowest torso, C",
    "lowest torso, Python",
)


def _time_of_step(step: Controller) -> float:
    """Return the mean time of a control step, with the call from Python, s."""
    command, rpy = np.array([0.3, 0.0, 0.2], np.float32), (0.0, 0.0, 0.0)
    step(command, rpy)
    begin = time.perf_counter()
    for _ in range(_TIMED):
        step(command, rpy)
    return (time.perf_counter() - begin) / _TIMED


if __name__ == "__main__":
    sys.exit(answer(lambda: tyro.cli(main)))
