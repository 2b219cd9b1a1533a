"""Steer a walk at run time, one control period at a time, by a command that may change at any time.

A `Walker` plans step by step. Each step is planned in the frame of the body at its start, so that the numbers
stay small however far the robot walks.
"""

import dataclasses
import enum
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from creps_jax import checks
from creps_jax.numerics.rotations import wrapped
from creps_jax.robots.robot import NAO, Robot
from creps_jax.typing import Array, Bool, Float, IntScalar, Scalar, ScalarLike
from creps_jax.walking.com_plan import NUM_NODES, ComPlan, plan_com, plan_continuous_com
from creps_jax.walking.engine import (
    BodyPose,
    StepPlan,
    body_pose,
    pose_joints,
    stand_upright,
    vertical_trunk,
)
from creps_jax.walking.footsteps import Footstep, Stance, compose, next_footstep, relative_pose, standing
from creps_jax.walking.params import WalkParams
from creps_jax.walking.posture import Balance, Tilt, next_tilt
from creps_jax.walking.set_points import next_set_point

__all__ = ["Gait", "Stage", "Walker", "WalkerState"]

COM_METHODS = ("continuous", "one_step")
# Distance (m) and angle (rad) up to which feet count as side by side.
SIDE_BY_SIDE = 1e-3
# Largest heading error that is carried from one step to the next, rad.
MAX_HEADING_ERROR = 1.0


class Gait(NamedTuple):
    """How to walk at a command.

    Attributes:
        params: Walking parameters; `step_length` is not used, see `step`.
        step: Displacement of the body in one step (x forward, y left, yaw), m and rad.
    """

    params: WalkParams
    step: Float[Array, "3"]


class Stage(enum.IntEnum):
    """What a walker is doing."""

    STANDING = 0
    """Both feet stand side by side, the body is at rest."""
    STARTING = 1
    """Both feet stand, the body gains the velocity of the first step."""
    WALKING = 2
    """One foot swings."""
    STOPPING = 3
    """Both feet stand side by side, the body comes to rest."""


class WalkerState(NamedTuple):
    """The state of a walk between two control periods; a pytree of arrays.

    Attributes:
        stage: What the walker is doing, see `Stage`.
        time: Time since the start of the present step, s.
        origin: Planar pose (x, y, yaw) of the body at the start of the present step in the world, as planned,
            m and rad; the yaw is from -pi to pi.
        command: Present command (vx, vy, turn rate), limited by the acceleration, m/s and rad/s.
        gait: Gait of the present step.
        plan: Plan of the present step, in the frame of `origin`.
        after: Stance after the present step, in the same frame.
        com_velocity: Velocity of the CoM at the end of the present step, in the same frame, m/s.
        tilt: Roll and pitch of the trunk, filtered.
        set_point: Last set-points of the joints, rad.
    """

    stage: IntScalar
    time: Scalar
    origin: Float[Array, "3"]
    command: Float[Array, "3"]
    gait: Gait
    plan: StepPlan
    after: Stance
    com_velocity: Float[Array, "2"]
    tilt: Tilt
    set_point: Float[Array, " nu"]


