"""One walk in closed loop: plan it, pose the joints for the measured orientation, simulate the robot."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco

from creps_jax import checks
from creps_jax.numerics.rotations import quat_to_matrix, quat_to_rpy, rotation_y, rpy_to_quat
from creps_jax.robots.nao_geometry import NUM_JOINTS
from creps_jax.robots.robot import Robot
from creps_jax.simulation.models import check_model, load_nao
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
from creps_jax.typing import Array, Bool, Float, IntScalar, PRNGKey, Scalar
from creps_jax.walking.engine import BodyPose, plan_walk, pose_at, pose_joints, stand_upright
from creps_jax.walking.params import WalkParams, count_steps, params_from_theta
from creps_jax.walking.posture import Balance
from creps_jax.walking.set_points import next_set_point

__all__ = ["CONTROL_PERIOD", "WalkNoise"]

CONTROL_PERIOD = 0.02
"""Duration of a control step, s."""
# A robot has fallen if its torso is below this share of its height with straight legs (with the knees bent
# as far as possible it has 0.8 of it), or if the trunk leans by more than 50 degrees.
_FALLEN_SHARE = 0.2 / 0.385
_FALLEN_COSINE = 0.64
# All control steps are planned before the first: a longer episode would fill the memory.
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
        balance: How steps answer to the measured orientation.
        conditions: The conditions that the context holds besides the speed.
        world: The world of the robot's model.
        num_velocities: Number of generalised velocities of the model.
        control_step: Simulates one control step.
    """

    robot: Robot
    duration: float
    noise: WalkNoise
    balance: Balance
    conditions: Sequence[Condition]
    world: World
    num_velocities: int
    control_step: ControlStep

    @property
    def num_ticks(self) -> int:
        """Number of control steps of the episode."""
        return round(self.duration / CONTROL_PERIOD)


class PlannedWalk(NamedTuple):
    """What is fixed for one walk, computed before its first control step (leading axis n control steps).

    Attributes:
        params: Walking parameters; the lean is measured from the floor's normal.
        poses: Planned poses of hips and feet, at the end of each control step.
        lean_noise: Noise on the measured roll, pitch and yaw, rad.
        set_point_noise: Noise on the set-points, at the start of the first control step (zero) and at the
            end of each, rad.
        circumstances: Values of the conditions; None without conditions.
    """

    params: WalkParams
    poses: BodyPose
    lean_noise: Float[Array, "n 3"]
    set_point_noise: Float[Array, "n+1 nu"]
    circumstances: Circumstances | None


class WalkState(NamedTuple):
    """What one control step passes to the next.

    Attributes:
        robot: State of the simulated robot.
        set_point: Planned set-points of the servos, without the noise, rad.
    """

    robot: RobotState
    set_point: Float[Array, " nu"]


def make_setup(
    robot: Robot,
    model: mujoco.MjModel | None,
    duration: float,
    noise: WalkNoise,
    balance: Balance,
    conditions: Sequence[Condition],
    physics: Physics,
) -> WalkSetup:
    """Check the settings of a walk, and return what is fixed for a task.

    Raises:
        ValueError: If the duration, the noise, the balance, the conditions, the physics or the model cannot
            be used.
    """
    if not CONTROL_PERIOD <= duration <= _LONGEST:
        raise ValueError(f"duration must be {CONTROL_PERIOD} to {_LONGEST:g} s, got {duration}")
    check_numbers("noise", noise, least=0.0)
    check_numbers("balance", balance)
    check_conditions(conditions, duration, CONTROL_PERIOD)
    checks.function("physics", physics, "(model, number of steps) -> control step")
    used = load_nao(robot) if model is None else model
    check_model(used, robot)
    control_step = physics(used, _count_substeps(used))
    return WalkSetup(robot, duration, noise, balance, conditions, world_of(used), used.nv, control_step)


def check_numbers(name: str, record: Any, *, least: float = -math.inf) -> None:
    """Check that each field of a record is a number in its limits.

    Raises:
        ValueError: If a field is not.
    """
    for field, value in record._asdict().items():
        checks.number(f"{name}.{field}", value, least=least)


