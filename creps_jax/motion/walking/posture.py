"""Keep the trunk at its intended lean by turning the feet against the measured one."""

import jax.numpy as jnp

from creps_jax.typing import Array, Float, Scalar

__all__ = ["corrected_lean"]

# A robot that leans further than this has fallen; the correction stays finite.
_MAX_MEASURED = 0.8


def corrected_lean(
    intended: Float[Array, "2"], measured: Float[Array, "2"], roll_gain: Scalar, tilt_gain: Scalar
) -> Float[Array, "2"]:
    """Return the roll and pitch of the trunk for which the legs are to be posed.

    With gain 0 the legs are posed for the trunk as measured: the feet stay level with the floor and
    nothing pushes back. With gain 1 they are posed as if the trunk stood as intended: a tilted robot
    presses the edge of its feet into the floor.

    Args:
        intended: Intended roll and pitch, rad.
        measured: Measured roll and pitch, rad.
        roll_gain: gamma_roll, share of the roll error that is corrected.
        tilt_gain: gamma_tilt, share of the pitch error that is corrected.

    Returns:
        Roll and pitch, rad.

    Source: Abdolmaleki et al. 2016, Section 2.1, Robot Posture Controller; Glaser and Dorer 2013.
    """
    measured = jnp.clip(measured, -_MAX_MEASURED, _MAX_MEASURED)
    gains = jnp.stack([roll_gain, tilt_gain])
    return measured + gains * (intended - measured)