@dataclasses.dataclass(frozen=True)
class Walker:
    """A walk that follows commands: settings, and two pure functions that can be jitted and vmapped.

    A command is (vx forward, vy left, turn rate) in the frame of the body, m/s and rad/s. At the command zero
    the robot stops and stands with its feet side by side.

    Attributes:
        gait: (command (3,)) -> `Gait`, read at the start of each step.
        robot: The robot.
        period: Time between two set-points, s.
        balance: How steps answer to the measured orientation.
        acceleration: Largest rate of change of the command along its three axes, m/s^2, m/s^2, rad/s^2.
        com: How the CoM is planned: "continuous" continues its velocity from step to step, and begins and
            ends a walk with a step on both feet; "one_step" solves each step for itself between two
            positions, as in the paper.

    Raises:
        ValueError: If a setting is out of its range.

    Source: Abdolmaleki et al. 2016, Section 2; `continuous_com_trajectory` for the continuous CoM.
    """

    gait: Callable[[Float[Array, "3"]], Gait]
    robot: Robot = NAO
    period: float = 0.02
    balance: Balance = Balance()
    acceleration: tuple[float, float, float] = (0.4, 0.4, 2.0)
    com: str = "continuous"

    def __post_init__(self) -> None:
        """Check the settings."""
        checks.function("gait", self.gait, "(command) -> Gait")
        checks.instance("robot", self.robot, Robot)
        checks.instance("balance", self.balance, Balance)
        checks.number("period", self.period, above=0.0)
        checks.number("balance.filter_time", self.balance.filter_time, least=0.0)
        if (
            len(checks.finite("acceleration", checks.vector("acceleration", self.acceleration), above=0.0))
            != 3
        ):
            raise ValueError(f"acceleration must be three numbers above 0, got {self.acceleration}")
        if self.com not in COM_METHODS:
            raise ValueError(f"com must be one of {', '.join(COM_METHODS)}, got {self.com!r}")

    def start(self, slope: ScalarLike = 0.0) -> WalkerState:
        """Return the state of a robot that stands at the origin and looks along x.

        Args:
            slope: Angle by which the floor rises along x of the world, rad.
        """
        gait = self.gait(jnp.zeros(3))
        zero = jnp.zeros(3, gait.step.dtype)
        stance = standing(zero.dtype, robot=self.robot)
        state = WalkerState(
            stage=jnp.int32(Stage.STANDING),
            time=zero[0],
            origin=zero,
            command=zero,
            gait=gait,
            plan=_in_place(stance),
            after=stance,
            com_velocity=zero[:2],
            tilt=Tilt(zero[:2].at[1].set(gait.params.lean + slope), zero[:2]),
            set_point=jnp.zeros(len(self.robot.joint_lower), zero.dtype),
        )
        return state._replace(set_point=self._joints(state, None, zero[0], slope))

    @checks.arguments
    def step(
        self,
        state: WalkerState,
        command: Float[Array, "3"],
        measured_rpy: Float[Array, "3"],
        slope: ScalarLike = 0.0,
    ) -> tuple[WalkerState, Float[Array, " nu"]]:
        """Walk on by one control period.

        Args:
            state: The state.
            command: Wanted speeds of the body (vx forward, vy left, turn rate), m/s and rad/s.
            measured_rpy: Measured roll, pitch and yaw of the trunk, rad; the yaw may be of any turn.
            slope: Angle by which the floor rises along x of the world, rad.

        Returns:
            The new state, and the set-points of the joints at the end of the period, in the order of
            `robot.joint_names`, rad.

        Raises:
            ValueError: If an array has another shape, or the command or orientation is not finite.
        """
        checks.finite("command", command)
        limit = self.period * jnp.asarray(self.acceleration, command.dtype)
        command = state.command + jnp.clip(command - state.command, -limit, limit)
        time, is_over = self._advanced_time(state, command)
        begun = self._begin_step(state, command, measured_rpy[2])
        state = jax.tree.map(lambda new, old: jnp.where(is_over, new, old), begun, state)
        tilt = next_tilt(state.tilt, measured_rpy[:2], self.period, self.balance.filter_time)
        state = state._replace(time=time, command=command, tilt=tilt)
        target = self._joints(state, state.set_point, measured_rpy[2], slope)
        set_point = next_set_point(state.set_point, target, self.period, robot=self.robot)
        return state._replace(set_point=set_point), set_point

    def pose(self, state: WalkerState, slope: ScalarLike = 0.0) -> BodyPose:
        """Return the planned pose of hips and feet in the world, m and rad."""
        pose = self._pose_in_step(state, slope)

        def in_world(place: Float[Array, "4"]) -> Float[Array, "4"]:
            x, y, height, yaw = place
            x, y, yaw = compose(state.origin, jnp.stack([x, y, yaw]))
            return jnp.stack([x, y, height, yaw])

        return BodyPose(in_world(pose.hips), in_world(pose.left), in_world(pose.right), pose.turn)

    def _pose_in_step(self, state: WalkerState, slope: ScalarLike) -> BodyPose:
        """Return the planned pose of hips and feet in the frame of `state.origin`, m and rad."""
        params = state.gait.params
        is_stepping = state.stage == Stage.WALKING
        params = params._replace(swing_height=jnp.where(is_stepping, params.swing_height, 0.0))
        pose = body_pose(params, state.plan, state.time / params.step_duration, robot=self.robot)
        pose = pose._replace(turn=jnp.where(is_stepping, pose.turn, 0.0))
        return stand_upright(pose, jnp.asarray(slope, pose.hips.dtype), state.origin[2])

    def _advanced_time(self, state: WalkerState, command: Array) -> tuple[Scalar, Bool[Array, ""]]:
        """Return the time within the step one period later, and whether another step begins."""
        is_standing = state.stage == Stage.STANDING
        time, duration = state.time + self.period, state.gait.params.step_duration
        is_over = jnp.where(is_standing, jnp.any(command != 0.0), time >= duration)
        after = jnp.where(is_standing, self.period, time - duration)
        waiting = jnp.where(is_standing, 0.0, time)
        return jnp.where(is_over, after, waiting), is_over

    def _joints(
        self, state: WalkerState, last: Array | None, measured_yaw: Scalar, slope: ScalarLike
    ) -> Float[Array, " nu"]:
        """Return the joint targets of a state, for its tilt and the measured yaw of the trunk."""
        orientation = jnp.append(state.tilt.angle, wrapped(measured_yaw - state.origin[2]))
        pose = self._pose_in_step(state, slope)
        vertical = vertical_trunk(slope, state.origin[2] + pose.hips[3])
        settings = {"vertical": vertical, "balance": self.balance, "robot": self.robot}
        return pose_joints(state.gait.params, pose, orientation, last=last, **settings)

    def _begin_step(self, state: WalkerState, command: Array, measured_yaw: Scalar) -> WalkerState:
        """Plan the next step, in the frame of the body at its start."""
        body = state.after.body
        before = Stance(
            jnp.zeros_like(body),
            relative_pose(body, state.after.left),
            relative_pose(body, state.after.right),
            state.after.supports_left,
            state.after.step,
        )
        gait = self.gait(command)
        wants = jnp.any(command != 0.0)
        rests = ~wants & self._is_side_by_side(before)
        stage = self._next_stage(state.stage, wants, rests)
        wanted = jnp.where(wants, gait.step, 0.0)
        footstep, stepped = next_footstep(gait.params, before, wanted, robot=self.robot)
        still = _in_place(before)
        is_stepping = stage == Stage.WALKING
        footstep, after = jax.tree.map(
            lambda new, old: jnp.where(is_stepping, new, old), (footstep, stepped), (still.footstep, before)
        )
        com = self._plan_com(state, gait.params, wanted, before, footstep, after, stage)
        yaw = compose(state.origin, body)[2]
        error = jnp.clip(wrapped(yaw - measured_yaw), -MAX_HEADING_ERROR, MAX_HEADING_ERROR)
        return state._replace(
            stage=stage,
            origin=compose(state.origin, body).at[2].set(wrapped(measured_yaw + error)),
            gait=gait,
            plan=StepPlan(footstep, com.position, jnp.stack([before.body[2], after.body[2]])),
            after=after,
            com_velocity=com.velocity[1],
        )

    def _next_stage(self, stage: IntScalar, wants: Bool[Array, ""], rests: Bool[Array, ""]) -> IntScalar:
        is_one_step = self.com == "one_step"
        first = Stage.WALKING if is_one_step else Stage.STARTING
        last = Stage.STANDING if is_one_step else Stage.STOPPING
        on_both_feet = (stage == Stage.STANDING) | (stage == Stage.STOPPING)
        return jnp.where(
            on_both_feet,
            jnp.where(wants, first, Stage.STANDING),
            jnp.where((stage == Stage.WALKING) & rests, last, Stage.WALKING),
        ).astype(jnp.int32)

    def _plan_com(
        self,
        state: WalkerState,
        params: WalkParams,
        wanted: Float[Array, "3"],
        before: Stance,
        footstep: Footstep,
        after: Stance,
        stage: IntScalar,
    ) -> ComPlan:
        """Plan the CoM of a step, in the frame of `before`."""
        start, end = before.body[:2], after.body[:2]
        support = jnp.where(stage == Stage.WALKING, footstep.support[:2], start)
        if self.com == "one_step":
            return plan_com(params, start, support, end, robot=self.robot)
        # The step ends with the velocity with which the one-step solution of the step after it begins.
        following, then = next_footstep(params, after, wanted, robot=self.robot)
        next_com = plan_com(params, end, following.support[:2], then.body[:2], robot=self.robot)
        is_last = (stage == Stage.WALKING) & ~jnp.any(wanted != 0.0) & self._is_side_by_side(after)
        is_last = is_last | (stage == Stage.STOPPING) | (stage == Stage.STANDING)
        wanted_end = jnp.stack([end, jnp.where(is_last, 0.0, next_com.velocity[0])])
        return plan_continuous_com(params, _continued(state), start, support, wanted_end, robot=self.robot)

    def _is_side_by_side(self, stance: Stance) -> Bool[Array, ""]:
        spacing = jnp.zeros_like(stance.left).at[1].set(-self.robot.foot_spacing)
        apart = relative_pose(stance.left, stance.right) - spacing
        return jnp.all(jnp.abs(apart) < SIDE_BY_SIDE)


def _continued(state: WalkerState) -> Float[Array, "2 2"]:
    """Return position (m) and velocity (m/s) of the CoM at the end of a step, seen from the body there."""
    body = state.after.body
    position = relative_pose(body, jnp.append(state.plan.com[-1], body[2]))
    velocity = relative_pose(body.at[:2].set(0.0), jnp.append(state.com_velocity, body[2]))
    return jnp.stack([position[:2], velocity[:2]])


def _in_place(stance: Stance) -> StepPlan:
    """Plan a step on both feet: neither they nor the body move."""
    support = jnp.where(stance.supports_left, stance.left, stance.right)
    other = jnp.where(stance.supports_left, stance.right, stance.left)
    footstep = Footstep(support, other, other, stance.supports_left)
    com = jnp.tile(stance.body[:2], (NUM_NODES, 1))
    return StepPlan(footstep, com, jnp.stack([stance.body[2], stance.body[2]]))
