"""Discrete dynamic movement primitives (DMPs) for movements of joints."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax import checks
from creps_jax.typing import Array, Float

__all__ = ["DmpTrajectory", "dmp_trajectory", "fit_dmp"]

# Number of time constants of the critically damped attractor in one duration: the distance to the goal
# shrinks to 5e-5 of its first value.
_RATE = 12.5
# The phase falls from 1 to 0.01 over the duration, and the forcing with it.
_PHASE_DECAY = math.log(100.0)


class DmpTrajectory(NamedTuple):
    """A movement at equally spaced times, the end of each step (leading axis n).

    Attributes:
        pos: Position, in the units of start and goal (rad for joints).
        vel: Velocity, per second.
        acc: Acceleration, per second squared.
    """

    pos: Float[Array, "n d"]
    vel: Float[Array, "n d"]
    acc: Float[Array, "n d"]


@checks.arguments
def dmp_trajectory(
    weights: Float[Array, "b d"],
    start: Float[Array, " d"],
    goal: Float[Array, " d"],
    *,
    duration: float,
    num_steps: int,
) -> DmpTrajectory:
    """Move from rest at the start towards the goal, with one primitive for each coordinate.

    A primitive is a critically damped spring towards the goal, `T^2 y'' = a (a/4 (g + f(x) - y) - T y')`. The
    forcing term f displaces its rest position: the weighted sum of normalised Gaussian bases of the phase x,
    times x. The weights thus have the units of the goal. All primitives share the phase, which falls from 1
    to 0.01 in a duration. At its end the movement is nearly at rest, and its distance from the goal is at
    most about 0.025 times the last weights. Only times scale with the duration.

    Each step is the exact motion of the spring under the forcing at the middle of the step, so that steps may
    have any length.

    Args:
        weights: Weights of the bases, a column for each coordinate.
        start: Position at the start.
        goal: Position to rest at.
        duration: T, s.
        num_steps: Number of steps in a duration.

    Returns:
        The movement.

    Raises:
        ValueError: If there is no step or no basis, the duration is not positive, or shapes do not fit.

    Source: Ijspeert et al. 2013, Eq. 2.1 to 2.5, without scaling by the amplitude, which fails if start and
    goal are equal; the forcing is divided by the spring's stiffness.
    """
    checks.number("duration", duration, above=0.0)
    dtype = weights.dtype
    middles = (jnp.arange(num_steps, dtype=dtype) + 0.5) / num_steps
    rest = goal[None] + _forcing_bases(middles, weights.shape[0]) @ weights
    step_length = 1.0 / num_steps
    decay = math.exp(-_RATE * step_length)

    # The unit of time is the duration.
    def step(carry, rest):
        pos, vel = carry
        offset = pos - rest
        slope = vel + _RATE * offset
        offset = decay * (offset + slope * step_length)
        vel = decay * (vel - _RATE * slope * step_length)
        acc = -_RATE * (_RATE * offset + 2.0 * vel)
        return (rest + offset, vel), (rest + offset, vel, acc)

    start = start.astype(dtype)
    _, (pos, vel, acc) = lax.scan(step, (start, jnp.zeros_like(start)), rest)
    return DmpTrajectory(pos, vel / duration, acc / duration**2)


@checks.arguments
def fit_dmp(pos: Float[Array, "n d"], num_basis: int) -> Float[Array, "b d"]:
    """Fit weights to a demonstration that starts at rest, by least squares of the positions.

    A movement is linear in its weights, so the fit is one linear system, and needs no derivatives of the
    demonstration.

    Args:
        pos: Positions at equally spaced times; the first is the start and the last is the goal.
        num_basis: Number of bases.

    Returns:
        Weights for `dmp_trajectory` from the first to the last position of the demonstration.

    Raises:
        ValueError: If the demonstration has fewer steps than bases, or there is no basis.
    """
    if pos.shape[0] <= num_basis:
        raise ValueError(f"num_basis must be less than the {pos.shape[0]} positions of pos, got {num_basis}")
    num_steps = pos.shape[0] - 1

    def moved(weights, start, goal):
        return dmp_trajectory(weights, start, goal, duration=1.0, num_steps=num_steps).pos

    zero = jnp.zeros(1, pos.dtype)
    bases = jnp.eye(num_basis, dtype=pos.dtype)[..., None]
    responses = jax.vmap(moved, (0, None, None))(bases, zero, zero)[..., 0].T
    unforced = moved(jnp.zeros((num_basis, pos.shape[1]), pos.dtype), pos[0], pos[-1])
    return jnp.linalg.lstsq(responses, pos[1:] - unforced)[0]


def _forcing_bases(time: Float[Array, " n"], num_basis: int) -> Float[Array, "n b"]:
    """Return the normalised Gaussian bases of the phase, times the phase, at times in durations."""
    phase = jnp.exp(-_PHASE_DECAY * time)
    # Centres equally spaced in time, each basis as wide as the gap to the next.
    centers = jnp.exp(-_PHASE_DECAY * jnp.linspace(0.0, 1.0, num_basis, dtype=time.dtype))
    gaps = jnp.abs(jnp.diff(centers))
    widths = jnp.append(gaps, gaps[-1:]) if num_basis > 1 else jnp.ones(1, time.dtype)
    exponent = -0.5 * ((phase[:, None] - centers[None]) / widths[None]) ** 2
    return jax.nn.softmax(exponent, axis=1) * phase[:, None]
