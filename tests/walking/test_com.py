"""The CoM plan: its ZMP is the reference, its signs are those of Eq. 1, and a dense solve agrees."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.robots.robot import GRAVITY
from creps_jax.walking.com import com_trajectory, spring_height, zmp_of_com
from creps_jax.walking.zmp import zmp_reference

NUM_NODES = 33
PHASE = jnp.linspace(0.0, 1.0, NUM_NODES)


def sideways_zmp(double_support_share):
    support, middle = jnp.array([0.0, 0.055]), jnp.zeros(2)
    return zmp_reference(PHASE, middle, support, middle, jnp.float32(double_support_share))[:, 1]


@pytest.mark.parametrize("duration", [0.14, 0.24, 0.4, 3.0])
@pytest.mark.parametrize("amplitude_share", [0.0, 0.5])
def test_com_gives_its_zmp_back(duration, amplitude_share):
    amplitude = amplitude_share * GRAVITY * duration**2 / (4 * math.pi**2)
    amplitude = min(amplitude, 0.03)
    height, height_acc = spring_height(
        PHASE, jnp.float32(0.26), jnp.float32(amplitude), jnp.float32(duration)
    )
    zmp = sideways_zmp(0.2)
    com = com_trajectory(zmp, height, height_acc, 0.0, 0.0, duration)
    given_back = zmp_of_com(com, height, height_acc, duration)
    # The second difference of a float32 position is divided by the square of the sampling period.
    stiffness = float(jnp.max(height / (GRAVITY + height_acc))) * ((NUM_NODES - 1) / duration) ** 2
    np.testing.assert_allclose(given_back, zmp[1:-1], atol=1e-7 * (1.0 + stiffness))


def test_com_agrees_with_a_dense_solve_of_the_zmp_equation():
    duration = 0.3
    height, height_acc = spring_height(PHASE, jnp.float32(0.26), jnp.float32(0.01), jnp.float32(duration))
    zmp = sideways_zmp(0.1)
    # x - z x'' / (g + z'') at the inner nodes, the ends given: in float64, with x'' as a matrix.
    z, acc = np.asarray(height, np.float64), np.asarray(height_acc, np.float64)
    period = duration / (NUM_NODES - 1)
    matrix = np.eye(NUM_NODES)
    for k in range(1, NUM_NODES - 1):
        matrix[k, k - 1 : k + 2] -= z[k] / (9.81 + acc[k]) / period**2 * np.array([1.0, -2.0, 1.0])
    rhs = np.asarray(zmp, np.float64)
    rhs[0], rhs[-1] = 0.01, -0.02
    com = com_trajectory(zmp, height, height_acc, 0.01, -0.02, duration)
    np.testing.assert_allclose(com, np.linalg.solve(matrix, rhs), atol=2e-6)


@pytest.mark.parametrize(
    ("duration", "amplitude", "sway"),
    [
        (0.16, 0.0, 0.0059),
        (0.20, 0.0, 0.0088),
        (0.24, 0.0, 0.0120),
        (0.40, 0.0, 0.0250),
        (0.24, 0.01, 0.0147),
    ],
)
def test_sway_is_that_of_a_pendulum_with_the_right_sign(duration, amplitude, sway):
    # Computed apart for a height of 0.265 m and feet at +-0.055 m; with g - z'' the last one would be 0.0091.
    height, height_acc = spring_height(
        PHASE, jnp.float32(0.265), jnp.float32(amplitude), jnp.float32(duration)
    )
    com = com_trajectory(sideways_zmp(0.0), height, height_acc, 0.0, 0.0, duration)
    np.testing.assert_allclose(jnp.max(com), sway, atol=2e-4)


def test_spring_acceleration_is_the_second_derivative_of_its_height():
    def height(time):
        return spring_height(time / 0.3, jnp.float32(0.2), jnp.float32(0.01), jnp.float32(0.3))[0]

    for time in (0.0, 0.07, 0.2):
        derivative = jax.grad(jax.grad(height))(jnp.float32(time))
        acceleration = spring_height(
            jnp.float32(time) / 0.3, jnp.float32(0.2), jnp.float32(0.01), jnp.float32(0.3)
        )[1]
        np.testing.assert_allclose(derivative, acceleration, rtol=1e-4, atol=1e-4)


def test_zmp_rests_on_the_support_foot_and_meets_the_middles():
    start, support, end = jnp.array([0.0, 0.0]), jnp.array([0.02, 0.055]), jnp.array([0.04, 0.0])
    zmp = zmp_reference(PHASE, start, support, end, jnp.float32(0.4))
    np.testing.assert_allclose(zmp[0], start, atol=1e-7)
    np.testing.assert_allclose(zmp[-1], end, atol=1e-7)
    resting = (PHASE >= 0.2) & (PHASE <= 0.8)
    np.testing.assert_allclose(zmp[resting], jnp.broadcast_to(support, (int(resting.sum()), 2)), atol=1e-6)
    half_way = jnp.interp(0.1, PHASE, zmp[:, 1])
    np.testing.assert_allclose(half_way, 0.0275, atol=1e-3)


def test_without_double_support_the_zmp_is_finite():
    assert jnp.isfinite(sideways_zmp(0.0)).all()


def test_shapes_that_differ_are_an_error():
    with pytest.raises(ValueError, match=r"com_height_acc must have shape \(33,\) .*, got \(32,\)"):
        com_trajectory(PHASE, PHASE, PHASE[1:], 0.0, 0.0, 0.3)
