"""One walk in closed loop: plan it, pose the joints for the measured orientation, simulate the robot."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from creps_jax import checks
from creps_jax.numerics.rotations import quat_to_matrix, quat_to_rpy, rotation_y, rpy_to_quat
from creps_jax.robots.robot import Robot
from creps_jax.simulation.models import check_model, load_model
from creps_jax.simulation.servos import read_servos
from creps_jax.simulation.state import ControlStep, Physics, RobotState, initial_state
from creps_jax.simulation.world import World, world_of
from creps_jax.tasks.conditions import (
    Circumstances,
    Condition,
    check_conditions,
    circumstances_of,
    slope_angle,
    upward,
)
from creps_jax.typing import Array, Bool, Float, Int, IntScalar, PRNGKey, Scalar, ScalarLike
from creps_jax.walking.controller import Walker, WalkerState
from creps_jax.walking.engine import BodyPose

__all__ = ["CONTROL_PERIOD", "WalkNoise"]

CONTROL_PERIOD = 0.02
"""Duration of a control step, s."""
# A robot has fallen if its torso is below this share of its height with straight legs (with the knees bent
# as far as possible it has 0.8 of it), or if the trunk leans by more than 50 degrees.
_FALLEN_SHARE = 0.2 / 0.385
_FALLEN_COSINE = 0.64
# The noise of all control steps is drawn before the first: a longer episode would fill the memory.
_LONGEST = 3600.0


class WalkNoise(NamedTuple):
    """Standard deviations of the noise on measured angles, set-points and joints at the start, rad.

    The noise is white: it is sampled anew in each control step.
    """

    lean: float = 0.01
    set_point: float = 0.01
    start: float = 0.01

    def times(self, factor: float) -> "WalkNoise":
        """Return this noise times a factor."""
        return WalkNoise(*(factor * size for size in self))


class WalkSetup(NamedTuple):
    """What is fixed for a task; nothing of it is traced.

    Attributes:
        robot: The robot.
        duration: Length of the episode, s.
        noise: Sizes of the noise.
        conditions: The conditions that the context holds besides the speed.
        world: The world of the robot's model.
        num_velocities: Number of generalised velocities of the model.
        joint_index: Index of each joint of the robot in the model's positions qpos.
        control_step: Simulates one control step.
    """

    robot: Robot
    duration: float
    noise: WalkNoise
    conditions: Sequence[Condition]
    world: World
    num_velocities: int
    joint_index: Int[np.ndarray, " nu"]
    control_step: ControlStep

    @property
    def num_ticks(self) -> int:
        """Number of control steps of the episode."""
        return round(self.duration / CONTROL_PERIOD)


class Walk(NamedTuple):
    """What is fixed for one walk, drawn before its first control step (n control steps).

    Attributes:
        lean_noise: Noise on the measured roll, pitch and yaw, rad.
        set_point_noise: Noise on the set-points, at the start of the first control step (zero) and at the
            end of each, rad.
        circumstances: Values of the conditions; None without conditions.
    """

    lean_noise: Float[Array, "n 3"]
    set_point_noise: Float[Array, "n+1 nu"]
    circumstances: Circumstances | None

    @property
    def slope(self) -> ScalarLike:
        """Angle by which the floor rises along x of the world, rad: the robot is told."""
        return _slope_in(self.circumstances)


class WalkState(NamedTuple):
    """What one control step passes to the next.

    Attributes:
        robot: State of the simulated robot.
        walker: State of the walk; its set-points are without the noise.
    """

    robot: RobotState
    walker: WalkerState


def make_setup(
    robot: Robot,
    model: mujoco.MjModel | None,
    duration: float,
    noise: WalkNoise,
    conditions: Sequence[Condition],
    physics: Physics,
) -> WalkSetup:
    """Check the settings of a walk, and return what is fixed for a task.

    Raises:
        ValueError: If the duration, the noise, the conditions, the physics or the model cannot be used.
    """
    if not CONTROL_PERIOD <= duration <= _LONGEST:
        raise ValueError(f"duration must be {CONTROL_PERIOD} to {_LONGEST:g} s, got {duration}")
    check_numbers("noise", noise, least=0.0)
    check_conditions(conditions, duration, CONTROL_PERIOD)
    checks.function("physics", physics, "(model, number of steps) -> control step")
    used = load_model(robot) if model is None else model
    check_model(used, robot)
    control_step, joint_index = physics(used, _count_substeps(used)), read_servos(used).qpos_index
    return WalkSetup(robot, duration, noise, conditions, world_of(used), used.nv, joint_index, control_step)


def check_start_up(start_up: float, duration: float) -> None:
    """Check that the start-up of an episode ends before the episode.

    Raises:
        ValueError: If it does not.
    """
    if not 0 <= start_up < duration:
        raise ValueError(
            f"start_up must lie in [0, duration), got start_up {start_up} and duration {duration}"
        )


def check_numbers(name: str, record: Any, *, least: float = -math.inf) -> None:
    """Check that each field of a record is a number in its limits.

    Raises:
        ValueError: If a field is not.
    """
    for field, value in record._asdict().items():
        checks.number(f"{name}.{field}", value, least=least)


def begin(
    setup: WalkSetup, walker: Walker, key: PRNGKey, values: Float[Array, " k"]
) -> tuple[Walk, WalkState]:
    """Sample the noise of a walk, and put the robot on its feet.

    Args:
        setup: What is fixed for the task.
        walker: What controls the robot.
        key: Random key.
        values: Value of each condition.

    Returns:
        The walk, and the state before its first control step.
    """
    start_key, lean_key, set_point_key = jax.random.split(key, 3)
    circumstances = circumstances_of(setup.conditions, values, setup.world)
    slope = _slope_in(circumstances)
    standing = walker.start(slope)
    dtype, num_joints = standing.set_point.dtype, setup.robot.num_joints
    lean_noise = setup.noise.lean * jax.random.normal(lean_key, (setup.num_ticks, 3), dtype)
    set_point_noise = setup.noise.set_point * jax.random.normal(
        set_point_key, (setup.num_ticks, num_joints), dtype
    )
    set_point_noise = jnp.concatenate([jnp.zeros((1, num_joints), dtype), set_point_noise])
    joint_noise = setup.noise.start * jax.random.normal(start_key, (num_joints,), dtype)
    robot = stand(setup, walker, standing, slope, joint_noise)
    return Walk(lean_noise, set_point_noise, circumstances), WalkState(robot, standing)


def stand(
    setup: WalkSetup,
    walker: Walker,
    standing: WalkerState,
    slope: ScalarLike = 0.0,
    joint_noise: Float[Array, " nu"] | float = 0.0,
) -> RobotState:
    """Return the state of a robot that stands at rest as a walker starts, with noise on its joints, rad."""
    lean = standing.gait.params.lean + slope
    torso = _torso_over(walker.pose(standing, slope), lean, setup.robot)
    joints = jnp.zeros(setup.robot.num_joints, torso.dtype)
    joints = joints.at[setup.joint_index - len(torso)].set(standing.set_point + joint_noise)
    return initial_state(jnp.concatenate([torso, joints]), setup.num_velocities)


def advance(
    setup: WalkSetup,
    walker: Walker,
    walk: Walk,
    tick: IntScalar,
    state: WalkState,
    command: Float[Array, "3"],
) -> WalkState:
    """Control and simulate the robot for one control step.

    Args:
        setup: What is fixed for the task.
        walker: What controls the robot.
        walk: What is fixed for the walk.
        tick: Number of the control step, from 0.
        state: State before it.
        command: Commanded speeds (vx forward, vy left, turn rate), m/s and rad/s.

    Returns:
        The state after it.
    """
    robot, walking = state
    measured = quat_to_rpy(robot.qpos[3:7]) + walk.lean_noise[tick]
    last = walking.set_point
    walking, target = walker.step(walking, command, measured, walk.slope)
    # The servos miss their set-points by the noise; the speed that they are told is the planned one.
    before, after = last + walk.set_point_noise[tick], target + walk.set_point_noise[tick + 1]
    speed = (target - last) / CONTROL_PERIOD
    if walk.circumstances is None:
        return WalkState(setup.control_step(robot, before, after, speed), walking)
    robot = _pushed(robot, tick, walk.circumstances)
    robot = setup.control_step(robot, before, after, speed, walk.circumstances.world)
    return WalkState(robot, walking)


def without_fallen(state: WalkState, has_fallen: Bool[Array, ""]) -> WalkState:
    """Return the state with NaN for a robot that has fallen: C MuJoCo skips it.

    A batch continues until all its robots have finished.
    """
    robot = jax.tree.map(lambda x: jnp.where(has_fallen, jnp.nan, x), state.robot)
    return state._replace(robot=robot)


def is_fallen(setup: WalkSetup, walk: Walk, state: WalkState) -> Bool[Array, ""]:
    """Return whether the torso is low or far from upright; a state that is not finite counts as fallen."""
    circumstances = walk.circumstances
    return is_robot_fallen(setup, state.robot, None if circumstances is None else upward(circumstances.world))


def is_robot_fallen(
    setup: WalkSetup, robot: RobotState, up: Float[Array, "3"] | None = None
) -> Bool[Array, ""]:
    """Return the same for a robot; `up` is the vertical in the frame of the floor, by default its normal."""
    is_high = robot.qpos[2] > _FALLEN_SHARE * setup.robot.torso_height
    rotation = quat_to_matrix(robot.qpos[3:7])
    cosine = rotation[2, 2] if up is None else up @ rotation[:, 2]
    return ~(is_high & (cosine > _FALLEN_COSINE))


def _slope_in(circumstances: Circumstances | None) -> ScalarLike:
    """Return the angle by which the floor rises along x of the world, rad; without conditions it is level."""
    return 0.0 if circumstances is None else slope_angle(circumstances.world)


def _count_substeps(model: mujoco.MjModel) -> int:
    """Return the number of physics steps in a control step.

    Raises:
        ValueError: If the time step of the model does not divide a control step.
    """
    ratio = CONTROL_PERIOD / model.opt.timestep
    if abs(ratio - round(ratio)) > 1e-6:
        raise ValueError(
            f"time step of the model must divide the control step of {CONTROL_PERIOD} s, "
            f"got {model.opt.timestep} s"
        )
    return round(ratio)


def _torso_over(pose: BodyPose, lean: Scalar, robot: Robot) -> Float[Array, "7"]:
    """Return the position (m) and quaternion of a torso that leans over the hips of a pose."""
    x, z = robot.hip_centre
    hip_centre = jnp.array([x, 0.0, z], lean.dtype)
    position = pose.hips[:3] - rotation_y(lean) @ hip_centre
    zero = jnp.zeros_like(lean)
    return jnp.concatenate([position, rpy_to_quat(jnp.stack([zero, lean, zero]))])


def _pushed(robot: RobotState, tick: IntScalar, circumstances: Circumstances) -> RobotState:
    """Return the state after the push, if there is one and it comes in this control step."""
    if circumstances.push_time is None:
        return robot
    is_now = tick == round(circumstances.push_time / CONTROL_PERIOD)
    return robot._replace(qvel=robot.qvel.at[1].add(jnp.where(is_now, circumstances.push, 0.0)))
