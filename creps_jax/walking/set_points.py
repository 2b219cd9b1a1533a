"""Turn joint targets into set-points that joints of limited speed can follow."""

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax import checks
from creps_jax.robots.robot import NAO, Robot
from creps_jax.typing import Array, Float
from creps_jax.walking.engine import joint_targets, plan_walk
from creps_jax.walking.params import WalkParams, count_steps

__all__ = ["next_set_point", "open_loop_set_points"]


@checks.arguments
def next_set_point(
    set_point: Float[Array, "22"], target: Float[Array, "22"], period: float, *, robot: Robot = NAO
) -> Float[Array, "22"]:
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


@checks.arguments
def open_loop_set_points(
    params: WalkParams, *, duration: float, period: float, robot: Robot = NAO
) -> Float[Array, "n 22"]:
    """Plan the set-points of a walk for a robot that only plays them.

    They are those of a walk in which the trunk leans as intended at all times. Posture feedback (the gains
    gamma_tilt and gamma_roll, and `Balance`), which answers to the measured lean, is thus left out.

    Args:
        params: Walking parameters.
        duration: Length of the walk, s.
        period: Time from one set-point to the next, s.
        robot: Who walks.

    Returns:
        Set-points from standstill at time 0 to the end of the walk, one a period, in the order of
        `nao_geometry.JOINT_NAMES`, rad, within the joint limits.

    Raises:
        ValueError: If the walk is not as long as a period, or one of the two is not a positive number.
    """
    if not 0.0 < period <= duration:
        raise ValueError(f"period must be above 0 and at most duration, got {period} and {duration} s")
    plans = plan_walk(params, count_steps(duration), robot=robot)
    upright = jnp.stack([jnp.zeros_like(params.lean), params.lean, jnp.zeros_like(params.lean)])
    times = jnp.arange(round(duration / period) + 1, dtype=params.lean.dtype) * period
    targets = jax.vmap(lambda time: joint_targets(params, plans, time, upright, robot=robot))(times)

    def follow(set_point, target):
        set_point = next_set_point(set_point, target, period, robot=robot)
        return set_point, set_point

    return lax.scan(follow, targets[0], targets)[1]
