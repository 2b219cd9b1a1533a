"""The steered walk: a simulated robot walks at a commanded (vx, vy, turn rate)."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax

from creps_jax import checks
from creps_jax.contexts import ellipsoid_contexts
from creps_jax.numerics.rotations import quat_to_rpy, wrapped
from creps_jax.policies.space import Space
from creps_jax.robots.robot import NAO, Robot
from creps_jax.simulation import mjx
from creps_jax.simulation.state import Physics
from creps_jax.tasks.base import Task
from creps_jax.tasks.closed_loop import (
    CONTROL_PERIOD,
    Walk,
    WalkNoise,
    WalkSetup,
    WalkState,
    advance,
    begin,
    check_numbers,
    check_start_up,
    is_fallen,
    make_setup,
    without_fallen,
)
from creps_jax.tasks.conditions import Condition, with_conditions
from creps_jax.typing import Array, Bool, Float, Int, IntScalar, PRNGKey, Scalar, VectorLike
from creps_jax.walking.controller import COM_METHODS, Gait, Walker
from creps_jax.walking.gaits import COMMAND_NAMES, COMMAND_UNITS, steered_gait
from creps_jax.walking.params import STEERED_PARAM_NAMES, STEERED_PARAM_UNITS
from creps_jax.walking.posture import Balance

__all__ = ["Drive", "SteeringOutcome", "SteeringReward", "nao_steered_walk", "record_drive"]


# Speed (m/s, rad/s) below which a command does not say what part of it is commanded.
_SLOW = 0.02


class SteeringReward(NamedTuple):
    """Weights of the reward `-speed |v - v*|^2 - turn (w - w*)^2 - fall [fell] (1 - upright t/T)`.

    v is the mean speed and w the mean turn rate in the frame of the body, v* and w* the mean command. The
    share `upright` of the cost of a fall is given back in proportion to the time t before it, so that a
    search in which all samples fall has a direction.
    """

    speed: float = 30.0
    turn: float = 6.0
    fall: float = 30.0
    upright: float = 0.5


class SteeringOutcome(NamedTuple):
    """The outcome of a steered walk.

    Attributes:
        reward: See `SteeringReward`.
        violation: Empty; the wrappers fill it.
        fell: Whether the robot fell.
        speed: Mean speed forward and to the left (m/s), and turn rate (rad/s), in the frame of the body.
        error: Mean command less the mean speed.
        seconds: Simulated time, s.
    """

    reward: Float[Array, ""]
    violation: Float[Array, " c"]
    fell: Bool[Array, ""]
    speed: Float[Array, "3"]
    error: Float[Array, "3"]
    seconds: Float[Array, ""]


class _Progress(NamedTuple):
    """What the loop over the control steps carries: displacements are sums over the measured time."""

    tick: IntScalar
    state: WalkState
    travelled: Float[Array, "p 3"]
    commanded: Float[Array, "p 3"]
    has_fallen: Bool[Array, ""]


@checks.arguments
def nao_steered_walk(
    low: VectorLike = (-0.2, -0.15, -0.8),
    high: VectorLike = (0.6, 0.15, 0.8),
    *,
    sample_context: Callable[[PRNGKey], Array] | None = None,
    profile: Sequence[tuple[float, float, float]] = ((0.0, 1.0, 1.0),),
    duration: float = 5.0,
    start_up: float = 2.0,
    reward: SteeringReward = SteeringReward(),
    noise: WalkNoise = WalkNoise(),
    balance: Balance = Balance(0.0, 0.6, 0.06),
    conditions: Sequence[Condition] = (),
    robot: Robot = NAO,
    model: mujoco.MjModel | None = None,
    physics: Physics = mjx.make_control_step,
    acceleration: tuple[float, float, float] = (0.4, 0.4, 2.0),
    com: str = "continuous",
) -> Task:
    """Make the task of walking at a command (vx, vy, turn rate), the context, with twelve parameters theta.

    Theta holds the ten walking parameters, whose step length is the forward part of a step, and the parts of
    a step to the left (m) and in turn (rad). The command may change within the episode: it is the context
    times the factors of `profile`, limited by `acceleration`, and steps change with it. Speeds are measured
    in the frame of the body.

    Args:
        low: Lowest command (vx, vy, turn rate), m/s and rad/s.
        high: Highest command. By default contexts are drawn evenly from the ellipsoid between `low` and
            `high`: its corners, such as fast forward and fast sideways at once, are out of reach.
        sample_context: (key) -> context (3 + k,).
        profile: Parts (time in s, factor of the forward speed, factor of the other two), the first at time 0.
            Each part is measured by itself. A factor of -1 of the other two is the mirror image of the walk.
        duration: Length of the episode, s.
        start_up: Time at the start that is left out of the measurement, s.
        reward: Weights of the reward.
        noise: Sizes of the noise.
        balance: How steps answer to the measured orientation.
        conditions: The k conditions that the context holds besides the command, see `tasks.conditions`.
        robot: The robot.
        model: Its model; by default `simulation.models.load_model(robot)`.
        physics: The simulator, see `nao_walk`.
        acceleration: See `Walker`.
        com: See `Walker`.

    Returns:
        The task. Its rollout is for one robot; vmap it for a batch.

    Raises:
        ValueError: If the ranges, the times or the profile are not in order, or the settings do not fit the
            robot, as in `nao_walk`.
    """
    if com not in COM_METHODS:
        raise ValueError(f"com must be one of {', '.join(COM_METHODS)}, got {com!r}")
    lows, highs = checks.ends(low, high)
    if lows.size != len(COMMAND_NAMES):
        raise ValueError(f"low must have three entries, {', '.join(COMMAND_NAMES)}, got {checks.shown(low)}")
    check_numbers("reward", reward, least=0.0)
    check_start_up(start_up, duration)
    parts = _checked_profile(profile, start_up, duration)
    check_numbers("balance", balance)
    setup = make_setup(robot, model, duration, noise, conditions, physics)
    commands = Space(COMMAND_NAMES, tuple(lows.tolist()), tuple(highs.tolist()), COMMAND_UNITS)
    contexts = with_conditions(commands, conditions)
    parameters = Space.unbounded(STEERED_PARAM_NAMES, STEERED_PARAM_UNITS)
    if sample_context is None:
        sample_context = ellipsoid_contexts(contexts.low, contexts.high)

    @checks.arguments
    def rollout(key: PRNGKey, context: Array, theta: Float[Array, "12"]) -> SteeringOutcome:
        context = checks.array("context", context, (contexts.size,))
        gait = _gait_up_to(context[:3], steered_gait(theta, robot=robot))
        walker = Walker(gait, robot, CONTROL_PERIOD, balance, acceleration, com)
        walk, start = begin(setup, walker, key, context[3:])
        end = _walk_to_end(setup, walker, walk, start, context[:3], parts)
        return _measure(setup, end, parts, reward)

    # A fall at twice the highest speed in the wrong direction.
    fastest = 3.0 * np.max(np.abs([lows, highs]), axis=0)
    worst = -(reward.fall + float(np.dot((reward.speed, reward.speed, reward.turn), fastest**2)))
    return Task(sample_context, rollout, contexts.size, parameters.size, worst, contexts, parameters)


def _gait_up_to(command: Float[Array, "3"], gait: Gait) -> Callable[[Array], Gait]:
    """Return the gait of a command, with steps in proportion to the part of it that is commanded."""

    def part(present: Array, whole: Array) -> Scalar:
        square = jnp.sum(whole**2)
        share = jnp.clip(jnp.sum(present * whole) / jnp.where(square > 0, square, 1.0), -1.0, 1.0)
        return jnp.where(square > _SLOW**2, share, 1.0)

    def gait_at(present: Float[Array, "3"]) -> Gait:
        forward, side = part(present[:1], command[:1]), part(present[1:], command[1:])
        return gait._replace(step=gait.step * jnp.stack([forward, side, side]))

    return gait_at


class _Parts(NamedTuple):
    """The parts of an episode: control steps at which they begin and are measured from, and factors."""

    begins: np.ndarray
    measured_from: np.ndarray
    factors: np.ndarray


def _checked_profile(
    profile: Sequence[tuple[float, float, float]], start_up: float, duration: float
) -> _Parts:
    """Return the parts of a profile, after checking that the times are in order.

    Raises:
        ValueError: If they are not, or an entry is not three numbers.
    """
    try:
        rows = np.asarray(profile, float)
    except (TypeError, ValueError):  # ragged, or no numbers
        rows = np.zeros((0, 3))
    is_table = rows.ndim == 2 and rows.shape[1:] == (3,) and len(rows) > 0 and np.isfinite(rows).all()
    times = rows[:, 0] if is_table else np.zeros(0)
    if not is_table or times[0] != 0.0 or not np.all(np.diff(times) > 0) or times[-1] >= duration:
        raise ValueError(
            f"profile must be parts (time, factor, factor), times rising from 0 to below {duration} s, "
            f"got {checks.shown(profile)}"
        )
    if len(rows) > 1 and times[1] <= start_up:
        raise ValueError(f"profile must not change before start_up, {start_up} s, got {profile}")
    begins, measured_from = (
        np.round(ticks / CONTROL_PERIOD).astype(int) for ticks in (times, np.maximum(times, start_up))
    )
    return _Parts(begins, measured_from, rows[:, [1, 2, 2]])


def _walk_to_end(
    setup: WalkSetup,
    walker: Walker,
    walk: Walk,
    start: WalkState,
    highest: Float[Array, "3"],
    parts: _Parts,
) -> _Progress:
    """Walk until the episode ends or the robot falls; `highest` is the command times one."""
    begins, measured_from = jnp.asarray(parts.begins), jnp.asarray(parts.measured_from)
    factors = jnp.asarray(parts.factors, highest.dtype)

    def is_walking(progress: _Progress) -> Array:
        return (progress.tick < setup.num_ticks) & ~progress.has_fallen

    def step(progress: _Progress) -> _Progress:
        part = jnp.sum(progress.tick >= begins) - 1
        before = without_fallen(progress.state, progress.has_fallen)
        state = advance(setup, walker, walk, progress.tick, before, highest * factors[part])
        has_fallen = is_fallen(setup, walk, state)
        is_measured = (progress.tick >= measured_from[part]) & ~has_fallen
        changes = moved(before.robot.qpos, state.robot.qpos), CONTROL_PERIOD * state.walker.command
        travelled, commanded = (
            total.at[part].add(jnp.where(is_measured, change, 0.0))
            for total, change in zip((progress.travelled, progress.commanded), changes, strict=True)
        )
        return _Progress(progress.tick + 1, state, travelled, commanded, has_fallen)

    zero = jnp.zeros((len(parts.begins), 3), highest.dtype)
    return lax.while_loop(is_walking, step, _Progress(jnp.int32(0), start, zero, zero, jnp.asarray(False)))


def moved(before: Float[Array, " nq"], after: Float[Array, " nq"]) -> Float[Array, "3"]:
    """Return how far a trunk has moved in the frame of its heading (m), and turned (rad)."""
    yaw, yaw_after = quat_to_rpy(before[3:7])[2], quat_to_rpy(after[3:7])[2]
    x, y = after[:2] - before[:2]
    cos, sin = jnp.cos(yaw), jnp.sin(yaw)
    return jnp.stack([cos * x + sin * y, cos * y - sin * x, wrapped(yaw_after - yaw)])


def _measure(setup: WalkSetup, end: _Progress, parts: _Parts, reward: SteeringReward) -> SteeringOutcome:
    """Return the outcome of an episode from its end."""
    dtype = end.travelled.dtype
    ends = jnp.asarray(np.append(parts.begins[1:], setup.num_ticks))
    ticks = jnp.clip(jnp.minimum(ends, end.tick) - jnp.asarray(parts.measured_from), 0)
    seconds = jnp.maximum(ticks, 1).astype(dtype)[:, None] * CONTROL_PERIOD
    share = ticks.astype(dtype) / jnp.maximum(jnp.sum(ticks), 1).astype(dtype)
    errors = (end.commanded - end.travelled) / seconds
    weights = jnp.asarray([reward.speed, reward.speed, reward.turn], dtype)
    time = end.tick.astype(dtype) * CONTROL_PERIOD
    fallen = end.has_fallen.astype(dtype) * (1.0 - reward.upright * time / setup.duration)
    return SteeringOutcome(
        reward=-jnp.sum(share[:, None] * weights[None, :] * errors**2) - reward.fall * fallen,
        violation=jnp.zeros(0, dtype),
        fell=end.has_fallen,
        speed=jnp.sum(share[:, None] * end.travelled / seconds, axis=0),
        error=jnp.sum(share[:, None] * errors, axis=0),
        seconds=time,
    )


class Drive(NamedTuple):
    """The record of a walk that was driven by commands, at the end of each control step (leading axis n).

    Attributes:
        time: Time, s.
        qpos: Generalised positions of the robot, m and rad.
        set_point: Planned set-points of the servos, without the noise, rad.
        command: Command, limited by the acceleration, m/s and rad/s.
        speed: Speed of the trunk in the frame of its heading (vx, vy, turn rate) over the control step, m/s
            and rad/s. It sways with each step: average it over some steps.
        stage: What the walker does, see `Stage`.
        has_fallen: Whether the robot has fallen so far.
    """

    time: Float[Array, " n"]
    qpos: Float[Array, "n nq"]
    set_point: Float[Array, "n nu"]
    command: Float[Array, "n 3"]
    speed: Float[Array, "n 3"]
    stage: Int[Array, " n"]
    has_fallen: Bool[Array, " n"]


@checks.arguments
def record_drive(
    key: PRNGKey,
    walker: Walker,
    commands: Float[Array, "n 3"],
    *,
    noise: WalkNoise = WalkNoise(),
    conditions: Sequence[Condition] = (),
    values: Float[Array, " k"] | None = None,
    model: mujoco.MjModel | None = None,
    physics: Physics = mjx.make_control_step,
) -> Drive:
    """Drive a simulated robot by commands, and record every control step, also those after a fall.

    Args:
        key: Random key.
        walker: What controls the robot, with a period of 0.02 s.
        commands: Commanded (vx forward, vy left, turn rate) of each control step, m/s and rad/s.
        noise: Sizes of the noise.
        conditions: See `nao_steered_walk`.
        values: Value of each condition.
        model: The model of the walker's robot; by default `simulation.models.load_model(robot)`.
        physics: The simulator, see `nao_walk`.

    Raises:
        ValueError: If the walker has another period, or there is not one value for each condition.
    """
    if walker.period != CONTROL_PERIOD:
        raise ValueError(f"walker must have a period of {CONTROL_PERIOD} s, got {walker.period}")
    setup = make_setup(walker.robot, model, len(commands) * CONTROL_PERIOD, noise, conditions, physics)
    values = jnp.zeros(0, commands.dtype) if values is None else values
    values = checks.array("values", values, (len(conditions),), note=", one for each of the conditions")
    walk, start = begin(setup, walker, key, values)

    def step(carry, now):
        state, has_fallen = carry
        tick, command = now
        after = advance(setup, walker, walk, tick, state, command)
        has_fallen = has_fallen | is_fallen(setup, walk, after)
        speed = moved(state.robot.qpos, after.robot.qpos) / CONTROL_PERIOD
        walking = after.walker
        seen = (after.robot.qpos, walking.set_point, walking.command, speed, walking.stage, has_fallen)
        return (after, has_fallen), seen

    ticks = jnp.arange(len(commands), dtype=jnp.int32)
    _, seen = lax.scan(step, (start, jnp.asarray(False)), (ticks, commands))
    return Drive((ticks + 1).astype(commands.dtype) * CONTROL_PERIOD, *seen)
