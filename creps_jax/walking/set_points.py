"""Turn joint targets into set-points that joints of limited speed can follow."""

import jax.numpy as jnp

from creps_jax import checks
from creps_jax.robots.robot import NAO, Robot
from creps_jax.typing import Array, Float

__all__ = ["next_set_point"]


@checks.arguments
def next_set_point(
    set_point: Float[Array, " nu"], target: Float[Array, " nu"], period: float, *, robot: Robot = NAO
) -> Float[Array, " nu"]:
    """Move a set-point towards its target, no faster than the joints can turn.

    Args:
        set_point: The last set-point, rad.
        target: Where the joints shall be, rad.
        period: Time from one set-point to the next, s.
        robot: Whose joints.

    Returns:
        The set-point one period later, rad.
    """
    farthest = jnp.asarray([speed * period for speed in robot.max_joint_speed], target.dtype)
    return set_point + jnp.clip(target - set_point, -farthest, farthest)
