"""The root finder brackets what SciPy's finds: of steep, flat, jumping and infinite functions."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

from creps_jax.roots import find_crossing

# Name: function (of NumPy or JAX), low, high, target.
SMOOTH = {
    "line": (lambda x, np: 3.0 * x - 1.0, -5.0, 7.0, 0.3),
    "cube": (lambda x, np: x**3, -2.0, 3.0, 0.1),
    "exponential": (lambda x, np: np.exp(x), -12.0, 40.0, 2.0),
    "saturated": (lambda x, np: np.tanh(x), -20.0, 30.0, 0.9),
    "logarithm": (lambda x, np: np.log(x), 1e-6, 1e6, 3.0),
    "kink": (lambda x, np: np.where(x < 1.0, 1e-3 * (x - 1.0), 1e3 * (x - 1.0)), -100.0, 100.0, 0.5),
    "stairs": (lambda x, np: x + np.sin(x), -30.0, 50.0, 11.0),
    "steep": (lambda x, np: np.expm1(50.0 * x) / 50.0, -1.0, 1.5, 2.0),
    "relative entropy": (lambda x, np: 0.5 * np.exp(2.0 * x) / (1.0 + np.exp(2.0 * x)), -12.0, 12.0, 0.2),
}


def find(name, dtype=jnp.float32, is_decreasing=False, **settings):
    function, low, high, target = SMOOTH[name]
    sign = -1.0 if is_decreasing else 1.0
    return jax.jit(
        lambda low, high, target: find_crossing(
            lambda x: sign * function(x, jnp), low, high, target, is_decreasing=is_decreasing, **settings
        )
    )(dtype(low), dtype(high), dtype(sign * target))


@pytest.mark.parametrize("is_decreasing", [False, True])
@pytest.mark.parametrize("name", SMOOTH)
def test_crossing_is_that_of_scipy(name, is_decreasing):
    function, low, high, target = SMOOTH[name]
    expected = brentq(lambda x: function(x, np) - target, low, high, xtol=1e-12)
    found = find(name, is_decreasing=is_decreasing)
    assert bool(found.is_inside)
    np.testing.assert_allclose([found.low, found.high], expected, rtol=3e-6, atol=1e-6)
    assert found.high == np.nextafter(found.low, np.float32(np.inf))  # no number left inside
    assert int(found.num_evaluations) < 55


@pytest.mark.parametrize("name", SMOOTH)
def test_few_evaluations_are_enough_where_less_is_asked(name):
    found = find(name, resolution=1e-3)
    assert float(found.high - found.low) <= 1e-3
    assert int(found.num_evaluations) < 40


@pytest.mark.parametrize("name", SMOOTH)
def test_crossing_in_float64(name):
    function, low, high, target = SMOOTH[name]
    expected = brentq(lambda x: function(x, np) - target, low, high, xtol=1e-15, rtol=1e-15)
    with jax.enable_x64(True):
        found = find(name, jnp.float64)
    np.testing.assert_allclose([found.low, found.high], expected, rtol=1e-12, atol=1e-12)


AWKWARD = {
    "jump": lambda x: jnp.where(x < 0.3, -1e30, 1e30),
    "infinite jump": lambda x: jnp.where(x < 0.3, -jnp.inf, jnp.inf),
    "not a number above": lambda x: jnp.where(x < 0.3, x - 1.0, jnp.nan),
    "huge and tiny": lambda x: jnp.where(x < 0.3, -1e-35, 3e38),
    "flat, then a jump": lambda x: jnp.where(x < 0.3, 0.0, 1.0),
}


@pytest.mark.parametrize("name", AWKWARD)
def test_jumps_are_found(name):
    found = jax.jit(lambda: find_crossing(AWKWARD[name], jnp.float32(-1.0), jnp.float32(2.0), 0.0))()
    np.testing.assert_allclose(found.low, 0.3, atol=1e-6)
    assert float(found.low) < 0.3 <= float(found.high)
    assert int(found.num_evaluations) < 70


@pytest.mark.parametrize("is_decreasing", [False, True])
@pytest.mark.parametrize(("target", "end"), [(-9.0, -2.0), (9.0, 3.0)])
def test_range_without_a_crossing_gives_its_nearest_end(target, end, is_decreasing):
    sign = -1.0 if is_decreasing else 1.0
    found = find_crossing(lambda x: sign * x, -2.0, 3.0, sign * target, is_decreasing=is_decreasing)
    assert not bool(found.is_inside)
    assert float(found.low) == float(found.high) == end
    assert int(found.num_evaluations) == 2


@pytest.mark.parametrize("is_decreasing", [False, True])
def test_ends_tell_which_side_of_the_target_they_are_on(is_decreasing):
    """The target itself counts as within a bound."""
    sign = -1.0 if is_decreasing else 1.0
    found = find_crossing(lambda x: sign * jnp.floor(x), 0.0, 10.0, sign * 4.0, is_decreasing=is_decreasing)
    within, beyond = (found.high, found.low) if is_decreasing else (found.low, found.high)
    assert sign * np.floor(within) <= sign * 4.0 < sign * np.floor(beyond)


def test_vmap_equals_loop():
    solve = lambda target: find_crossing(jnp.exp, -12.0, 40.0, target)  # noqa: E731
    targets = jnp.array([1e-9, 1e-3, 1.0, 1e9, 1e17])
    together = jax.jit(jax.vmap(solve))(targets)
    for index, target in enumerate(targets):
        alone = jax.jit(solve)(target)
        np.testing.assert_allclose(together.low[index], alone.low, rtol=1e-6)
        assert bool(together.is_inside[index]) == bool(alone.is_inside)
    np.testing.assert_allclose(jnp.exp(together.low[1:4]), targets[1:4], rtol=1e-5)


def test_evaluations_are_limited_and_a_bad_limit_is_named():
    found = find_crossing(jnp.exp, -12.0, 40.0, 1.0, max_evaluations=5)
    assert int(found.num_evaluations) == 5 and found.low <= 0.0 <= found.high
    with pytest.raises(ValueError, match="max_evaluations must be at least 2, got 1"):
        inspect.unwrap(find_crossing)(jnp.exp, 0.0, 1.0, 2.0, max_evaluations=1)
