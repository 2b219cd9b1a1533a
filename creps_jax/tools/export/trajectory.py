"""Write the joint set-points of a walk, for a robot that plays them."""

from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from creps_jax.errors import UserError
from creps_jax.files import save_arrays, save_text
from creps_jax.simulation import c
from creps_jax.tasks.closed_loop import CONTROL_PERIOD, WalkNoise, is_robot_fallen, make_setup, stand
from creps_jax.tools import tables
from creps_jax.tools.play import load_walking_policy, robot_of
from creps_jax.walking.controller import Walker
from creps_jax.walking.gaits import AHEAD, command_context, is_steered, learned_walker, straight_walker
from creps_jax.walking.open_loop import open_loop_walk

# A walk of this duration has 600,000 rows at the shortest period.
_LONGEST = 600.0
_TASKS = ("walk", "steered walk")


class Trajectory(NamedTuple):
    """The set-points of a walk from standstill, for each control step.

    Attributes:
        speed: asked speed, m/s.
        time: (n,) time, s.
        set_point: (n, nu) angles in the order of `robot.joint_names`, with its signs and zeros, rad.
        walker: the walker that planned it.
    """

    speed: float
    time: np.ndarray
    set_point: np.ndarray
    walker: Walker


def plan(
    path: Path, speed: float, duration: float, *, robot: str | None = None, period: float = CONTROL_PERIOD
) -> Trajectory:
    """Plan a walk at a speed, without simulation.

    The trunk has its intended lean at all times, without noise. There is no posture feedback, which needs the
    measured lean: a robot that plays this walk must keep its balance by other means, or walk where little
    disturbs it.

    Args:
        path: policy file; a steered walk walks straight ahead.
        speed: asked speed, m/s.
        duration: length of the walk, s.
        robot: name of the robot that the policy must have, or the file that describes it; None is the robot
            that the policy names.
        period: time between two set-points, s.

    Raises:
        UserError: if it is not a walking policy, or of another robot, or if speed or duration are out of
            range.
    """
    policy = load_walking_policy(path, robot, can_steer=True)
    if policy.task.get("name") not in _TASKS:
        raise UserError(f"{path} is no walking policy: its task is {policy.task.get('name')!r}")
    if not period <= duration <= _LONGEST:
        raise UserError(f"--duration must be {period} to {_LONGEST:g} s, got {duration}")
    asked = (speed, 0.0, 0.0) if is_steered(policy) else (speed,)
    conditions = command_context(policy, jnp.zeros(len(asked))).tolist()[len(asked) :]
    context = policy.contexts.checked((*asked, *conditions))
    settings = {"robot": robot_of(policy, robot), "period": period}
    if is_steered(policy):
        command, walker = asked, learned_walker(policy, **settings)
    else:
        command, com = AHEAD, policy.task.get("com", "one_step")
        walker = straight_walker(jnp.asarray(policy.theta(context)), com=com, **settings)
    commands = jnp.tile(jnp.asarray(command, jnp.float32), (round(duration / period), 1))
    walk = jax.jit(lambda commands: open_loop_walk(walker, commands).set_point)
    set_point = np.asarray(walk(commands))
    return Trajectory(speed, np.arange(len(set_point)) * period, set_point, walker)


def time_of_fall(path: Path, speed: float, duration: float, *, robot: str | None = None) -> float | None:
    """Play a walk on a simulated robot without noise and feedback; return when it falls, s, None if never.

    Args:
        path: policy file.
        speed: asked speed, m/s.
        duration: length of the walk, s.
        robot: name of the robot that the policy must have, or the file that describes it; None is the robot
            that the policy names.
    """
    walk = plan(path, speed, max(duration, 2 * CONTROL_PERIOD), robot=robot)
    setup = make_setup(walk.walker.robot, None, duration, WalkNoise(0.0, 0.0, 0.0), (), c.make_control_step)

    def step(carry, pair):
        state, has_fallen = carry
        before, after = pair
        state = setup.control_step(state, before, after, (after - before) / CONTROL_PERIOD)
        has_fallen = has_fallen | is_robot_fallen(setup, state)
        return (state, has_fallen), has_fallen

    def play(set_point):
        start = stand(setup, walk.walker, walk.walker.start())
        return lax.scan(step, (start, jnp.asarray(False)), (set_point[:-1], set_point[1:]))[1]

    has_fallen = np.asarray(jax.jit(play)(jnp.asarray(walk.set_point)))
    return float((1 + has_fallen.argmax()) * CONTROL_PERIOD) if has_fallen.any() else None


def save_csv(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as CSV: a header with units, then time and joints, a row for each control step.

    Names and signs of the joints are those of the robot's own software.
    """
    columns: dict[str, list[object]] = {"time (s)": [f"{time:.9g}" for time in trajectory.time]}
    robot = trajectory.walker.robot
    signs = np.asarray(robot.own_signs, np.float32)
    for name, angles in zip(robot.own_names, (trajectory.set_point * signs).T, strict=True):
        # The shortest decimals that read back as the same single-precision number.
        columns[f"{name} (rad)"] = [str(angle) for angle in angles]
    save_text(path, tables.to_csv(columns))


def save_npz(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory as .npz: speed (m/s), time (s), set_point (rad), joint_names of the simulation."""
    arrays = {name: values for name, values in trajectory._asdict().items() if name != "walker"}
    save_arrays(path, {**arrays, "joint_names": np.array(trajectory.walker.robot.joint_names)})
