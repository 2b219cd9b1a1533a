"""Drive a simulated robot by a file of commands, into a video."""

import csv
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.policies.learned import Learned
from creps_jax.robots.robot import NAO
from creps_jax.simulation import c
from creps_jax.tasks.closed_loop import CONTROL_PERIOD
from creps_jax.tasks.steering import Drive, record_drive
from creps_jax.tools import play
from creps_jax.tools.play import load_walking_policy, robot_of, save_film
from creps_jax.tools.robots import is_spec
from creps_jax.tools.video import Clip
from creps_jax.walking.controller import Walker
from creps_jax.walking.gaits import (
    COMMAND_NAMES,
    command_range,
    is_steered,
    learned_walker,
    limited_command,
)

COLUMNS = ("time", *COMMAND_NAMES)
_LONGEST = 600.0
AVERAGED = 1.0
"""Time over which speeds are averaged to be shown, s: some steps."""


def read_script(path: Path) -> np.ndarray:
    """Read commands from a CSV file with the columns time, vx, vy, turn (s, m/s, m/s, rad/s).

    A command holds from its time on; the last row is the end.

    Returns:
        The command of each control step (n, 3).

    Raises:
        UserError: if the file is missing or has other columns, numbers or times.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read the commands {path}: {error}") from error
    if not rows or tuple(cell.strip() for cell in rows[0]) != COLUMNS:
        found = ", ".join(rows[0]) if rows else "nothing"
        raise UserError(f"{path} must begin with the line {','.join(COLUMNS)}, got {found}")
    numbers = [_numbers(path, line, row) for line, row in enumerate(rows[1:], 2)]
    times = [row[0] for row in numbers]
    if len(numbers) < 2 or times[0] != 0.0 or any(b <= a for a, b in itertools.pairwise(times)):
        raise UserError(f"{path} must have two lines or more whose times rise from 0, got times {times}")
    if times[-1] > _LONGEST:
        raise UserError(f"{path} must end within {_LONGEST:g} s, got {times[-1]:g} s")
    table = np.array(numbers)
    ticks = np.arange(round(times[-1] / CONTROL_PERIOD)) * CONTROL_PERIOD
    return table[np.searchsorted(times, ticks + 1e-9, side="right") - 1, 1:].astype(np.float32)


def _numbers(path: Path, line: int, row: Sequence[str]) -> list[float]:
    try:
        numbers = [float(cell) for cell in row]
    except ValueError:
        numbers = []
    if len(numbers) != len(COLUMNS) or not np.isfinite(numbers).all():
        raise UserError(
            f"line {line} of {path} must be four numbers, {', '.join(COLUMNS)}, got {','.join(row)}"
        )
    return numbers


def default_policy(robot: str | None = None) -> Path:
    """Return the shipped policy of a robot that can be steered, or else the policy that `play` shows.

    Args:
        robot: name of the robot, or the file that describes it; None is the NAO.

    Raises:
        UserError: if there is neither, or the robot is unknown.
    """
    shipped = files.policies_folder(robot or NAO.name) / "steer.npz"
    is_shipped = not is_spec(robot or NAO.name) and shipped.exists()
    return shipped if is_shipped else play.default_policy(robot)


def drive_by_script(
    script: Path,
    policy: Path,
    out: Path,
    *,
    robot: str | None = None,
    seed: int,
    say: Callable[[str], None],
) -> None:
    """Drive a robot by the commands of a file, print what it did, and film it.

    Args:
        script: CSV file of commands, see `read_script`.
        policy: the policy file.
        out: the video, an .mp4 file.
        robot: name of the robot, or the file that describes it; None is the robot of the policy.
        seed: seed of the noise.
        say: prints one line.

    Raises:
        UserError: if a file cannot be read, the policy cannot be driven, or the video cannot be written.
    """
    if out.suffix != ".mp4" or out.is_dir():
        raise UserError(f"a video must be an .mp4 file, got {out}")
    files.check_writable(out.parent)
    commands = read_script(script)
    learned = load_walking_policy(policy, robot, can_steer=True)
    walker = learned_walker(learned, robot=robot_of(learned, robot))
    say(f"policy: {policy}")
    for line in beyond_range(learned, commands):
        say(line)
    drive = drive_by_commands(walker, commands, seed=seed)
    for line in report(commands, drive):
        say(line)
    save_film([Clip(captions(drive), np.asarray(drive.qpos), CONTROL_PERIOD)], out, say, robot=walker.robot)


def beyond_range(learned: Learned, commands: np.ndarray) -> list[str]:
    """Return a note if commands (n, 3) are beyond what a policy has learned, with the farthest of them."""
    low, high = command_range(learned)
    if is_steered(learned):
        limits = (jnp.asarray(low), jnp.asarray(high))
        followed = np.asarray(jax.vmap(limited_command, (0, None, None))(jnp.asarray(commands), *limits))
    else:
        followed = np.clip(commands, low, high)
    apart = np.abs(commands - followed).max(axis=1)
    farthest = int(np.argmax(apart))
    if apart[farthest] < 1e-3:
        return []
    return [
        "note: commands beyond what was learned are reduced, such as "
        f"{in_words(commands[farthest])} to {in_words(followed[farthest])}"
    ]


def captions(drive: Drive) -> list[str]:
    """Return a line for each control step: the command and the measured speed, averaged over some steps."""
    window = np.ones(round(AVERAGED / CONTROL_PERIOD))
    weights = np.convolve(np.ones(len(drive.speed)), window)[: len(drive.speed)]
    speed = np.stack(
        [np.convolve(axis, window)[: len(axis)] / weights for axis in np.asarray(drive.speed).T], 1
    )
    return [
        f"asked {in_words(command)}, reached {in_words(reached)}{' (fell)' if fell else ''}"
        for command, reached, fell in zip(np.asarray(drive.command), speed, drive.has_fallen, strict=True)
    ]


def in_words(speed: Sequence[float] | np.ndarray) -> str:
    """Write a command or speed (vx, vy, turn rate), m/s and rad/s; zero has no sign."""
    return " ".join(f"{value + 0.0:.2f}" for value in np.round(np.asarray(speed, float), 2))


def drive_by_commands(walker: Walker, commands: np.ndarray, *, seed: int) -> Drive:
    """Drive a simulated robot by the command of each control step (n, 3); arrays of NumPy."""
    run = jax.jit(lambda key, commands: record_drive(key, walker, commands, physics=c.make_control_step))
    return jax.tree.map(np.asarray, run(jax.random.key(seed), jnp.asarray(commands)))


def report(commands: np.ndarray, drive: Drive) -> list[str]:
    """Return a line for each part with one command: asked and reached speeds, and whether the robot fell."""
    begins = np.flatnonzero(np.r_[True, np.any(np.diff(commands, axis=0) != 0, axis=1)])
    ends = np.r_[begins[1:], len(commands)]
    lines = ["  from     to   asked vx, vy, turn    reached in the second half"]
    for first, end in zip(begins, ends, strict=True):
        reached = np.asarray(drive.speed[(first + end) // 2 : end]).mean(axis=0)
        asked = in_words(commands[first])
        lines.append(
            f"{first * CONTROL_PERIOD:6.1f} {end * CONTROL_PERIOD:6.1f}   {asked:21} {in_words(reached)}"
        )
        if drive.has_fallen[end - 1]:
            seconds = (1 + int(np.argmax(drive.has_fallen))) * CONTROL_PERIOD
            return [*lines, f"the robot fell after {seconds:.1f} s"]
    return [*lines, "the robot did not fall"]
