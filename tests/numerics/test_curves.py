"""Bezier curves: end points, tangents, and the smooth step as one of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.numerics.curves import bezier, smooth_step

POINTS = jnp.array([[0.0, 1.0], [2.0, -1.0], [3.0, 4.0], [5.0, 0.5]])


def test_bezier_starts_and_ends_at_its_outer_points_along_their_neighbours():
    for phase, point, tangent in [
        (0.0, POINTS[0], 3.0 * (POINTS[1] - POINTS[0])),
        (1.0, POINTS[3], 3.0 * (POINTS[3] - POINTS[2])),
    ]:
        value, slope = jax.jvp(lambda s: bezier(POINTS, s), (jnp.float32(phase),), (jnp.float32(1.0),))
        np.testing.assert_allclose(value, point, atol=1e-6)
        np.testing.assert_allclose(slope, tangent, atol=1e-5)


def test_bezier_agrees_with_de_casteljau():
    for phase in (0.1, 0.5, 0.85):
        points = np.asarray(POINTS, np.float64)
        while len(points) > 1:
            points = (1.0 - phase) * points[:-1] + phase * points[1:]
        np.testing.assert_allclose(bezier(POINTS, jnp.float32(phase)), points[0], atol=1e-6)


def test_smooth_step_is_the_bezier_curve_of_doubled_ends():
    ends = jnp.array([[0.0], [0.0], [1.0], [1.0]])
    for phase in np.linspace(0.0, 1.0, 7, dtype=np.float32):
        np.testing.assert_allclose(
            smooth_step(jnp.asarray(phase)), bezier(ends, jnp.asarray(phase))[0], atol=1e-6
        )
    assert smooth_step(jnp.float32(-1.0)) == 0.0
    assert smooth_step(jnp.float32(2.0)) == 1.0


def test_bezier_without_points_is_an_error():
    with pytest.raises(ValueError, match=r"control_points must be at least one point, got shape \(0, 2\)"):
        bezier(jnp.zeros((0, 2)), jnp.float32(0.5))
