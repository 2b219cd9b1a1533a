"""Plan where the feet go: one step at a time, in any direction."""

from typing import NamedTuple

import jax.numpy as jnp

from creps_jax import checks
from creps_jax.robots.robot import NAO, Robot
from creps_jax.typing import Array, Bool, Float, Scalar
from creps_jax.walking.params import WalkParams

__all__ = ["FOOT_SPACING", "Footstep", "Stance", "compose", "next_footstep", "relative_pose", "standing"]

FOOT_SPACING = NAO.foot_spacing
"""Distance of the two feet of the simulated NAO when standing, m."""

# Where the swing foot may land, seen from where it stands beside the support foot: forward, sideways on its
# own side (reach and collision), turned; m and rad, for a NAO. Lengths scale with the leg. The body stays
# within half of that box.
LANDING_LOW = (-0.20, -0.01, -0.6)
LANDING_HIGH = (0.20, 0.07, 0.6)
# The swing foot aims at the pose of the body one and a half steps ahead: after one, the body is between
# the feet.
SWING_AHEAD = 1.5


class Stance(NamedTuple):
    """Where body and feet are between two steps, and what comes next.

    Attributes:
        body: Planar pose (x, y, yaw) of the body, in a steady walk the middle of the feet, in the world,
            m and rad.
        left: Planar pose of the left foot's centre.
        right: That of the right foot.
        supports_left: Whether the left foot carries the coming step.
        step: Displacement (x, y, yaw) of the body in the last step, m and rad.
    """

    body: Float[Array, "3"]
    left: Float[Array, "3"]
    right: Float[Array, "3"]
    supports_left: Bool[Array, ""]
    step: Float[Array, "3"]


class Footstep(NamedTuple):
    """One step: who stands, who swings, from where to where (planar poses in the world, m and rad)."""

    support: Float[Array, "3"]
    swing_start: Float[Array, "3"]
    swing_end: Float[Array, "3"]
    supports_left: Bool[Array, ""]


def standing(dtype=jnp.float32, *, robot: Robot = NAO) -> Stance:
    """Return the stance of a robot that stands at the origin, looks ahead and lifts the right foot first."""
    origin = jnp.zeros(3, dtype)
    left = origin.at[1].set(0.5 * robot.foot_spacing)
    return Stance(origin, left, -left, jnp.asarray(True), origin)


def compose(pose: Float[Array, "3"], offset: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the planar pose in the world that is `offset` (x, y, yaw) in the frame of `pose`, m and rad."""
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    return pose + jnp.stack([cos * offset[0] - sin * offset[1], sin * offset[0] + cos * offset[1], offset[2]])


def relative_pose(pose: Float[Array, "3"], other: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the planar pose `other` (x, y, yaw) in the frame of `pose`, m and rad."""
    cos, sin = jnp.cos(pose[2]), jnp.sin(pose[2])
    x, y, yaw = other - pose
    return jnp.stack([cos * x + sin * y, cos * y - sin * x, yaw])


def _towards(step, wanted, growth: Scalar, spacing: float):
    """Move the step size towards the wanted one, which it may grow to by no more than the growth.

    It may shrink at once: how fast a walker slows down is limited by its command.
    """
    limit = jnp.stack([growth, growth, growth / spacing])
    shrunk = jnp.clip(step, jnp.minimum(wanted, 0.0), jnp.maximum(wanted, 0.0))
    return shrunk + jnp.clip(wanted - shrunk, -limit, limit)


def landing_box(robot: Robot) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the ends of the box in which the left foot may land, seen from the right one, m and rad."""
    low, high = (
        (robot.size * ahead, robot.foot_spacing + robot.size * aside, turned)
        for ahead, aside, turned in (LANDING_LOW, LANDING_HIGH)
    )
    return low, high


def _limit(seen, swing_side, share, robot):
    """Limit a pose, seen from the support foot, to a share of the box in which the swing foot may land."""
    low, high = (share * jnp.array(end, seen.dtype) for end in landing_box(robot))
    mirror = jnp.ones_like(seen).at[1].set(swing_side)
    return mirror * jnp.clip(mirror * seen, low, high)


@checks.arguments
def next_footstep(
    params: WalkParams, stance: Stance, command: Float[Array, "3"], *, robot: Robot = NAO
) -> tuple[Footstep, Stance]:
    """Plan the next step.

    The step size grows towards the commanded one by `step_growth * step_duration` a step. The landing place
    is limited to what the leg reaches and to its own side of the support foot, and the body to half of
    that.

    Args:
        params: Walking parameters.
        stance: Where the feet stand.
        command: Wanted displacement (x forward, y left, yaw) of the body in one step, m and rad.
        robot: Who steps.

    Returns:
        The footstep, and the stance after it.

    Source: Abdolmaleki et al. 2016, Section 2.1, Next-Step Position Generator.
    """
    spacing = robot.foot_spacing
    step = _towards(stance.step, command, params.step_growth * params.step_duration, spacing)
    support = jnp.where(stance.supports_left, stance.left, stance.right)
    swing_start = jnp.where(stance.supports_left, stance.right, stance.left)
    swing_side = jnp.where(stance.supports_left, -1.0, 1.0).astype(step.dtype)

    sideways = jnp.zeros_like(step).at[1].set(0.5 * spacing * swing_side)
    aim = compose(compose(stance.body, SWING_AHEAD * step), sideways)
    swing_end = compose(support, _limit(relative_pose(support, aim), swing_side, 1.0, robot))
    ahead = compose(stance.body, step)
    body = compose(support, _limit(relative_pose(support, ahead), swing_side, 0.5, robot))
    after = Stance(
        body=body,
        left=jnp.where(stance.supports_left, stance.left, swing_end),
        right=jnp.where(stance.supports_left, swing_end, stance.right),
        supports_left=~stance.supports_left,
        step=step,
    )
    return Footstep(support, swing_start, swing_end, stance.supports_left), after
