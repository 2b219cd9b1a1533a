"""The gate stays in its box and can be undone; violations and penalties are charged outside only."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from creps_jax.policies.features import linear_features
from creps_jax.policies.gaussian import start_policy
from creps_jax.policies.space import Space, penalty, sigmoid_gate, sigmoid_gate_inverse, violation

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


@pytest.mark.parametrize("constraint", ["sigmoid", "clip", "none"])
def test_a_search_can_begin_at_known_parameters(constraint):
    space = Space(("length", "height", "time"), LOW, HIGH, constraint=constraint)
    known = jnp.asarray([0.002, -4.0, 100.9])
    features = linear_features(1)
    start = start_policy(features, space.size, mean=space.free(known), std=0.1)
    means = space.inside(features(jnp.asarray([[-1.0], [3.0]])) @ start.coef)
    np.testing.assert_allclose(means, np.tile(known, (2, 1)), rtol=1e-5)
    with pytest.raises(ValueError, match=r"parameters must have 3 numbers along the last axis, got \(2,\)"):
        space.free(jnp.zeros(2))


def test_an_unbounded_space_takes_any_finite_number():
    space = Space.unbounded(("length", "angle"), ("m", "rad"))
    assert (space.names, space.units) == (("length", "angle"), ("m", "rad"))
    assert space.contains((-1e30, 1e30)) and not space.contains((np.inf, 0.0))
    free = jnp.asarray([-1e30, 3.0])
    np.testing.assert_array_equal(space.inside(free), free)
    assert Space.unbounded(("length",)).units == ("",)


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


LARGEST = float(np.finfo(np.float32).max)
# A box of all kinds of bounds at once, and each of them alone.
BOXES = {
    "wide": (-3e38, 3e38),
    "widest": (-LARGEST, LARGEST),
    "half wide": (0.0, LARGEST),
    "quarter wide": (-4e37, 4e37),
    "high": (3e38, 3.1e38),
    "narrow": (0.0, 1e-30),
    "denormal": (2e-38, 2.5e-38),
    "denormal bounds": (0.0, 1e-39),
    "fixed": (3e38, 3e38),
    "all at once": ((-3e38, 0.0, 2e-38, -1.0, 3e38), (3e38, 1e-30, 2.5e-38, 1.0, 3e38)),
}
boxes = pytest.mark.parametrize(("low", "high"), BOXES.values(), ids=BOXES)
# How the bounds come: as numbers, as constants of a program, as its arguments.
CALLS = {
    "eager": lambda function, theta, low, high: function(jnp.asarray(theta), low, high),
    "constants": lambda function, theta, low, high: jax.jit(lambda theta: function(theta, low, high))(theta),
    "arguments": lambda function, theta, low, high: jax.jit(function)(
        theta, jnp.float32(low), jnp.float32(high)
    ),
}
calls = pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)


def of_size(values, low):
    return np.float32(values)[:, None] * np.ones((1, np.size(low)), np.float32)


@boxes
@calls
def test_gate_of_an_extreme_box_stays_inside(low, high, call):
    theta = of_size([-LARGEST, -1e4, -20, -1, 0, 1, 20, 1e4, LARGEST], low)
    with jax.debug_nans(True):
        gated = np.asarray(call(sigmoid_gate, theta, low, high))
    ends = np.float64(np.float32(low)), np.float64(np.float32(high))
    assert np.isfinite(gated).all() and (gated >= np.float32(low)).all() and (gated <= np.float32(high)).all()
    width = ends[1] - ends[0]
    with np.errstate(over="ignore"):
        expected = ends[0] + width / (1 + np.exp(-np.float64(theta)))
    # What is below the smallest ordinary number counts as zero.
    size = np.maximum(np.abs(ends[0]), np.abs(ends[1]))
    assert (np.abs(gated - expected) <= 1e-6 * size + 1.2e-38).all()


@boxes
@calls
def test_inverse_of_an_extreme_box_is_finite_and_undoes_the_gate(low, high, call):
    ends = np.float64(np.float32(low)), np.float64(np.float32(high))
    inside = np.float32(ends[0] + np.linspace(0, 1, 9)[:, None] * (ends[1] - ends[0]))
    theta = np.concatenate([inside.reshape(9, -1), of_size([-LARGEST, 0, LARGEST], low)])
    with jax.debug_nans(True):
        free = call(sigmoid_gate_inverse, theta, low, high)
    assert np.isfinite(free).all() and (np.abs(free) < 20).all()
    width = ends[1] - ends[0]
    back = np.float64(sigmoid_gate(free[:9], low, high))
    size = np.maximum(np.abs(ends[0]), np.abs(ends[1]))
    assert (np.abs(back - inside) <= 1e-6 * np.maximum(width, size) + 1.2e-38).all()


@boxes
@calls
def test_violation_of_an_extreme_box_is_finite(low, high, call):
    theta = of_size([-LARGEST, -1e20, 0, 1e20, LARGEST], low)
    with jax.debug_nans(True):
        distance = np.float64(call(violation, theta, low, high))
    ends = np.float64(np.float32(low)), np.float64(np.float32(high))
    expected = np.maximum(np.maximum(ends[0] - theta, theta - ends[1]), 0)
    np.testing.assert_allclose(distance, np.minimum(expected, LARGEST), rtol=1e-6, atol=1.2e-38)


@pytest.mark.parametrize("call", [CALLS["eager"], CALLS["constants"]], ids=["eager", "constants"])
def test_ordinary_boxes_give_the_plain_formulas_to_the_bit(call):
    random = np.random.default_rng(0)
    low = np.float32(random.normal(size=8) * 10.0 ** np.arange(-6, 2))
    high = np.float32(low + np.abs(random.normal(size=8)) * 10.0 ** random.integers(-3, 3, 8))

    def plain_gate(theta, low, high):
        low, high = (jnp.broadcast_to(jnp.asarray(end), theta.shape) for end in (low, high))
        return jnp.clip(low + jax.nn.sigmoid(theta) * (high - low), low, high)

    def plain_inverse(theta, low, high):
        low, high = (jnp.broadcast_to(jnp.asarray(end), theta.shape) for end in (low, high))
        margin = float(jnp.finfo(jnp.float32).epsneg)
        return jax.scipy.special.logit(jnp.clip((theta - low) / (high - low), margin, 1.0 - margin))

    def plain_violation(theta, low, high):
        low, high = (jnp.broadcast_to(jnp.asarray(end), theta.shape) for end in (low, high))
        return jnp.maximum(jnp.maximum(low - theta, theta - high), 0.0)

    free = jnp.float32(random.normal(size=(200, 8)) * 10.0 ** random.uniform(-2, 1.5, (200, 1)))
    inside = jnp.float32(low + (high - low) * random.uniform(-0.2, 1.2, (200, 8)))
    for function, plain, theta in (
        (sigmoid_gate, plain_gate, free),
        (sigmoid_gate_inverse, plain_inverse, inside),
        (violation, plain_violation, inside),
    ):
        np.testing.assert_array_equal(call(function, theta, low, high), call(plain, theta, low, high))
