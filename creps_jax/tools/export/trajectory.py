"""Write the joint set-points of a walk, for a robot that plays them."""

from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax.errors import UserError
from creps_jax.files import save_arrays, save_text
from creps_jax.robots.nao_geometry import JOINT_NAMES
from creps_jax.tasks.walking import CONTROL_PERIOD
from creps_jax.tools import tables
from creps_jax.tools.play import load_walking_policy, robot_of
from creps_jax.walking.params import params_from_theta
from creps_jax.walking.set_points import open_loop_set_points

# Time and position grow during the walk, and lose digits in single precision.
_LONGEST = 600.0


class Trajectory(NamedTuple):
    """The set-points of a walk from standstill, for each control step.

    Attributes:
        speed: asked speed, m/s.
        time: (n,) time, s.
        set_point: (n, 22) angles in the order of `nao_geometry.JOINT_NAMES`, with its signs and zeros, rad.
    """

    speed: float
    time: np.ndarray
    set_point: np.ndarray


def plan(path: Path, speed: float, duration: float, *, robot: str | None = None) -> Trajectory:
    """Plan a walk at a speed, by the walking engine without simulation.

    The trunk has its intended lean at all times, without noise. There is no posture feedback, which needs the
    measured lean: a robot that plays this walk must keep its balance by other means, or walk where little
    disturbs it.

    Args:
        path: policy file.
        speed: asked speed, m/s.
        duration: length of the walk, s.
        robot: name of the robot that the policy must have; None accepts any.

    Raises:
        UserError: if it is not a walking policy, or of another robot, or if speed or duration are out of
            range.
    """
    policy = load_walking_policy(path, robot)
    if policy.task.get("name") != "walk":
        raise UserError(f"{path} is no walking policy: its task is {policy.task.get('name')!r}")
    if not CONTROL_PERIOD <= duration <= _LONGEST:
        raise UserError(f"--duration must be {CONTROL_PERIOD} to {_LONGEST:g} s, got {duration}")
    theta = policy.theta(speed)
    walk = partial(open_loop_set_points, duration=duration, period=CONTROL_PERIOD, robot=robot_of(policy))
    set_point = np.asarray(jax.jit(lambda theta: walk(params_from_theta(theta)))(jnp.asarray(theta)))
    return Trajectory(speed, np.arange(len(set_point)) * CONTROL_PERIOD, set_point)


def save_csv(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as CSV: a header with units, then time and joints, a row for each control step."""
    columns: dict[str, list[object]] = {"time (s)": [f"{time:.2f}" for time in trajectory.time]}
    for name, angles in zip(JOINT_NAMES, trajectory.set_point.T, strict=True):
        # The shortest decimals that read back as the same single-precision number.
        columns[f"{name} (rad)"] = [str(angle) for angle in angles]
    save_text(path, tables.to_csv(columns))


def save_npz(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as .npz: speed (m/s), time (s), set_point (rad) and joint_names."""
    save_arrays(path, {**trajectory._asdict(), "joint_names": np.array(JOINT_NAMES)})
