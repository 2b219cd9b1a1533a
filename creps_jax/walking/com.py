"""Plan the centre of mass of one step from its ZMP reference: a spring-mass pendulum, solved at once."""

import math

import jax.numpy as jnp

from creps_jax import checks
from creps_jax.numerics.linalg import thomas_solve
from creps_jax.robots.robot import GRAVITY
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["com_trajectory", "com_velocities", "continuous_com_trajectory", "spring_height", "zmp_of_com"]


@checks.arguments
def spring_height(
    phase: Float[Array, "*n"], rest_height: Scalar, amplitude: Scalar, duration: Scalar
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Return height and vertical acceleration of the mass on the spring.

    Args:
        phase: Time over the duration of a step, t/T.
        rest_height: Rest height x0, m.
        amplitude: Amplitude A, m.
        duration: Duration T of a step, one oscillation, s.

    Returns:
        Height in m and acceleration in m/s^2.

    Source: Abdolmaleki et al. 2016, Eq. 3 and 4 with phi = 0.
    """
    oscillation = amplitude * jnp.cos(2.0 * math.pi * phase)
    omega = 2.0 * math.pi / duration
    height = rest_height + oscillation  # Eq. 3
    return height, -(omega**2) * oscillation  # Eq. 4


def _neighbour_weight(com_height, com_height_acc, duration):
    """a(k) = c(k) of Eq. 6, with `g + z''` and the sampling period squared: see Eq. 1 and 5."""
    period = duration / (com_height.shape[0] - 1)
    # In print: a(k) = c(k) = -z / ((g - z'') T^2)
    return -com_height / ((GRAVITY + com_height_acc) * period**2)  # Eq. 6


@checks.arguments
def com_trajectory(
    zmp: Float[Array, " n"],
    com_height: Float[Array, " n"],
    com_height_acc: Float[Array, " n"],
    start: ScalarLike,
    end: ScalarLike,
    duration: ScalarLike,
) -> Float[Array, " n"]:
    """Find the horizontal CoM trajectory whose ZMP is the reference, between two given ends.

    The n nodes are equally spaced over the step, the first and last of them at its ends.

    Args:
        zmp: ZMP reference along one horizontal axis, m. Its two end values are not used.
        com_height: CoM height above the floor, m; positive.
        com_height_acc: Vertical CoM acceleration, m/s^2; greater than -g everywhere.
        start: CoM position at the first node, m.
        end: CoM position at the last node, m.
        duration: Duration of the step, s.

    Returns:
        CoM position at the nodes, m.

    Raises:
        ValueError: If there are fewer than three nodes or the shapes differ, or a number is out of its range.

    Source: Abdolmaleki et al. 2016, Eq. 1, 5-9, with the signs of Eq. 1.
    """
    if len(zmp) < 3:
        raise ValueError(f"zmp must have three nodes or more, got {len(zmp)}")
    checks.finite("com_height", com_height, above=0.0)
    checks.finite("com_height_acc", com_height_acc, above=-GRAVITY)
    checks.number("duration", duration, above=0.0)
    weight = _neighbour_weight(com_height, com_height_acc, duration)
    # First and last row, the cases k = 1 and k = n of the print, say x(1) = start and x(n) = end.
    inner = jnp.ones_like(zmp).at[jnp.array([0, -1])].set(0.0)
    neighbour = weight * inner  # Eq. 7
    rhs = zmp.at[0].set(start)  # Eq. 8
    rhs = rhs.at[-1].set(end)  # Eq. 9
    checks.finite("zmp", rhs)
    return thomas_solve(neighbour, 1.0 - 2.0 * neighbour, neighbour, rhs)  # Eq. 6


@checks.arguments
def zmp_of_com(
    com: Float[Array, " n"],
    com_height: Float[Array, " n"],
    com_height_acc: Float[Array, " n"],
    duration: ScalarLike,
) -> Float[Array, " n-2"]:
    """Return the ZMP of a CoM trajectory at its inner nodes (Abdolmaleki et al. 2016, Eq. 1 and 5)."""
    weight = _neighbour_weight(com_height, com_height_acc, duration)[1:-1]
    # In print: x_ZMP = x - x'' z / (g + z'')
    difference = com[:-2] - 2.0 * com[1:-1] + com[2:]  # Eq. 5
    return com[1:-1] + weight * difference  # Eq. 1


def com_velocities(
    com: Float[Array, " n"],
    zmp: Float[Array, " n"],
    com_height: Float[Array, " n"],
    com_height_acc: Float[Array, " n"],
    duration: ScalarLike,
) -> Float[Array, "2"]:
    """Return the velocity of a CoM trajectory at its first and its last node.

    The velocities are those for which Eq. 1 holds at these two nodes as well, so that a trajectory that
    begins with the last velocity of another one continues it.

    Args:
        com: CoM position at the nodes along one horizontal axis, m.
        zmp: ZMP at the nodes, m.
        com_height: CoM height, m.
        com_height_acc: Vertical CoM acceleration, m/s^2.
        duration: Duration of the step, s.

    Returns:
        First and last velocity, m/s.
    """
    period = duration / (com.shape[0] - 1)
    ends = jnp.array([0, -1])
    acceleration = _pendulum_rate(com_height, com_height_acc)[ends] * (com - zmp)[ends]
    first, last = (com[1] - com[0]) / period, (com[-1] - com[-2]) / period
    half = 0.5 * period * acceleration
    return jnp.stack([first - half[0], last + half[1]])


def continuous_com_trajectory(
    zmp: Float[Array, " n"],
    shift_shape: Float[Array, " n"],
    com_height: Float[Array, " n"],
    com_height_acc: Float[Array, " n"],
    start: Float[Array, "2"],
    end: Float[Array, "2"],
    duration: ScalarLike,
    largest_shift: ScalarLike,
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Find the CoM trajectory that continues a given position and velocity, and can be continued itself.

    The motion of the pendulum has a part that decays and a part that grows, the divergent component
    `x + x' / omega`. The trajectory begins with the position and velocity of `start`, and its divergent
    component ends where that of `end` is; the decaying part takes care of itself. These are three conditions
    for an equation of second order. The third is met by a shift of the ZMP reference along `shift_shape`.

    Args:
        zmp: ZMP reference along one horizontal axis, m.
        shift_shape: How much of the shift each node gets, 0 to 1; 0 at the last node.
        com_height: CoM height above the floor, m; positive.
        com_height_acc: Vertical CoM acceleration, m/s^2; greater than -g everywhere.
        start: CoM position (m) and velocity (m/s) at the first node.
        end: Position and velocity whose divergent component is to be reached at the last node.
        duration: Duration of the step, s.
        largest_shift: Limit of the shift, m. Where it is reached, the velocity is not continuous.

    Returns:
        CoM position at the nodes, and the ZMP that belongs to it, m.

    Source: Abdolmaleki et al. 2016, Eq. 1 and 5; Englsberger, Ott and Albu-Schaeffer 2015, Three-dimensional
    bipedal walking control based on divergent component of motion, for the condition at the end.
    """
    period = duration / (zmp.shape[0] - 1)
    step = period * jnp.sqrt(_pendulum_rate(com_height, com_height_acc)[-1])  # omega times the period
    weight = _neighbour_weight(com_height, com_height_acc, duration)
    upper = weight.at[jnp.array([0, -1])].set(0.0)
    # Last row: x + x' / omega with the last velocity of `com_velocities`.
    lower = upper.at[-1].set(-1.0 / step)
    diag = (1.0 - 2.0 * upper).at[-1].set(1.0 + 1.0 / step + 0.5 * step)

    def solve(reference, position, divergent):
        rhs = reference.at[0].set(position).at[-1].set(divergent + 0.5 * step * reference[-1])
        return thomas_solve(lower, diag, upper, rhs)

    def first_velocity(com, reference):
        return com_velocities(com, reference, com_height, com_height_acc, duration)[0]

    planned = solve(zmp, start[0], end[0] + end[1] * period / step)
    change = solve(shift_shape, 0.0, 0.0)
    shift = (start[1] - first_velocity(planned, zmp)) / first_velocity(change, shift_shape)
    shift = jnp.clip(shift, -largest_shift, largest_shift)
    return planned + shift * change, zmp + shift * shift_shape


def _pendulum_rate(com_height, com_height_acc):
    """Return omega^2 of the pendulum, 1/s^2: the horizontal acceleration for each metre from the ZMP."""
    return (GRAVITY + com_height_acc) / com_height
