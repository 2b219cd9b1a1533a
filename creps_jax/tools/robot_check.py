"""Check a robot before it learns: print what was read from its model, and try standard gaits."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax.robots.humanoid import Humanoid
from creps_jax.robots.robot import Robot
from creps_jax.simulation import c
from creps_jax.simulation.models import load_model
from creps_jax.tasks.walking import nao_walk
from creps_jax.tools.robots import RobotRanges, find_robot
from creps_jax.walking.params import PARAM_NAMES, scales
from creps_jax.walking.posture import Balance

# Step durations (s) and heights of the hip (m) of the standard gaits, for a robot of the NAO's size.
_DURATIONS, _HEIGHTS = (0.18, 0.23, 0.28), (0.17, 0.19)
# The other parameters, and how the gaits answer to the measured orientation.
_PARAMETERS = {
    "swing_height": 0.03,
    "tilt_gain": 0.8,
    "roll_gain": 0.5,
    "double_support": 0.02,
    "step_growth": 0.1,
}
_BALANCE = Balance(0.3, 0.6, 0.06, 0.25)
_SECONDS = 5.0
# Share of the gaits below which learning may fail.
_FEW = 1.0 / 3.0


class Trial(NamedTuple):
    """A standard gait and how it went.

    Attributes:
        step_duration: duration of a step, s.
        hip_height: height of the hip above the ankle, m.
        asked: asked speed, m/s.
        reached: reached forward speed, m/s.
        seconds: time until the fall, s; None without a fall.
    """

    step_duration: float
    hip_height: float
    asked: float
    reached: float
    seconds: float | None


def show(name: str, *, seed: int, say: Callable[[str], None]) -> None:
    """Print what was read from the model of a robot, and how the standard gaits go.

    Args:
        name: name of the robot, or the file that describes it.
        seed: seed of the noise.
        say: prints one line.

    Raises:
        UserError: if the robot is unknown, or its description is wrong.
    """
    ranges = find_robot(name)
    for line in described(ranges.robot):
        say(line)
    trials = try_standard_gaits(ranges, seed=seed)
    say("  step (s)  hip (m)  asked (m/s)  reached")
    for trial in trials:
        end = f"{trial.reached:7.2f}" if trial.seconds is None else f"fell after {trial.seconds:.1f} s"
        say(f"{trial.step_duration:10.2f} {trial.hip_height:8.3f} {trial.asked:12.2f}  {end}")
    say(summary(trials))


def described(robot: Robot) -> list[str]:
    """Return lines about a robot: its lengths, and for a humanoid what was read from its model."""
    model = load_model(robot)
    lines = [
        f"{robot.name}: {model.body_subtreemass[1]:.1f} kg, {robot.num_joints} joints, "
        f"legs of {robot.leg_length:.3f} m",
        f"  feet {robot.foot_spacing:.3f} m apart, ankles {robot.ankle_height:.3f} m above the soles",
        f"  centre of mass {robot.com_above_hip:.3f} m above and {robot.com_ahead_of_hip:.3f} m ahead of "
        "the hips",
        f"  servos {model.actuator_gainprm[0, 0]:.0f} N m/rad, {-model.actuator_biasprm[0, 2]:.2f} N m s/rad",
    ]
    if isinstance(robot, Humanoid):
        for side, joints in (("left", robot.left_leg), ("right", robot.right_leg)):
            angles = ", ".join(f"{robot.joint_names[i]} {robot.posture[i]:.2f}" for i in joints)
            lines.append(f"  {side} leg with its foot below the hip and its knee bent (rad): {angles}")
        torques = ", ".join(f"{robot.max_joint_torque[i]:g}" for i in robot.left_leg)
        lines.append(f"  torques of the leg (N m): {torques}")
    return lines


def try_standard_gaits(ranges: RobotRanges, *, seed: int = 0) -> list[Trial]:
    """Walk with a NAO's gaits, scaled: three step durations, two heights of the hip, three speeds."""
    robot, low, high = ranges.robot, ranges.low, ranges.high
    com = "continuous" if isinstance(robot, Humanoid) else "one_step"
    settings = {"balance": _BALANCE, "robot": robot, "physics": c.make_control_step, "com": com}
    task = nao_walk(low, high, duration=_SECONDS, **settings)
    factors = dict(zip(PARAM_NAMES, scales(robot), strict=True))
    contexts, thetas = [], []
    speeds = (low, 0.5 * (low + high), high)
    for step_duration, hip_height, speed in itertools.product(_DURATIONS, _HEIGHTS, speeds):
        values = _PARAMETERS | {"step_duration": step_duration, "hip_height": hip_height}
        theta = {name: factors[name] * values.get(name, 0.0) for name in PARAM_NAMES}
        theta["step_length"] = speed * theta["step_duration"]
        contexts.append([speed])
        thetas.append([theta[name] for name in PARAM_NAMES])
    keys = jax.random.split(jax.random.key(seed), len(thetas))
    walk = jax.jit(jax.vmap(task.rollout))
    outcome = jax.tree.map(np.asarray, walk(keys, jnp.asarray(contexts), jnp.asarray(thetas)))
    ways = zip(contexts, thetas, outcome.speed[:, 0], outcome.fell, outcome.seconds, strict=True)
    duration, height = (PARAM_NAMES.index(name) for name in ("step_duration", "hip_height"))
    return [
        Trial(theta[duration], theta[height], asked, float(reached), float(seconds) if fell else None)
        for (asked,), theta, reached, fell, seconds in ways
    ]


def summary(trials: list[Trial]) -> str:
    """Return how many gaits stay up, and what to do if few or none do."""
    up = sum(trial.seconds is None for trial in trials)
    text = f"{up} of {len(trials)} standard gaits stay up"
    if up >= _FEW * len(trials):
        return text
    if not up:
        text += f", the longest for {max(trial.seconds or 0.0 for trial in trials):.1f} s"
    return f"{text}: learning may fail; compare kp, kv and foot_spacing with other robots in models/humanoids"
