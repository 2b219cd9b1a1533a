"""A planar arm of three links that reaches via-points, or into a hole in the ground, moved by DMPs."""

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax import checks
from creps_jax.contexts import gaussian_contexts
from creps_jax.policies.space import Space
from creps_jax.tasks.base import PlainOutcome, Task
from creps_jax.tasks.dmp import DmpTrajectory, dmp_trajectory
from creps_jax.typing import Array, Bool, Float, PRNGKey, Scalar, ScalarLike, VectorLike

__all__ = [
    "HoleOutcome",
    "arm_points",
    "hits_ground",
    "hole_movement",
    "hole_reaching",
    "via_point_movement",
    "via_point_reaching",
]

NUM_LINKS = 3
NUM_BASIS = 5
NUM_STEPS = 100
DURATION = 3.0
_VIA_STEP = 50
# The arm starts straight up. In the via-point task it ends stretched out along the ground.
_START = (0.0, 0.0, 0.0)
_STRETCHED = (0.5 * math.pi, 0.0, 0.0)
_STRETCHED_POINT = (3.0, 0.0)


class HoleOutcome(NamedTuple):
    """The outcome of reaching into the hole.

    Attributes:
        reward: See `hole_reaching`.
        violation: Empty.
        num_collisions: Number of time steps at which a link is in the ground.
        distance: Final distance of the end effector from the middle of the hole's floor, m.
    """

    reward: Float[Array, ""]
    violation: Float[Array, " c"]
    num_collisions: Float[Array, ""]
    distance: Float[Array, ""]


@checks.arguments
def via_point_reaching(
    low: VectorLike = (-1.5, -1.5),
    high: VectorLike = (-0.5, -0.5),
    *,
    sample_context: Callable[[PRNGKey], Array] | None = None,
) -> Task:
    """Make the task in which an arm passes a via-point half-way and ends stretched out to the right.

    The context is the via-point (x, y), m. Theta holds the weights of the DMPs, a row of three joints for
    each of five bases, rad. The goal of the DMPs is the stretched posture. The reward is
    `-1e4 (|p_50 - v|^2 + |p_100 - (3, 0)|^2) - 0.5 sum |acceleration|^2`, over 100 steps of 0.03 s.

    Args:
        low: Lower ends of the range of the via-point, m.
        high: Upper ends of that range, m.
        sample_context: (key) -> via-point (2,); by default Gaussian about the middle, clipped to the range.

    Returns:
        The task, without noise.

    Raises:
        ValueError: If the range is not in order, or does not have two variables.

    Source: Abdolmaleki et al. 2016, Section 4.2; the printed end point (5, 0) is out of reach.
    """
    if checks.vector("low", low).shape != (2,):
        raise ValueError(f"low must have two entries, of x and y, got {checks.shown(low)}")
    default = gaussian_contexts(low, high, clip=True)
    sample_context = default if sample_context is None else sample_context

    @checks.arguments
    def rollout(key: PRNGKey, context: Float[Array, "2"], theta: Float[Array, "15"]) -> PlainOutcome:
        del key
        movement = via_point_movement(theta)
        tips = jax.vmap(arm_points)(movement.pos)[:, -1]
        miss = jnp.sum(jnp.square(tips[_VIA_STEP - 1] - context))
        miss = miss + jnp.sum(jnp.square(tips[-1] - jnp.array(_STRETCHED_POINT, theta.dtype)))
        reward = -1e4 * miss - 0.5 * jnp.sum(jnp.square(movement.acc))
        return PlainOutcome(reward, jnp.zeros(0, theta.dtype))

    contexts = Space(("via_x", "via_y"), _tuple(low), _tuple(high), ("m", "m"))
    parameters = _dmp_parameters(num_goals=0)
    return Task(sample_context, rollout, 2, parameters.size, -1e7, contexts, parameters)


