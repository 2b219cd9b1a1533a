"""The minimiser finds the minimum of convex functions: flat, badly scaled, far away, in log coordinates."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.optimize import minimize as scipy_minimize

from creps_jax.numerics.minimise import minimise


def quadratic(matrix, target):
    return lambda x: 0.5 * (x - target) @ matrix @ (x - target)


def test_quadratic_takes_one_step():
    matrix = jnp.array([[3.0, 1.0], [1.0, 2.0]])
    target = jnp.array([1.0, -2.0])
    found = minimise(quadratic(matrix, target), jnp.zeros(2))
    np.testing.assert_allclose(found.point, target, atol=1e-6)
    assert bool(found.is_converged)
    assert int(found.num_steps) == 1


@pytest.mark.parametrize("ratio", [1e-8, 1e8])
def test_variables_of_different_units(ratio):
    matrix = jnp.diag(jnp.array([1.0, ratio], jnp.float32))
    target = jnp.array([1.0, ratio**-0.5], jnp.float32)
    found = minimise(quadratic(matrix, target), jnp.zeros(2), max_change=1e6)
    np.testing.assert_allclose(found.point / target, 1.0, atol=1e-3)


def test_flat_directions_are_left_alone():
    direction = jnp.array([1.0, 2.0, -1.0])
    start = jnp.array([1.0, 0.0, 2.0])
    found = minimise(lambda x: (direction @ x - 5.0) ** 2, start, tolerance=1e-4)
    assert bool(found.is_converged)
    np.testing.assert_allclose(direction @ found.point, 5.0, atol=1e-5)
    # Nothing along the flat plane: each variable, in units of its own curvature, moves by the same.
    np.testing.assert_allclose((found.point - start) * direction, (5.0 - direction @ start) / 3, atol=1e-3)


def test_a_dual_like_function_agrees_with_optax():
    """In log temperature and offset, as the dual is solved, where it is not convex everywhere."""
    rewards = jnp.asarray(np.random.default_rng(1).normal(size=200), jnp.float32)

    def function(x):
        temperature = jnp.exp(x[0])
        return temperature * (0.5 + jax.nn.logsumexp((rewards - x[1]) / temperature) - jnp.log(200.0)) + x[1]

    optimiser = optax.lbfgs()

    def step(_, carry):
        point, state = carry
        value, grad = optax.value_and_grad_from_state(function)(point, state=state)
        updates, state = optimiser.update(grad, state, point, value=value, grad=grad, value_fn=function)
        return optax.apply_updates(point, updates), state

    start = jnp.array([1.0, 0.5])
    expected, _ = jax.jit(lambda x: jax.lax.fori_loop(0, 50, step, (x, optimiser.init(x))))(start)
    found = minimise(function, start)
    assert float(found.value) == pytest.approx(float(function(expected)), abs=1e-5)
    assert float(found.point[0]) == pytest.approx(float(expected[0]), abs=1e-2)


def test_log_sum_exp_agrees_with_scipy():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(40, 6))
    rows[:, 5] = rows[:, 0]  # flat along the difference of the two
    offset = rng.normal(size=40)

    def function(x, np=np):
        return np.log(np.sum(np.exp(rows.astype(x.dtype) @ x + offset.astype(x.dtype))))

    expected = scipy_minimize(function, np.zeros(6), method="BFGS")
    found = jax.jit(lambda start: minimise(lambda x: function(x, jnp), start))(jnp.full(6, 3.0))
    assert bool(found.is_converged)
    assert float(found.value) == pytest.approx(expected.fun, abs=1e-5)
    np.testing.assert_allclose(rows @ found.point, rows @ expected.x, atol=1e-3)


@pytest.mark.parametrize("start", [-8.0, 0.0, 8.0])
def test_convex_function_of_the_logarithm(start):
    # Convex in exp(x), not in x: the second derivative is zero at 0 and negative left of it.
    found = minimise(lambda x: jnp.sum((jnp.exp(x) - 2.0) ** 2), jnp.array([start]), max_change=2.0)
    np.testing.assert_allclose(found.point, np.log(2.0), atol=1e-4)


def test_overflow_on_the_way_is_stepped_around():
    # Nearly linear where it starts, so that the Newton step overshoots to where float32 overflows.
    found = minimise(lambda x: jnp.sum(jnp.exp(x) - 3.0 * x), jnp.array([-12.0]))
    assert bool(found.is_converged)
    np.testing.assert_allclose(found.point, np.log(3.0), atol=1e-5)


def test_status_tells_when_steps_run_out_or_there_is_no_minimum():
    short = minimise(lambda x: jnp.sum(jnp.exp(x) - 3.0 * x), jnp.array([-12.0]), max_steps=2, max_change=1.0)
    assert not bool(short.is_converged)
    assert int(short.num_steps) == 2
    endless = minimise(lambda x: jnp.sum(x), jnp.zeros(2), max_change=10.0)
    assert not bool(endless.is_converged)
    assert np.all(np.isfinite(endless.point))


def test_start_at_the_minimum_takes_no_step():
    found = minimise(lambda x: jnp.sum(x**4), jnp.zeros(3))
    assert bool(found.is_converged)
    assert int(found.num_steps) == 0


def test_vmap_equals_loop_and_is_traced_once():
    traces = []

    @jax.jit
    @jax.vmap
    def find(target):
        traces.append(None)
        return minimise(lambda x: jnp.sum(jnp.cosh(x - target)), jnp.zeros_like(target))

    targets = jnp.array([[0.0, 1.0], [5.0, -3.0], [-8.0, 0.1]])
    together = find(targets)
    for i in range(3):
        alone = find(targets[i : i + 1])
        np.testing.assert_allclose(together.point[i], alone.point[0], atol=1e-4)
    np.testing.assert_allclose(together.point, targets, atol=1e-4)
    assert len(traces) == 2  # one for each shape


def test_bad_settings_are_named():
    unchecked = inspect.unwrap(minimise)
    with pytest.raises(ValueError, match=r"start must have shape \(k,\), k >= 1, got \(2, 2\)"):
        unchecked(jnp.sum, jnp.zeros((2, 2)))
    with pytest.raises(ValueError, match="max_steps must be at least 1, got 0"):
        minimise(jnp.sum, jnp.zeros(2), max_steps=0)