def plan(
    setup: WalkSetup, key: PRNGKey, theta: Float[Array, "10"], values: Float[Array, " k"]
) -> tuple[PlannedWalk, WalkState]:
    """Plan a walk from standstill, and sample its noise.

    Args:
        setup: What is fixed for the task.
        key: Random key.
        theta: Walking parameters in the paper's order and units.
        values: Value of each condition.

    Returns:
        The planned walk, and the state before its first control step.
    """
    start_key, lean_key, set_point_key = jax.random.split(key, 3)
    circumstances = circumstances_of(setup.conditions, values, setup.world)
    params = params_from_theta(theta)
    pose_after = _planned_pose(setup, params, circumstances)
    if circumstances is not None:
        # Plan and measurement are in the frame of the floor: the robot finds the vertical and is told the
        # slope. Theta's lean counts from the vertical, which itself leans forward from a floor that rises.
        params = params._replace(lean=params.lean + slope_angle(circumstances.world))
    start = _start(setup, start_key, params, pose_after(jnp.zeros_like(params.lean)))
    times = jnp.arange(1, setup.num_ticks + 1, dtype=theta.dtype) * CONTROL_PERIOD
    lean_noise = setup.noise.lean * jax.random.normal(lean_key, (setup.num_ticks, 3), theta.dtype)
    set_point_noise = setup.noise.set_point * jax.random.normal(
        set_point_key, (setup.num_ticks, NUM_JOINTS), theta.dtype
    )
    set_point_noise = jnp.concatenate([jnp.zeros((1, NUM_JOINTS), theta.dtype), set_point_noise])
    poses = jax.vmap(pose_after)(times)
    return PlannedWalk(params, poses, lean_noise, set_point_noise, circumstances), start


def advance(setup: WalkSetup, walk: PlannedWalk, tick: IntScalar, state: WalkState) -> WalkState:
    """Control and simulate the robot for one control step.

    Args:
        setup: What is fixed for the task.
        walk: What is fixed for the walk.
        tick: Number of the control step, from 0.
        state: State before it.

    Returns:
        The state after it.
    """
    robot, set_point = state
    pose, lean_noise = jax.tree.map(lambda leaf: leaf[tick], (walk.poses, walk.lean_noise))
    measured = quat_to_rpy(robot.qpos[3:7]) + lean_noise
    target = pose_joints(walk.params, pose, measured, balance=setup.balance, robot=setup.robot)
    target = next_set_point(set_point, target, CONTROL_PERIOD, robot=setup.robot)
    # The servos miss their set-points by the noise; the speed that they are told is the planned one.
    before = set_point + walk.set_point_noise[tick]
    after = target + walk.set_point_noise[tick + 1]
    speed = (target - set_point) / CONTROL_PERIOD
    if walk.circumstances is None:
        return WalkState(setup.control_step(robot, before, after, speed), target)
    robot = _pushed(robot, tick, walk.circumstances)
    robot = setup.control_step(robot, before, after, speed, walk.circumstances.world)
    return WalkState(robot, target)


def is_fallen(setup: WalkSetup, walk: PlannedWalk, state: WalkState) -> Bool[Array, ""]:
    """Return whether the torso is low or far from upright; a state that is not finite counts as fallen."""
    qpos = state.robot.qpos
    is_high = qpos[2] > _FALLEN_SHARE * setup.robot.geometry.torso_height
    rotation = quat_to_matrix(qpos[3:7])
    circumstances = walk.circumstances
    cosine = rotation[2, 2] if circumstances is None else upward(circumstances.world) @ rotation[:, 2]
    return ~(is_high & (cosine > _FALLEN_COSINE))


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


def _planned_pose(
    setup: WalkSetup, params: WalkParams, circumstances: Circumstances | None
) -> Callable[[Scalar], BodyPose]:
    """Plan the steps of a walk; return the function from time, s, to the pose of hips and feet."""
    plans = plan_walk(params, count_steps(setup.duration), robot=setup.robot)

    def pose_after(time: Scalar) -> BodyPose:
        pose = pose_at(params, plans, time, robot=setup.robot)
        return pose if circumstances is None else stand_upright(pose, slope_angle(circumstances.world))

    return pose_after


def _start(setup: WalkSetup, key: PRNGKey, params: WalkParams, pose: BodyPose) -> WalkState:
    """Return the state at rest in a pose, the trunk leaning as intended, with noise on the joints."""
    zero = jnp.zeros_like(params.lean)
    intended_rpy = jnp.stack([zero, params.lean, zero])
    set_point = pose_joints(params, pose, intended_rpy, robot=setup.robot)
    joints = set_point + setup.noise.start * jax.random.normal(key, (NUM_JOINTS,), params.lean.dtype)
    geometry = setup.robot.geometry
    hip_centre = jnp.array([geometry.hip_x, 0.0, geometry.hip_z], params.lean.dtype)
    position = pose.hips[:3] - rotation_y(params.lean) @ hip_centre
    qpos = jnp.concatenate([position, rpy_to_quat(intended_rpy), joints])
    return WalkState(initial_state(qpos, setup.num_velocities), set_point)


def _pushed(robot: RobotState, tick: IntScalar, circumstances: Circumstances) -> RobotState:
    """Return the state after the push, if there is one and it comes in this control step."""
    if circumstances.push_time is None:
        return robot
    is_now = tick == round(circumstances.push_time / CONTROL_PERIOD)
    return robot._replace(qvel=robot.qvel.at[1].add(jnp.where(is_now, circumstances.push, 0.0)))