@checks.arguments
def hole_reaching(
    low: float = 1.4,
    high: float = 2.0,
    *,
    width: float = 0.3,
    depth: float = 1.0,
    sample_context: Callable[[PRNGKey], Array] | None = None,
) -> Task:
    """Make the task in which an arm ends at the bottom of a hole in the ground without any collision.

    The context is the x of the hole's middle, m. Theta holds the weights of the DMPs, a row of three joints
    for each of five bases, and then their goals, rad. The reward is
    `-1e5 (d^2 + number of steps in collision) - 10 sum |acceleration|^2`, over 100 steps of 0.03 s. Here d is
    the final distance from the middle of the hole's floor; after a collision it is at least the initial
    distance, so that a movement through the ground is never better than standing still.

    Args:
        low: Lowest x of the hole's middle, m.
        high: Highest x of the hole's middle, m.
        width: Width of the hole, m.
        depth: Depth of the hole, m.
        sample_context: (key) -> x (1,); by default Gaussian about the middle of the range, clipped to it.

    Returns:
        The task, without noise.

    Raises:
        ValueError: If the range is not in order, or width or depth are not positive.

    Source: Abdolmaleki et al. 2016, Section 4.2; the weights 1e5 and 10, and the duration of a step, are from
    its author's published settings.
    """
    checks.number("width", width, above=0.0)
    checks.number("depth", depth, above=0.0)
    default = gaussian_contexts(low, high, clip=True)
    sample_context = default if sample_context is None else sample_context

    @checks.arguments
    def rollout(key: PRNGKey, context: Float[Array, "1"], theta: Float[Array, "18"]) -> HoleOutcome:
        del key
        movement = hole_movement(theta)
        points = jax.vmap(arm_points)(movement.pos)
        hits = jax.vmap(lambda posture: hits_ground(posture, context[0], width, depth))(points)
        num_collisions = jnp.sum(hits, dtype=theta.dtype)
        floor = jnp.stack([context[0], jnp.asarray(-depth, context.dtype)])
        first = jnp.sum(jnp.square(arm_points(jnp.array(_START, theta.dtype))[-1] - floor))
        last = jnp.sum(jnp.square(points[-1, -1] - floor))
        missed = jnp.where(num_collisions > 0, jnp.maximum(first, last), last)
        reward = -1e5 * (missed + num_collisions) - 10.0 * jnp.sum(jnp.square(movement.acc))
        return HoleOutcome(reward, jnp.zeros(0, theta.dtype), num_collisions, jnp.sqrt(last))

    contexts, parameters = Space(("hole_x",), (low,), (high,), ("m",)), _dmp_parameters(num_goals=NUM_LINKS)
    return Task(sample_context, rollout, 1, parameters.size, -1e8, contexts, parameters)


@checks.arguments
def via_point_movement(theta: Float[Array, "15"]) -> DmpTrajectory:
    """Return the movement of the joints in `via_point_reaching`, rad and s."""
    return _movement(theta, jnp.array(_STRETCHED, theta.dtype))


@checks.arguments
def hole_movement(theta: Float[Array, "18"]) -> DmpTrajectory:
    """Return the movement of the joints in `hole_reaching`, rad and s."""
    return _movement(theta[:-NUM_LINKS], theta[-NUM_LINKS:])


@checks.arguments
def arm_points(joint_pos: Float[Array, " k"]) -> Float[Array, "k+1 2"]:
    """Return the ends of the links of 1 m, from the base at the origin to the end effector.

    Args:
        joint_pos: Angle of each link relative to the previous one, of the first to the vertical, clockwise,
            rad.

    Returns:
        Points (x, y), m.
    """
    angle = jnp.cumsum(joint_pos)
    ends = jnp.cumsum(jnp.stack([jnp.sin(angle), jnp.cos(angle)], axis=1), axis=0)
    return jnp.concatenate([jnp.zeros((1, 2), ends.dtype), ends])


@checks.arguments
def hits_ground(
    points: Float[Array, "n 2"], center: Scalar, width: ScalarLike, depth: ScalarLike
) -> Bool[Array, ""]:
    """Return whether any part of a chain of links is in the ground, which has one hole.

    The test is exact: the part of a link below the surface is a segment, and the hole is convex, so the
    segment is in the hole if both its ends are.

    Args:
        points: Ends of the links, m; the surface of the ground is y = 0, and contact with it is no collision.
        center: Middle of the hole, m.
        width: Width of the hole, m.
        depth: Depth of the hole, m.

    Returns:
        Whether there is a collision.
    """
    begin, end = points[:-1], points[1:]
    rise = end[:, 1] - begin[:, 1]
    # Where the link crosses y = 0. Without a crossing both values are unused.
    share = -begin[:, 1] / jnp.where(rise == 0.0, 1.0, rise)
    crossing = begin[:, 0] + share * (end[:, 0] - begin[:, 0])
    is_below = points[:, 1] < 0.0
    crosses = is_below[:-1] != is_below[1:]
    is_in_hole = (jnp.abs(points[:, 0] - center) <= 0.5 * width) & (points[:, 1] >= -depth)
    crosses_in_hole = jnp.abs(crossing - center) <= 0.5 * width
    return jnp.any(is_below & ~is_in_hole) | jnp.any(crosses & ~crosses_in_hole)


def _tuple(ends: VectorLike) -> tuple[float, ...]:
    return tuple(np.ravel(np.asarray(ends, float)).tolist())


def _dmp_parameters(*, num_goals: int) -> Space:
    """Name the weights of each basis and joint, and the goals of the first joints."""
    weights = [f"weight_{basis + 1}_{joint + 1}" for basis in range(NUM_BASIS) for joint in range(NUM_LINKS)]
    names = (*weights, *(f"goal_{joint + 1}" for joint in range(num_goals)))
    return Space.unbounded(names, ("rad",) * len(names))


def _movement(weights: Array, goal: Array) -> DmpTrajectory:
    start = jnp.array(_START, goal.dtype)
    return dmp_trajectory(
        weights.reshape(NUM_BASIS, NUM_LINKS), start, goal, duration=DURATION, num_steps=NUM_STEPS
    )
