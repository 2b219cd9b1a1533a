"""Move joints by discrete dynamic movement primitives."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax import checks
from creps_jax.typing import Array, Float

__all__ = ["DmpTrajectory", "dmp_trajectory", "fit_dmp"]

# The attractor is critically damped. Time constants of it that go by in one duration: a distance between
# start and goal shrinks to 5e-5 of it.
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
    """Move from rest at the start towards the goal, each coordinate by a primitive of its own.

    A primitive is a critically damped spring towards the goal, `T^2 y'' = a (a/4 (g + f(x) - y) - T y')`,
    whose rest position a forcing term f moves about: normalised Gaussian bases of the phase x, weighted,
    times x. The weights are thus in the units of the goal. The phase, one for all, falls from 1 to 0.01 in
    a duration: there the movement is within some 0.025 of the last weights of its goal, and nearly at rest.
    Times scale with the duration, and nothing else does.

    Each step is the spring's exact motion under the forcing in its middle: no step is too long.

    Args:
        weights: Weights of the bases, a column for each coordinate.
        start: Position at the start.
        goal: Position to rest at.
        duration: T, s.
        num_steps: Steps in a duration.

    Returns:
        The movement.

    Raises:
        ValueError: If there is no step or no basis, the duration is not positive, or shapes do not fit.

    Source: Ijspeert et al. 2013, Eq. 2.1 to 2.5, without scaling by the amplitude, which fails where start
    and goal are equal; the forcing is divided by the spring's stiffness.
    """
    checks.number("duration", duration, above=0.0)
    dtype = weights.dtype
    middles = (jnp.arange(num_steps, dtype=dtype) + 0.5) / num_steps
    rest = goal[None] + _forcing_bases(middles, weights.shape[0]) @ weights
    step_length = 1.0 / num_steps
    decay = math.exp(-_RATE * step_length)

    # In here time is counted in durations.
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

    A movement is linear in its weights, so this is one linear system; no derivatives are taken of the
    demonstration.

    Args:
        pos: Positions at equally spaced times; the first is the start and the last is the goal.
        num_basis: Number of bases.

    Returns:
        Weights for `dmp_trajectory` with the demonstration's first and last position.

    Raises:
        ValueError: If the demonstration has fewer steps than there are bases, or there is no basis.
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
