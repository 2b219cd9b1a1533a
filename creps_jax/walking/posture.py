"""Keep the robot upright: turn the feet against the measured lean, place them where it falls to."""

from typing import NamedTuple

import jax.numpy as jnp

from creps_jax import checks
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["Balance", "Tilt", "corrected_lean", "filter_memory", "next_tilt"]

# A robot that leans further than this has fallen; the correction stays finite.
MAX_MEASURED = 0.8


class Balance(NamedTuple):
    """How steps answer to the measured orientation of the trunk; by default, as in the paper, not at all.

    Attributes:
        heading_gain: Share of the heading error that one step turns back.
        placement_gain: Share of the way by which a sideways tilt carries the hips out, that a landing foot is
            put out to the same side. The present tilt counts, filtered. The swing foot is put
            out by a part of the share that grows to all of it; the other foot keeps what is left of its own
            while the body is carried over.
        filter_time: Time constant of the filter for the measured roll and pitch, s, see `next_tilt`; 0 for
            no filter.
        forward_placement_gain: The same share as `placement_gain`, forwards: a landing foot is put ahead of a
            trunk that leans farther forward than intended, and behind one that leans back. A robot whose feet
            are short for its legs needs it.
    """

    heading_gain: ScalarLike = 0.0
    placement_gain: ScalarLike = 0.0
    filter_time: ScalarLike = 0.0
    forward_placement_gain: ScalarLike = 0.0


class Tilt(NamedTuple):
    """The roll and pitch of the trunk, estimated from noisy measurements.

    Attributes:
        angle: Roll and pitch, rad.
        rate: Their rates of change, rad/s.
    """

    angle: Float[Array, "2"]
    rate: Float[Array, "2"]


def filter_memory(period: ScalarLike, filter_time: ScalarLike) -> Scalar:
    """Return by which factor the weight of a measurement falls in one period."""
    return jnp.exp(-period / jnp.maximum(jnp.asarray(filter_time, jnp.float32), 1e-6))


def next_tilt(tilt: Tilt, measured: Float[Array, "2"], period: ScalarLike, filter_time: ScalarLike) -> Tilt:
    """Update the estimate of the tilt with a measurement.

    The filter is a line fitted to all measurements so far, whose weights fall exponentially with their age:
    it has no lag while the tilt changes at a constant rate. Measurements are clipped to 0.8 rad, so that a
    wrong one is soon forgotten.

    Args:
        tilt: The estimate one period ago.
        measured: Measured roll and pitch, rad.
        period: Time between two measurements, s.
        filter_time: Time in which a weight falls to 1/e, s; at 0 the angle is the measured one.

    Returns:
        The estimate at the time of the measurement.

    Source: Morrison 1969, Introduction to sequential smoothing and prediction, the fading-memory polynomial
    filter of degree 1.
    """
    memory = filter_memory(period, filter_time).astype(measured.dtype)
    measured = jnp.clip(measured, -MAX_MEASURED, MAX_MEASURED)
    surprise = measured - (tilt.angle + period * tilt.rate)
    return Tilt(measured - memory**2 * surprise, tilt.rate + (1.0 - memory) ** 2 / period * surprise)


@checks.arguments
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
    measured = jnp.clip(measured, -MAX_MEASURED, MAX_MEASURED)
    gains = jnp.stack([roll_gain, tilt_gain])
    return measured + gains * (intended - measured)
