"""The walking task: a simulated robot walks straight ahead, from standstill, at the speed it is asked for."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax

from creps_jax import checks
from creps_jax.contexts import gaussian_contexts
from creps_jax.numerics.rotations import quat_to_matrix, quat_to_rpy, rotation_y, rpy_to_quat
from creps_jax.policies.space import Space
from creps_jax.robots.nao_geometry import NUM_JOINTS, NaoGeometry
from creps_jax.robots.robot import NAO, Robot
from creps_jax.simulation import mjx
from creps_jax.simulation.models import check_model, load_nao
from creps_jax.simulation.state import ControlStep, RobotState, initial_state
from creps_jax.simulation.world import world_of
from creps_jax.tasks.base import Task
from creps_jax.tasks.conditions import (
    Circumstances,
    Condition,
    check_conditions,
    circumstances_of,
    slope_angle,
    upward,
)
from creps_jax.typing import Array, Bool, Float, PRNGKey, Scalar
from creps_jax.walking.engine import BodyPose, plan_walk, pose_at, pose_joints, stand_upright
from creps_jax.walking.params import PARAM_NAMES, PARAM_UNITS, WalkParams, count_steps, params_from_theta
from creps_jax.walking.posture import Balance
from creps_jax.walking.set_points import next_set_point

__all__ = [
    "WalkNoise",
    "WalkOutcome",
    "WalkRecord",
    "WalkReward",
    "nao_walk",
    "record_walk",
]

CONTROL_PERIOD = 0.02
# Share of the torso's height with straight legs; with the knees bent most it still has 0.8 of it. Upright
# means within 50 degrees.
_FALLEN_SHARE = 0.2 / 0.385
_FALLEN_COSINE = 0.64
# All control steps are planned before the first: a longer episode would fill the memory.
_LONGEST = 3600.0


Physics = Callable[[mujoco.MjModel, int], ControlStep]
"""(model, physics steps in a control step) -> the control step, for one robot."""


class WalkReward(NamedTuple):
    """Weights of the reward, `-speed (vx - s)^2 - drift vy^2 - fall [fell]` (the paper's Eq. 18)."""

    speed: float = 10.0
    drift: float = 1.0
    fall: float = 100.0


class WalkNoise(NamedTuple):
    """Standard deviations of the noise on measured angles, set-points and joints at the start, rad.

    Noise is white: new in every control step.
    """

    lean: float = 0.01
    set_point: float = 0.01
    start: float = 0.01

    def times(self, factor: float) -> "WalkNoise":
        """Return this noise times a factor."""
        return WalkNoise(*(factor * size for size in self))


class WalkOutcome(NamedTuple):
    """What a walk brings.

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
    """A walk, control step by control step (leading axis n).

    Attributes:
        time: Time, s.
        qpos: Generalised positions of the robot, m and rad.
        set_point: Planned set-points of the servos, without the noise, rad.
        pose: Planned pose of hips and feet.
        has_fallen: Whether the robot has fallen by then.
    """

    time: Float[Array, " n"]
    qpos: Float[Array, "n nq"]
    set_point: Float[Array, "n nu"]
    pose: BodyPose
    has_fallen: Bool[Array, " n"]


class _Walk(NamedTuple):
    """A walk before its first control step: state, and all that the controller will need."""

    robot: RobotState
    set_point: Array
    params: WalkParams
    poses: BodyPose
    lean_noise: Array
    set_point_noise: Array
    circumstances: Circumstances | None


class _Progress(NamedTuple):
    """What goes round the loop."""

    tick: Array
    robot: RobotState
    set_point: Array
    measured_from: Array
    has_fallen: Array


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
) -> Task:
    """Make the walking task: the context is the asked speed in m/s, theta the ten walking parameters.

    Theta has the paper's order and units. The robot starts from standstill and walks straight ahead. Its
    speed is the displacement of the torso, in the frame of the start, over the time from the end of the
    start-up to the end of the episode. A fall ends the episode, and the speed up to it counts.

    The robot may be any humanoid whose legs `leg_ik` can drive, with the joints of the NAO. Those of
    `creps_jax.robots.robot`, `NAO` and `NAO_H25`, come with their models, another one is a `Robot` of its
    own and a model that fits it.

    With further conditions, such as the slope of the floor, the context is the speed and the value of each.

    Args:
        low: Lowest speed that is asked for, m/s. The default range is that of `NAO`, for any robot; that of
            another one is the caller's to choose, for `NAO_H25` about 0.05 to 0.3, as is the box of theta,
            for `NAO_H25` `creps_jax.walking.params.NAO_H25_BOUNDS`.
        high: Highest speed that is asked for, m/s; see `low`.
        sample_context: (key) -> context (1 + k,); by default Gaussian about the middle, clipped to the range.
        duration: Length of the episode, s.
        start_up: Length of the time at its start over which the speed does not count, s.
        reward: Weights of the reward.
        noise: Sizes of the noise.
        balance: How steps answer to the measured orientation; by default not at all, as in the paper.
        conditions: The k conditions that the context tells besides the speed, see `tasks.conditions`.
        robot: Who walks.
        model: Its model; by default `load_nao(robot)`.
        physics: What steps the robot: `physics.mjx.make_control_step`, which any device runs, or
            `physics.c.make_control_step`, the host's C MuJoCo.

    Returns:
        The task. Its rollout is for one robot; vmap it for a batch.

    Raises:
        ValueError: If the range or the times are not in order, there are two conditions of one name or one
            that begins after the end, or the model is not that of the robot: driven by other joints, in other
            limits or with other torques, or with other legs.

    Source: Abdolmaleki et al. 2016, Section 4.3.
    """
    checks.ends(low, high)
    _check_numbers("reward", reward)
    if not 0 <= start_up < duration:
        raise ValueError(
            f"start_up must lie in [0, duration), got start_up {start_up} and duration {duration}"
        )
    begin, advance = _make_walker(robot, model, duration, noise, balance, physics, conditions)
    if sample_context is None:
        lows, highs = [low, *(c.low for c in conditions)], [high, *(c.high for c in conditions)]
        sample_context = gaussian_contexts(lows, highs, clip=True)
    num_ticks = round(duration / CONTROL_PERIOD)
    start_up_ticks = round(start_up / CONTROL_PERIOD)

    @checks.arguments
    def rollout(key: PRNGKey, context: Float[Array, " s"], theta: Float[Array, "10"]) -> WalkOutcome:
        context = checks.array("context", context, (1 + len(conditions),))
        walk = begin(key, theta, context[1:])
        start = _Progress(jnp.int32(0), walk.robot, walk.set_point, walk.robot.qpos[:2], jnp.asarray(False))

        def is_walking(progress):
            return (progress.tick < num_ticks) & ~progress.has_fallen

        def step(progress):
            # A batch goes on until its last robot has fallen; a state of NaN spares C MuJoCo the others.
            state = jax.tree.map(lambda x: jnp.where(progress.has_fallen, jnp.nan, x), progress.robot)
            state, set_point = advance(walk, progress.tick, state, progress.set_point)
            tick = progress.tick + 1
            is_start_up = tick <= start_up_ticks
            measured_from = lax.select(is_start_up, state.qpos[:2], progress.measured_from)
            has_fallen = _has_fallen(robot, state.qpos, walk.circumstances)
            return _Progress(tick, state, set_point, measured_from, has_fallen)

        end = lax.while_loop(is_walking, step, start)
        measured = jnp.maximum(end.tick - start_up_ticks, 1).astype(theta.dtype) * CONTROL_PERIOD
        speed = (end.robot.qpos[:2] - end.measured_from) / measured
        value = -reward.speed * (speed[0] - context[0]) ** 2 - reward.drift * speed[1] ** 2
        value = value - reward.fall * end.has_fallen.astype(theta.dtype)  # Eq. 18
        seconds = end.tick.astype(theta.dtype) * CONTROL_PERIOD
        return WalkOutcome(value, jnp.zeros(0, theta.dtype), end.has_fallen, speed, seconds)

    # A fall at twice the highest speed in the wrong direction.
    worst = -(reward.fall + reward.speed * (3.0 * high) ** 2)
    contexts = Space(
        ("speed", *(c.name for c in conditions)),
        (low, *(c.low for c in conditions)),
        (high, *(c.high for c in conditions)),
        ("m/s", *(c.unit for c in conditions)),
    )
    free = (math.inf,) * len(PARAM_NAMES)
    parameters = Space(PARAM_NAMES, tuple(-end for end in free), free, PARAM_UNITS)
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
) -> WalkRecord:
    """Walk as `nao_walk` does and keep every control step, beyond a fall too.

    Args:
        key: Random key; with the key of a rollout it is the same walk.
        theta: Walking parameters in the paper's order and units.
        duration: Length of the episode, s.
        noise: Sizes of the noise.
        balance: See `nao_walk`.
        conditions: See `nao_walk`.
        values: Value of each condition.
        robot: See `nao_walk`.
        model: See `nao_walk`.
        physics: See `nao_walk`.

    Returns:
        The walk.

    Raises:
        ValueError: If there is not one value for each condition.
    """
    begin, advance = _make_walker(robot, model, duration, noise, balance, physics, conditions)
    walk = begin(key, theta, values)

    def step(carry, tick):
        state, set_point, has_fallen = carry
        state, set_point = advance(walk, tick, state, set_point)
        has_fallen = has_fallen | _has_fallen(robot, state.qpos, walk.circumstances)
        return (state, set_point, has_fallen), (state.qpos, set_point, has_fallen)

    ticks = jnp.arange(round(duration / CONTROL_PERIOD), dtype=jnp.int32)
    _, (qpos, set_point, has_fallen) = lax.scan(step, (walk.robot, walk.set_point, jnp.asarray(False)), ticks)
    return WalkRecord(
        (ticks + 1).astype(theta.dtype) * CONTROL_PERIOD, qpos, set_point, walk.poses, has_fallen
    )


def _make_walker(robot, model, duration, noise, balance, physics, conditions=()):
    """Check settings; return `begin(key, theta, values)` and `advance(walk, tick, state, set_point)`."""
    if not CONTROL_PERIOD <= duration <= _LONGEST:
        raise ValueError(f"duration must be {CONTROL_PERIOD} to {_LONGEST:g} s, got {duration}")
    _check_numbers("noise", noise, least=0.0)
    _check_numbers("balance", balance)
    check_conditions(conditions, duration)
    checks.function("physics", physics, "(model, number of steps) -> control step")
    model = load_nao(robot) if model is None else model
    _check_model(model, robot)
    control_step = physics(model, round(CONTROL_PERIOD / model.opt.timestep))
    num_ticks = round(duration / CONTROL_PERIOD)

    def begin(key: PRNGKey, theta: Array, values: Array | np.ndarray | None = None) -> _Walk:
        start_key, lean_key, set_point_key = jax.random.split(key, 3)
        values = jnp.zeros(0, theta.dtype) if values is None else checks.array("values", values)
        circumstances = circumstances_of(conditions, values, world_of(model))
        params = params_from_theta(theta)
        plans = plan_walk(params, count_steps(duration), robot=robot)

        def planned(time):
            pose = pose_at(params, plans, time, robot=robot)
            return pose if circumstances is None else stand_upright(pose, slope_angle(circumstances.world))

        if circumstances is not None:
            # Plan and measurement are in the frame of the floor: the robot finds the vertical and is told the
            # slope. A lean counts from the vertical, which itself leans forward from a floor that rises.
            params = params._replace(lean=params.lean + slope_angle(circumstances.world))
        first = planned(jnp.zeros_like(params.lean))
        upright = jnp.stack([jnp.zeros_like(params.lean), params.lean, jnp.zeros_like(params.lean)])
        set_point = pose_joints(params, first, upright, robot=robot)
        joints = set_point + noise.start * jax.random.normal(start_key, (NUM_JOINTS,), theta.dtype)
        torso = _torso_over(first, params.lean, robot.geometry)
        state = initial_state(jnp.concatenate([torso, joints]), model.nv)
        times = jnp.arange(1, num_ticks + 1, dtype=theta.dtype) * CONTROL_PERIOD
        poses = jax.vmap(planned)(times)
        lean_noise = noise.lean * jax.random.normal(lean_key, (num_ticks, 3), theta.dtype)
        set_point_noise = noise.set_point * jax.random.normal(
            set_point_key, (num_ticks, NUM_JOINTS), theta.dtype
        )
        set_point_noise = jnp.concatenate([jnp.zeros((1, NUM_JOINTS), theta.dtype), set_point_noise])
        return _Walk(state, set_point, params, poses, lean_noise, set_point_noise, circumstances)

    def advance(walk: _Walk, tick: Array, state: RobotState, set_point: Array) -> tuple[RobotState, Array]:
        pose, lean_noise = jax.tree.map(lambda leaf: leaf[tick], (walk.poses, walk.lean_noise))
        measured = quat_to_rpy(state.qpos[3:7]) + lean_noise
        target = pose_joints(walk.params, pose, measured, balance=balance, robot=robot)
        target = next_set_point(set_point, target, CONTROL_PERIOD, robot=robot)
        # The servos miss their set-points by the noise; the speed that they are told is the planned one.
        before = set_point + walk.set_point_noise[tick]
        after = target + walk.set_point_noise[tick + 1]
        speed = (target - set_point) / CONTROL_PERIOD
        if walk.circumstances is None:
            return control_step(state, before, after, speed), target
        state = _pushed(state, tick, walk.circumstances)
        return control_step(state, before, after, speed, walk.circumstances.world), target

    return begin, advance


def _torso_over(pose: BodyPose, lean: Scalar, geometry: NaoGeometry) -> Array:
    """Return the position and quaternion of a torso that leans over the hips of a pose."""
    hip_centre = jnp.array([geometry.hip_x, 0.0, geometry.hip_z], lean.dtype)
    position = pose.hips[:3] - rotation_y(lean) @ hip_centre
    zero = jnp.zeros_like(lean)
    return jnp.concatenate([position, rpy_to_quat(jnp.stack([zero, lean, zero]))])


def _pushed(state: RobotState, tick: Array, circumstances: Circumstances) -> RobotState:
    """Return the state of the robot after the push, if there is one and it comes in this control step."""
    if circumstances.push_time is None:
        return state
    is_now = tick == round(circumstances.push_time / CONTROL_PERIOD)
    return state._replace(qvel=state.qvel.at[1].add(jnp.where(is_now, circumstances.push, 0.0)))


def _has_fallen(robot: Robot, qpos: Array, circumstances: Circumstances | None) -> Array:
    """Say whether the torso is low or far from upright; a state that is not finite counts as fallen."""
    is_high = qpos[2] > _FALLEN_SHARE * robot.geometry.torso_height
    rotation = quat_to_matrix(qpos[3:7])
    cosine = rotation[2, 2] if circumstances is None else upward(circumstances.world) @ rotation[:, 2]
    return ~(is_high & (cosine > _FALLEN_COSINE))


def _check_numbers(name: str, record: WalkReward | WalkNoise | Balance, *, least: float = -math.inf) -> None:
    for field, value in record._asdict().items():
        checks.number(f"{name}.{field}", value, least=least)


def _check_model(model: mujoco.MjModel, robot: Robot) -> None:
    """Refuse a model that is not the robot's, or whose time step does not divide a control step."""
    check_model(model, robot)
    ratio = CONTROL_PERIOD / model.opt.timestep
    if abs(ratio - round(ratio)) > 1e-6:
        raise ValueError(
            f"the control step of {CONTROL_PERIOD} s is no multiple of the time step {model.opt.timestep} s"
        )
