"""The gate stays in its box and can be undone; violations and penalties are charged outside only."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from creps_jax.constraints import penalty, sigmoid_gate, sigmoid_gate_inverse, violation

LOW, HIGH = (0.0, -5.0, 100.0), (0.01, 5.0, 101.0)
numbers = st.floats(-1e6, 1e6, width=32)


@settings(max_examples=100, deadline=None)
@given(theta=st.lists(numbers, min_size=3, max_size=3))
def test_gate_agrees_with_the_equation_and_stays_inside(theta):
    gated = np.asarray(sigmoid_gate(jnp.asarray(theta, jnp.float32), LOW, HIGH), np.float64)
    low, high = np.float32(LOW), np.float32(HIGH)
    assert (gated >= low).all() and (gated <= high).all()
    with np.errstate(over="ignore"):
        expected = np.asarray(LOW) + (np.asarray(HIGH) - LOW) / (1 + np.exp(-np.asarray(theta)))
    # Rounding is relative to the bounds, not to a value near zero between them.
    np.testing.assert_array_less(np.abs(gated - expected), 2e-6 * np.maximum(np.abs(low), np.abs(high)))


@settings(max_examples=100, deadline=None)
@given(fraction=st.lists(st.floats(0, 1, width=32), min_size=2, max_size=2))
def test_inverse_undoes_the_gate(fraction):
    low, high = jnp.asarray([-1.0, 0.0]), jnp.asarray([1.0, 0.01])
    inside = low + jnp.asarray(fraction, jnp.float32) * (high - low)
    free = sigmoid_gate_inverse(inside, low, high)
    assert jnp.isfinite(free).all()
    np.testing.assert_allclose(sigmoid_gate(free, low, high), inside, atol=2e-7)


def test_inverse_takes_what_lies_outside_to_the_bound():
    free = sigmoid_gate_inverse(jnp.asarray([-9.0, 9.0]), -1.0, 1.0)
    np.testing.assert_allclose(sigmoid_gate(free, -1.0, 1.0), [-1.0, 1.0], atol=1e-6)


def test_equal_bounds_fix_a_parameter():
    low, high = (0.0, 3.0), (1.0, 3.0)
    np.testing.assert_array_equal(sigmoid_gate(jnp.asarray([0.0, 7.0]), low, high), [0.5, 3.0])
    np.testing.assert_array_equal(sigmoid_gate_inverse(jnp.asarray([0.5, 3.0]), low, high), [0.0, 0.0])


def test_gate_has_finite_gradients_far_outside():
    grad = jax.grad(lambda theta: sigmoid_gate(theta, LOW, HIGH).sum())(jnp.asarray([-1e4, 0.0, 1e4]))
    assert jnp.isfinite(grad).all()


def test_violation_measures_the_distance_to_the_box():
    theta = jnp.asarray([[-0.5, 0.0, 100.5], [0.005, 7.0, 90.0]])
    np.testing.assert_allclose(violation(theta, LOW, HIGH), [[0.5, 0, 0], [0, 2, 10]], rtol=1e-6)


def test_penalty_is_charged_once_and_only_outside():
    outside = jnp.asarray([[0.0, 0.0], [1e-9, 0.0], [3.0, 4.0]])
    np.testing.assert_array_equal(penalty(outside, 1000), [0, 1000, 1000])
    assert penalty(jnp.zeros(0), 1000) == 0


@pytest.mark.parametrize("function", [sigmoid_gate, sigmoid_gate_inverse, violation])
def test_refuses_bounds_that_do_not_fit(function):
    with pytest.raises(ValueError, match=r"got shapes \(3,\), \(2,\) and \(\)"):
        function(jnp.zeros(3), (0.0, 0.0), 1.0)
