"""The walking task: a simulated robot walks straight ahead from standstill, at a commanded speed."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax

from creps_jax import checks
from creps_jax.contexts import gaussian_contexts
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
from creps_jax.typing import Array, Bool, Float, IntScalar, PRNGKey, Scalar
from creps_jax.walking.controller import Walker
from creps_jax.walking.engine import BodyPose
from creps_jax.walking.gaits import AHEAD, straight_walker
from creps_jax.walking.params import PARAM_NAMES, PARAM_UNITS
from creps_jax.walking.posture import Balance

__all__ = ["WalkOutcome", "WalkRecord", "WalkReward", "nao_walk", "record_walk"]


class WalkReward(NamedTuple):
    """Weights of the reward, `-speed (vx - s)^2 - drift vy^2 - fall [fell] (1 - upright t/T)`.

    With `upright` 0, the default, it is the paper's Eq. 18. Otherwise this share of the cost of a fall is
    given back in proportion to the time t before it, relative to the duration T of the episode, so that a
    search in which all samples fall has a direction.
    """

    speed: float = 10.0
    drift: float = 1.0
    fall: float = 100.0
    upright: float = 0.0


class WalkOutcome(NamedTuple):
    """The outcome of a walk.

    Attributes:
        reward: Eq. 18.
        violation: Empty; the wrappers fill it.
        fell: Whether the robot fell.
        speed: Forward and leftward speed over the measured time, m/s.
        seconds: Simulated time, s.
    """

    reward: Float[Array, ""]
    violation: Float[Array, " c"]
    fell: Bool[Array, ""]
    speed: Float[Array, "2"]
    seconds: Float[Array, ""]


class WalkRecord(NamedTuple):
    """The record of a walk at the end of each control step (leading axis n).

    Attributes:
        time: Time, s.
        qpos: Generalised positions of the robot, m and rad.
        set_point: Planned set-points of the servos, without the noise, rad.
        pose: Planned pose of hips and feet.
        has_fallen: Whether the robot has fallen so far.
    """

    time: Float[Array, " n"]
    qpos: Float[Array, "n nq"]
    set_point: Float[Array, "n nu"]
    pose: BodyPose
    has_fallen: Bool[Array, " n"]


class _Progress(NamedTuple):
    """What the loop over the control steps of an episode carries.

    Attributes:
        tick: Number of control steps done.
        state: State after them.
        measured_from: Horizontal position of the torso at the end of the start-up, or so far, m.
        has_fallen: Whether the robot has fallen.
    """

    tick: IntScalar
    state: WalkState
    measured_from: Float[Array, "2"]
    has_fallen: Bool[Array, ""]


@checks.arguments
def nao_walk(
    low: float = 0.1,
    high: float = 0.6,
    *,
    sample_context: Callable[[PRNGKey], Array] | None = None,
    duration: float = 8.0,
    start_up: float = 2.0,
    reward: WalkReward = WalkReward(),
    noise: WalkNoise = WalkNoise(),
    balance: Balance = Balance(),
    conditions: Sequence[Condition] = (),
    robot: Robot = NAO,
    model: mujoco.MjModel | None = None,
    physics: Physics = mjx.make_control_step,
    com: str = "one_step",
) -> Task:
    """Make the walking task: the context is the commanded speed in m/s, theta the ten walking parameters.

    Theta has the paper's order and units. The robot starts from standstill and walks straight ahead. Its
    speed is the displacement of the torso, in the frame of the start, divided by the time from the end of the
    start-up to the end of the episode. A fall ends the episode; the speed is then measured up to the fall.

    The robot may be any humanoid with the joints of the NAO whose legs `leg_ik` can solve. `NAO` and
    `NAO_H25` of `creps_jax.robots.robot` come with their models. For another robot, pass a `Robot` and a
    model that fits it.

    With further conditions, such as the slope of the floor, the context is the speed and the value of each.

    Args:
        low: Lowest commanded speed, m/s. The default range fits `NAO` and is the same for any robot. For
            another robot choose the range, about 0.05 to 0.3 for `NAO_H25`, and the bounds of theta,
            `creps_jax.walking.params.NAO_H25_BOUNDS` for `NAO_H25`.
        high: Highest commanded speed, m/s; see `low`.
        sample_context: (key) -> context (1 + k,); by default Gaussian about the middle, clipped to the range.
        duration: Length of the episode, s.
        start_up: Time at the start of the episode that is left out of the measurement of the speed, s.
        reward: Weights of the reward.
        noise: Sizes of the noise.
        balance: How steps answer to the measured orientation; by default not at all, as in the paper.
        conditions: The k conditions that the context holds besides the speed, see `tasks.conditions`.
        robot: The robot.
        model: Its model; by default `simulation.models.load_model(robot)`.
        physics: The simulator: `simulation.mjx.make_control_step`, which runs on any device, or
            `simulation.c.make_control_step`, C MuJoCo on the host.
        com: How the CoM is planned, see `Walker`: "one_step" as in the paper, or "continuous", with which a
            robot whose feet are narrow does not tip over in its first step.

    Returns:
        The task. Its rollout is for one robot; vmap it for a batch.

    Raises:
        ValueError: If the range or the times are not in order, two conditions have the same name, a condition
            begins after the end, or the model does not fit the robot: other joints, limits, torques or legs.

    Source: Abdolmaleki et al. 2016, Section 4.3.
    """
    checks.ends(low, high)
    check_numbers("reward", reward)
    check_start_up(start_up, duration)
    check_numbers("balance", balance)
    setup = make_setup(robot, model, duration, noise, conditions, physics)
    contexts = with_conditions(Space(("speed",), (low,), (high,), ("m/s",)), conditions)
    parameters = Space.unbounded(PARAM_NAMES, PARAM_UNITS)
    if sample_context is None:
        sample_context = gaussian_contexts(contexts.low, contexts.high, clip=True)
    start_up_ticks = round(start_up / CONTROL_PERIOD)

    @checks.arguments
    def rollout(key: PRNGKey, context: Array, theta: Float[Array, "10"]) -> WalkOutcome:
        context = checks.array("context", context, (contexts.size,))
        walker = straight_walker(theta, robot=robot, period=CONTROL_PERIOD, balance=balance, com=com)
        walk, start = begin(setup, walker, key, context[1:])
        end = _walk_to_end(setup, walker, walk, start, start_up_ticks)
        return _measure(end, start_up_ticks, setup.num_ticks, context[0], reward)

    # A fall at twice the highest speed in the wrong direction.
    worst = -(reward.fall + reward.speed * (3.0 * high) ** 2)
    return Task(sample_context, rollout, contexts.size, parameters.size, worst, contexts, parameters)


@checks.arguments
def record_walk(
    key: PRNGKey,
    theta: Float[Array, "10"],
    *,
    duration: float = 8.0,
    noise: WalkNoise = WalkNoise(),
    balance: Balance = Balance(),
    conditions: Sequence[Condition] = (),
    values: Float[Array, " k"] | Float[np.ndarray, " k"] | None = None,
    robot: Robot = NAO,
    model: mujoco.MjModel | None = None,
    physics: Physics = mjx.make_control_step,
    com: str = "one_step",
) -> WalkRecord:
    """Walk as in the task of `nao_walk`, and record every control step, also those after a fall.

    Args:
        key: Random key; the key of a rollout gives the same walk.
        theta: Walking parameters in the paper's order and units.
        duration: Length of the episode, s.
        noise: Sizes of the noise.
        balance: See `nao_walk`.
        conditions: See `nao_walk`.
        values: Value of each condition.
        robot: See `nao_walk`.
        model: See `nao_walk`.
        physics: See `nao_walk`.
        com: See `nao_walk`.

    Returns:
        The record of the walk.

    Raises:
        ValueError: If there is not one value for each condition.
    """
    check_numbers("balance", balance)
    setup = make_setup(robot, model, duration, noise, conditions, physics)
    values = jnp.zeros(0, theta.dtype) if values is None else values
    values = checks.array("values", values, (len(conditions),), note=", one for each of the conditions")
    walker = straight_walker(theta, robot=robot, period=CONTROL_PERIOD, balance=balance, com=com)
    walk, start = begin(setup, walker, key, values)

    def step(carry, tick):
        state, has_fallen = carry
        state = advance(setup, walker, walk, tick, state, jnp.asarray(AHEAD, theta.dtype))
        has_fallen = has_fallen | is_fallen(setup, walk, state)
        pose = walker.pose(state.walker, walk.slope)
        return (state, has_fallen), (state.robot.qpos, state.walker.set_point, pose, has_fallen)

    ticks = jnp.arange(setup.num_ticks, dtype=jnp.int32)
    _, (qpos, set_point, pose, has_fallen) = lax.scan(step, (start, jnp.asarray(False)), ticks)
    time = (ticks + 1).astype(theta.dtype) * CONTROL_PERIOD
    return WalkRecord(time, qpos, set_point, pose, has_fallen)


def _walk_to_end(
    setup: WalkSetup, walker: Walker, walk: Walk, start: WalkState, start_up_ticks: int
) -> _Progress:
    """Walk until the episode ends or the robot falls."""

    def is_walking(progress: _Progress) -> Array:
        return (progress.tick < setup.num_ticks) & ~progress.has_fallen

    def step(progress: _Progress) -> _Progress:
        state = without_fallen(progress.state, progress.has_fallen)
        state = advance(setup, walker, walk, progress.tick, state, jnp.asarray(AHEAD, start.robot.qpos.dtype))
        tick = progress.tick + 1
        is_start_up = tick <= start_up_ticks
        measured_from = lax.select(is_start_up, state.robot.qpos[:2], progress.measured_from)
        return _Progress(tick, state, measured_from, is_fallen(setup, walk, state))

    first = _Progress(jnp.int32(0), start, start.robot.qpos[:2], jnp.asarray(False))
    return lax.while_loop(is_walking, step, first)


def _measure(
    end: _Progress, start_up_ticks: int, num_ticks: int, commanded: Scalar, reward: WalkReward
) -> WalkOutcome:
    """Return the outcome of an episode from its end and the commanded speed."""
    dtype = end.measured_from.dtype
    measured = jnp.maximum(end.tick - start_up_ticks, 1).astype(dtype) * CONTROL_PERIOD
    speed = (end.state.robot.qpos[:2] - end.measured_from) / measured
    value = -reward.speed * (speed[0] - commanded) ** 2 - reward.drift * speed[1] ** 2
    given_back = reward.upright * end.tick.astype(dtype) / num_ticks
    value = value - reward.fall * (1.0 - given_back) * end.has_fallen.astype(dtype)  # Eq. 18
    seconds = end.tick.astype(dtype) * CONTROL_PERIOD
    return WalkOutcome(value, jnp.zeros(0, dtype), end.has_fallen, speed, seconds)
