"""Plan how the CoM moves over one step, between the feet."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from creps_jax import checks
from creps_jax.robots.robot import NAO, Robot
from creps_jax.typing import Array, Float, Scalar
from creps_jax.walking.com import (
    com_trajectory,
    com_velocities,
    continuous_com_trajectory,
    spring_height,
)
from creps_jax.walking.params import WalkParams
from creps_jax.walking.zmp import zmp_reference, zmp_shares

__all__ = ["NUM_NODES", "ComPlan", "com_heights", "plan_com", "plan_continuous_com"]

NUM_NODES = 33
"""Number of equally spaced nodes at which a step is planned."""
# Largest shift of the ZMP in the feet that keeps the velocity of the CoM continuous, m (forward, sideways),
# for a NAO; it scales with the leg.
LARGEST_SHIFT = (0.04, 0.02)


class ComPlan(NamedTuple):
    """The motion of the CoM that is planned for one step.

    Attributes:
        position: Horizontal position at equally spaced nodes over the step, m.
        velocity: Horizontal velocity at the first and at the last node, m/s.
    """

    position: Float[Array, "n 2"]
    velocity: Float[Array, "2 2"]


@checks.arguments
def plan_com(
    params: WalkParams,
    start: Float[Array, "2"],
    support: Float[Array, "2"],
    end: Float[Array, "2"],
    *,
    robot: Robot = NAO,
) -> ComPlan:
    """Plan the CoM of one step between two positions: the step is solved for itself, as in the paper.

    Args:
        params: Walking parameters.
        start: Middle of the feet at the start of the step, where CoM and ZMP begin, m.
        support: Where the ZMP stays during the step, the centre of the support foot, m.
        end: Middle of the feet at the end of the step, where CoM and ZMP end, m.
        robot: Who walks.

    Returns:
        The plan of the CoM.

    Source: Abdolmaleki et al. 2016, Section 2.2.
    """
    duration = params.step_duration
    zmp = zmp_reference(_node_phases(params), start, support, end, params.double_support / duration)
    heights = com_heights(params, robot=robot)
    solve = jax.vmap(com_trajectory, in_axes=(1, None, None, 0, 0, None), out_axes=1)
    # Along x and, by Eq. 2 in place of Eq. 1, along y.
    com = solve(zmp, *heights, start, end, duration)  # Eq. 2
    return ComPlan(com, _end_velocities(com, zmp, heights, duration))


@checks.arguments
def plan_continuous_com(
    params: WalkParams,
    before: Float[Array, "2 2"],
    start: Float[Array, "2"],
    support: Float[Array, "2"],
    end: Float[Array, "2 2"],
    *,
    robot: Robot = NAO,
) -> ComPlan:
    """Plan the CoM of one step that continues the motion before it, see `continuous_com_trajectory`.

    Args:
        params: Walking parameters.
        before: Position (m) and velocity (m/s) of the CoM at the start of the step, a row for each of the
            two.
        start: Where the ZMP begins, the middle of the feet, m.
        support: Where the ZMP stays during the step, m.
        end: Position and velocity of the CoM from which the motion is to be continued after the step. The
            ZMP ends at this position.
        robot: Who walks.

    Returns:
        The plan of the CoM.
    """
    duration = params.step_duration
    shares = zmp_shares(_node_phases(params), params.double_support / duration)
    heights = com_heights(params, robot=robot)
    solve = jax.vmap(continuous_com_trajectory, in_axes=(1, None, None, None, 1, 1, None, 0), out_axes=1)
    zmp = shares @ jnp.stack([start, support, end[0]])
    largest = robot.size * jnp.asarray(LARGEST_SHIFT, zmp.dtype)
    com, shifted = solve(zmp, shares[:, 1], *heights, before, end, duration, largest)
    return ComPlan(com, _end_velocities(com, shifted, heights, duration))


def com_heights(params: WalkParams, *, robot: Robot = NAO) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Return height (m) and vertical acceleration (m/s^2) of the CoM at the nodes of a step."""
    phase = _node_phases(params)
    height, height_acc = spring_height(phase, params.hip_height, params.amplitude, params.step_duration)
    return height + (robot.ankle_height + robot.com_above_hip), height_acc


def _end_velocities(com: Array, zmp: Array, heights: tuple[Array, Array], duration: Scalar) -> Array:
    """Return the velocity of a CoM at the first and at the last node of a step."""
    velocities = jax.vmap(com_velocities, in_axes=(1, 1, None, None, None), out_axes=1)
    return velocities(com, zmp, *heights, duration)


def _node_phases(params: WalkParams) -> Float[Array, " n"]:
    """Return the phases of the nodes of a step, 0 to 1."""
    return jnp.linspace(0.0, 1.0, NUM_NODES, dtype=params.step_duration.dtype)
