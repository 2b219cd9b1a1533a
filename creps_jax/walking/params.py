"""Name the ten walking parameters with units and bounds, and make them safe to plan with."""

import math
from typing import NamedTuple

import jax.numpy as jnp

from creps_jax import checks
from creps_jax.robots.robot import GRAVITY, NAO, Robot
from creps_jax.typing import Array, Float, Scalar

__all__ = [
    "AUTHOR_BOUNDS",
    "HUMANOID_BOUNDS",
    "NAO_BOUNDS",
    "NAO_H25_BOUNDS",
    "NAO_STEERED_BOUNDS",
    "PAPER_BOUNDS",
    "PARAM_LABELS",
    "PARAM_NAMES",
    "PARAM_UNITS",
    "STEERED_PARAM_NAMES",
    "STEERED_PARAM_UNITS",
    "WalkParams",
    "humanoid_bounds",
    "params_from_theta",
    "scaled_bounds",
]

Bounds = tuple[tuple[float, ...], tuple[float, ...]]

PARAM_NAMES = (
    "amplitude",
    "hip_height",
    "swing_height",
    "step_duration",
    "lean",
    "tilt_gain",
    "roll_gain",
    "step_length",
    "double_support",
    "step_growth",
)
"""Names of the parameters, the fields of `WalkParams`, in the paper's order (Table 1)."""

PARAM_LABELS = (
    "A",
    "x0",
    "z_step",
    "T",
    "r_offset",
    "gamma_tilt",
    "gamma_roll",
    "x_step",
    "phi_DSP",
    "sigma_step",
)
"""The paper's symbols for the parameters."""

PARAM_UNITS = ("m", "m", "m", "s", "deg", "", "", "m", "s", "m/s")
"""Units of the parameters in theta; gains have none."""

PAPER_BOUNDS = (
    (0.0, 0.16, 0.02, 0.1, 0.0, 0.0, 0.0, 0.05, 0.0, 0.0),
    (1.0, 0.22, 0.15, 3.0, 5.0, 1.0, 1.0, 0.5, 1.0, 0.5),
)
"""Lower and upper bounds of theta, as the paper prints them (Section 4.3.1)."""

AUTHOR_BOUNDS = (
    (0.0, 0.16, 0.02, 0.01, 0.0, 0.0, 0.0, 0.02, 0.0, 0.0),
    (0.01, 0.22, 0.2, 1.8, 5.0, 1.0, 1.0, 0.4, 0.5, 0.2),
)
"""Bounds of theta in the experiment scripts that the paper's author published, with the amplitude limited to
0.01 m, as in `NAO_BOUNDS`: the scripts let it go to 1 m."""

NAO_BOUNDS = (
    (0.0, 0.15, 0.02, 0.14, -5.0, 0.0, 0.0, 0.0, 0.0, 0.02),
    (0.01, 0.20, 0.06, 0.40, 5.0, 1.0, 1.0, 0.15, 0.1, 0.2),
)
"""Bounds in which a NAO can walk at all: part of `PAPER_BOUNDS`, with room for slow walking (step length from
0) and leaning back."""

NAO_H25_BOUNDS = (
    (0.0, 0.15, 0.015, 0.18, -5.0, 0.0, 0.0, 0.0, 0.0, 0.02),
    (0.01, 0.19, 0.05, 0.40, 5.0, 1.0, 1.0, 0.10, 0.1, 0.2),
)
"""Bounds in which the real NAO, whose legs are shorter and weaker, can walk."""

HUMANOID_BOUNDS = (
    (0.0, 0.15, 0.02, 0.13, -5.0, 0.3, 0.0, 0.0, 0.0, 0.02),
    (0.001, 0.195, 0.05, 0.28, 5.0, 1.0, 1.0, 0.15, 0.06, 0.2),
)
"""Bounds in which a humanoid with small feet or weak motors can walk, for a leg of the NAO's length.

Of random gaits of a Booster T1 half stay up within them, and a tenth within `NAO_BOUNDS`: the oscillation of
the height costs torque that the hips do not have.
"""

STEERED_PARAM_NAMES = (*PARAM_NAMES, "step_side", "step_turn")
"""Names of the parameters of a steered walk: the ten, and a step's displacement to the left and turn."""

STEERED_PARAM_UNITS = (*PARAM_UNITS, "m", "rad")
"""Their units in theta."""

NAO_STEERED_BOUNDS = (
    (0.0, 0.15, 0.02, 0.14, -5.0, 0.0, 0.0, -0.12, 0.0, 0.02, -0.08, -0.5),
    (0.01, 0.20, 0.06, 0.40, 5.0, 1.0, 1.0, 0.15, 0.1, 0.2, 0.08, 0.5),
)
"""Bounds of a NAO's steered walk: `NAO_BOUNDS`, with steps backward, sideways and turning."""

