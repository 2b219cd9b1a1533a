"""Move the swing foot along cubic Bezier curves."""

import jax.numpy as jnp

from creps_jax import checks
from creps_jax.numerics.curves import bezier, smooth_step
from creps_jax.typing import Array, Float, Scalar

__all__ = ["swing_pose"]


@checks.arguments
def swing_pose(
    start: Float[Array, "3"], end: Float[Array, "3"], height: Scalar, phase: Scalar
) -> tuple[Float[Array, "3"], Scalar]:
    """Return the planar pose and the height of the swing foot.

    The foot leaves and reaches the floor at rest: the planar pose is a cubic Bezier curve with doubled
    end points, the height two such curves, one up and one down.

    Args:
        start: Planar pose (x, y, yaw) at the start of the swing, m and rad.
        end: Planar pose at its end.
        height: Height in the middle of the swing, m.
        phase: Progress of the swing, 0 to 1; held at the ends outside.

    Returns:
        Planar pose (x, y, yaw) and height above the floor, m.

    Source: Abdolmaleki et al. 2016, Section 2.1, Swing Foot Trajectory Generator.
    """
    phase = jnp.clip(phase, 0.0, 1.0)
    pose = bezier(jnp.stack([start, start, end, end]), phase)
    # 1 - |2 phase - 1| rises from 0 to 1 and falls back.
    return pose, height * smooth_step(1.0 - jnp.abs(2.0 * phase - 1.0))
