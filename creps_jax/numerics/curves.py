"""Evaluate Bezier curves."""

import math

import jax.numpy as jnp

from creps_jax.typing import Array, Float, Scalar

__all__ = ["bezier", "smooth_step"]


def bezier(control_points: Float[Array, "k d"], phase: Scalar) -> Float[Array, " d"]:
    """Evaluate the Bezier curve of control points at a phase.

    Args:
        control_points: k points, one in each row; four make a cubic curve.
        phase: Position on the curve, 0 at the first point and 1 at the last.

    Returns:
        The point on the curve.

    Raises:
        ValueError: If there is no control point.

    Source: Bernstein form, `B(s) = sum_j C(n, j) s^j (1 - s)^(n - j) P_j`.
    """
    degree = control_points.shape[0] - 1
    if degree < 0:
        raise ValueError(f"control_points must be at least one point, got shape {control_points.shape}")
    weights = [math.comb(degree, j) * phase**j * (1.0 - phase) ** (degree - j) for j in range(degree + 1)]
    return jnp.stack(weights) @ control_points


def smooth_step(phase: Scalar) -> Scalar:
    """Rise from 0 to 1 along the cubic Bezier curve that starts and ends at rest.

    It is the curve of the control values 0, 0, 1, 1. Phases below 0 give 0, phases above 1 give 1.
    """
    phase = jnp.clip(phase, 0.0, 1.0)
    return phase * phase * (3.0 - 2.0 * phase)