# What the engine accepts of a NAO, whatever theta says. Within it every plan is finite.
SAFE_LOW = (0.0, 0.10, 0.0, 0.08, -30.0, -1.0, -1.0, -0.2, 0.0, 0.0)
SAFE_HIGH = (1.0, 0.22, 0.15, 4.0, 30.0, 2.0, 2.0, 0.2, 4.0, 10.0)
# Amplitude at which the spring's acceleration would reach that of gravity is A = g T^2 / (4 pi^2): there
# the ZMP equation is singular. Share of it that is allowed.
MAX_AMPLITUDE_SHARE = 0.6
# And in any case, for a NAO, m.
MAX_AMPLITUDE = 0.05
# Share of a step that double support may fill; the swing foot needs the rest.
MAX_DOUBLE_SUPPORT_SHARE = 0.6


class WalkParams(NamedTuple):
    """Settings of the walking engine, in SI units, safe to plan with.

    Attributes:
        amplitude: A, oscillation amplitude of the spring, m.
        hip_height: x0, rest height of the hip above the ankle, m.
        swing_height: z_step, greatest height of the swing foot above the floor, m.
        step_duration: T, duration of one step, s.
        lean: r_offset, forward lean (pitch) of the trunk, rad.
        tilt_gain: gamma_tilt, share of the pitch error that is corrected.
        roll_gain: gamma_roll, share of the roll error that is corrected.
        step_length: x_step, forward displacement of the CoM in one step, m.
        double_support: phi_DSP, part of a step during which both feet stand, s.
        step_growth: sigma_step, rate at which the step length grows from standstill, m/s.

    Source: Abdolmaleki et al. 2016, Table 1.
    """

    amplitude: Scalar
    hip_height: Scalar
    swing_height: Scalar
    step_duration: Scalar
    lean: Scalar
    tilt_gain: Scalar
    roll_gain: Scalar
    step_length: Scalar
    double_support: Scalar
    step_growth: Scalar


@checks.arguments
def scaled_bounds(robot: Robot, bounds: Bounds = NAO_BOUNDS) -> Bounds:
    """Return bounds of the ten parameters of a NAO, scaled to another robot.

    Lengths scale with the leg, times with the root of its length: the walk has the same Froude number.

    Args:
        robot: The robot.
        bounds: Lower and upper bounds for the simulated NAO.
    """
    return tuple(  # type: ignore[return-value]
        tuple(value * factor for value, factor in zip(bound, scales(robot), strict=True)) for bound in bounds
    )


@checks.arguments
def humanoid_bounds(robot: Robot) -> Bounds:
    """Return the bounds in which a humanoid learns to walk, scaled to its leg."""
    return scaled_bounds(robot, HUMANOID_BOUNDS)


def scales(robot: Robot) -> tuple[float, ...]:
    """Return the factor from each of the ten parameters of the simulated NAO to that of a robot."""
    factors = {"m": robot.size, "s": math.sqrt(robot.size), "m/s": math.sqrt(robot.size)}
    return tuple(factors.get(unit, 1.0) for unit in PARAM_UNITS)


@checks.arguments
def params_from_theta(theta: Float[Array, "10"], *, robot: Robot = NAO) -> WalkParams:
    """Turn a parameter vector in the paper's order and units into settings that the engine can plan with.

    Any finite theta is accepted: each entry is limited to what gives a finite plan. The amplitude is
    limited to a share of `g T^2 / (4 pi^2)`, where the ZMP equation turns singular, and double support to
    a share of the step.

    Args:
        theta: Parameters in the order of `PARAM_NAMES` and the units of `PARAM_UNITS` (the lean in degrees).
        robot: Who walks; the limits scale with its leg.

    Returns:
        The settings, in SI units.

    Raises:
        ValueError: If theta has not one entry for each parameter.
    """
    low, high = (jnp.asarray(bound, theta.dtype) for bound in scaled_bounds(robot, (SAFE_LOW, SAFE_HIGH)))
    safe = jnp.clip(theta, low, high)
    params = WalkParams(*safe)
    duration = params.step_duration
    singular = GRAVITY * duration**2 / (4.0 * math.pi**2)
    highest = jnp.minimum(MAX_AMPLITUDE_SHARE * singular, robot.size * MAX_AMPLITUDE)
    return params._replace(
        amplitude=jnp.minimum(params.amplitude, highest),
        lean=params.lean * (math.pi / 180.0),
        double_support=jnp.minimum(params.double_support, MAX_DOUBLE_SUPPORT_SHARE * duration),
    )
