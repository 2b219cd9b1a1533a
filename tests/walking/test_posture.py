"""The filter of the measured tilt: exact for steady motion, and quieter than what is measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from creps_jax.walking.posture import Tilt, next_tilt

PERIOD = 0.02


def filtered(measured, filter_time, period=PERIOD):
    """Return the estimates (n, 2) after each of the measurements (n, 2)."""
    zero = jnp.zeros(2)

    def update(tilt, now):
        tilt = next_tilt(tilt, now, period, filter_time)
        return tilt, tilt

    return jax.jit(lambda measured: lax.scan(update, Tilt(zero, zero), measured)[1])(jnp.asarray(measured))


def test_without_filter_time_the_angle_is_the_measured_one():
    measured = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 2)).astype(np.float32)
    np.testing.assert_array_equal(filtered(measured, 0.0).angle, measured)


@pytest.mark.parametrize("period", [0.01, 0.02])
def test_a_tilt_that_changes_at_a_constant_rate_is_found_without_lag(period):
    measured = np.outer(np.arange(200) * period, [0.1, -0.2]).astype(np.float32)
    tilt = filtered(measured, 0.06, period)
    np.testing.assert_allclose(tilt.angle[-1], measured[-1], atol=1e-4)
    np.testing.assert_allclose(tilt.rate[-1], [0.1, -0.2], atol=1e-3)


def test_noise_is_reduced_as_the_theory_says():
    noise = np.random.default_rng(1).normal(size=(20_000, 2)).astype(np.float32) * 0.1
    memory = np.exp(-PERIOD / 0.06)
    share = (1 - memory) / (1 + memory) ** 3 * (1 + 4 * memory + 5 * memory**2)
    assert np.var(filtered(noise, 0.06).angle) / np.var(noise) == pytest.approx(share, rel=0.05)
    assert share < 0.4


@pytest.mark.parametrize("wrong", [3.1, 1e30])
def test_one_wrong_measurement_is_forgotten(wrong):
    measured = np.zeros((60, 2), np.float32)
    measured[20] = wrong
    angle = np.asarray(filtered(measured, 0.06).angle)
    assert np.abs(angle).max() < 0.5
    np.testing.assert_allclose(angle[40:], 0.0, atol=0.02)


def test_the_filter_depends_on_time_and_not_on_the_period():
    def last(period):
        times = np.arange(1, round(0.6 / period) + 1) * period
        tilt = 0.5 * np.sin(6.0 * times).astype(np.float32)
        return filtered(np.stack([tilt, tilt], axis=1), 0.06, period).angle[-1]

    np.testing.assert_allclose(last(0.01), last(0.02), atol=0.02)
