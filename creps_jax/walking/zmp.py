"""Plan the reference of the zero moment point over one step."""

import jax.numpy as jnp

from creps_jax import checks
from creps_jax.typing import Array, Float, Scalar

__all__ = ["zmp_reference", "zmp_shares"]


@checks.arguments
def zmp_reference(
    phase: Float[Array, " n"],
    start: Float[Array, "2"],
    support: Float[Array, "2"],
    end: Float[Array, "2"],
    double_support_share: Scalar,
) -> Float[Array, "n 2"]:
    """Move the ZMP to the support foot, hold it there, and move it on to the next middle of the feet.

    Half of the double support lies at each end of the step, so that two steps share one double support.

    Args:
        phase: Time over the duration of the step, t/T.
        start: Middle of the feet at the start of the step, m.
        support: Centre of the support foot, m.
        end: Middle of the feet at the end of the step, m.
        double_support_share: Part of the step that is double support, 0 to 1.

    Returns:
        ZMP reference, m.

    Source: Abdolmaleki et al. 2016, Section 2.2.
    """
    return zmp_shares(phase, double_support_share) @ jnp.stack([start, support, end])


def zmp_shares(phase: Float[Array, " n"], double_support_share: Scalar) -> Float[Array, "n 3"]:
    """Return the shares of start, support foot and end in the ZMP reference; see `zmp_reference`.

    Args:
        phase: Time over the duration of the step, t/T.
        double_support_share: Part of the step that is double support, 0 to 1.

    Returns:
        The shares, which sum to one in each row.
    """
    half = jnp.maximum(0.5 * double_support_share, 1e-6)
    away_from_start = jnp.clip(phase / half, 0.0, 1.0)
    towards_end = jnp.clip((phase - (1.0 - half)) / half, 0.0, 1.0)
    return jnp.stack([1.0 - away_from_start, away_from_start - towards_end, towards_end], axis=1)
