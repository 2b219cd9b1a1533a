"""Movement primitives: their known properties, and an integrator of the differential equation as oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from creps_jax.tasks.dmp import dmp_trajectory, fit_dmp

START, GOAL = jnp.array([0.3, -0.5]), jnp.array([1.0, 0.2])
WEIGHTS = jax.random.normal(jax.random.key(0), (5, 2))


def moved(weights=WEIGHTS, start=START, goal=GOAL, **settings):
    return dmp_trajectory(weights, start, goal, **{"duration": 1.0, "num_steps": 100, **settings})


def minimum_jerk(start, goal, num):
    time = np.linspace(0.0, 1.0, num)[:, None]
    return np.asarray(start) + (10 * time**3 - 15 * time**4 + 6 * time**5) * (
        np.asarray(goal) - np.asarray(start)
    )


def test_a_movement_ends_near_its_goal_whatever_the_forcing():
    unforced = moved(jnp.zeros_like(WEIGHTS))
    np.testing.assert_allclose(unforced.pos[-1], GOAL, atol=1e-4)
    # One hundredth of the forcing is left at the end, but the spring lags it by 0.16 durations.
    assert np.abs(moved().pos[-1] - GOAL).max() < 0.03 * np.abs(WEIGHTS).max()


@pytest.mark.parametrize("duration", [0.5, 4.0])
def test_the_duration_scales_time_and_nothing_else(duration):
    fast, slow = moved(), moved(duration=duration)
    np.testing.assert_allclose(slow.pos, fast.pos, atol=1e-5)
    np.testing.assert_allclose(slow.vel * duration, fast.vel, atol=1e-4)
    np.testing.assert_allclose(slow.acc * duration**2, fast.acc, atol=3e-3)


def test_velocity_and_acceleration_are_derivatives():
    steps = 4000
    movement = moved(num_steps=steps)
    pos, vel = np.asarray(movement.pos, float), np.asarray(movement.vel, float)
    # Backward differences belong to the middle of a step.
    np.testing.assert_allclose(np.diff(pos, axis=0) * steps, 0.5 * (vel[1:] + vel[:-1]), atol=2e-3)
    acc = 0.5 * (movement.acc[1:] + movement.acc[:-1])
    np.testing.assert_allclose(np.diff(vel, axis=0) * steps, acc, rtol=2e-3, atol=0.25)


def test_it_solves_the_differential_equation_of_the_textbook():
    centers = np.exp(-np.log(100.0) * np.linspace(0, 1, 5))
    widths = np.append(-np.diff(centers), -np.diff(centers)[-1])
    start, goal, weights = (np.asarray(value, float) for value in (START, GOAL, WEIGHTS))

    def slope(time, state):
        phase = np.exp(-np.log(100.0) * time)
        bases = np.exp(-0.5 * ((phase - centers) / widths) ** 2)
        forcing = phase * (bases @ weights) / bases.sum()
        pos, vel = state.reshape(2, 2)
        return np.concatenate([vel, 25.0 * (6.25 * (goal + forcing - pos) - vel)])

    times = np.linspace(0, 1, 101)[1:]
    state = solve_ivp(slope, (0, 1), np.append(start, [0.0, 0.0]), t_eval=times, rtol=1e-9, atol=1e-9).y
    movement = moved()
    np.testing.assert_allclose(movement.pos, state[:2].T, atol=2e-3)
    np.testing.assert_allclose(movement.vel, state[2:].T, atol=3e-2)


def test_coarse_steps_stay_stable():
    assert np.abs(moved(num_steps=2).pos).max() < 10.0


def test_a_fit_follows_a_demonstration():
    demonstration = jnp.asarray(minimum_jerk(START, GOAL, 101), jnp.float32)
    weights = fit_dmp(demonstration, 10)
    error = moved(weights).pos - demonstration[1:]
    assert np.abs(error).max() < 0.01
    # ... to another goal, the movement keeps its shape.
    elsewhere = moved(weights, goal=GOAL + 1.0)
    np.testing.assert_allclose(elsewhere.pos[-1], GOAL + 1.0, atol=0.02)


def test_a_fit_gives_back_the_movement_it_was_made_of():
    movement = moved(goal=START)
    demonstration = jnp.concatenate([START[None], movement.pos])
    again = moved(fit_dmp(demonstration, 5), goal=demonstration[-1])
    # Only the goal differs: a demonstration does not tell it from where it ends.
    np.testing.assert_allclose(again.pos, movement.pos, atol=5e-3)


def test_a_fit_agrees_with_the_package_movement_primitives():
    package = pytest.importorskip("movement_primitives.dmp")
    demonstration = minimum_jerk(START, GOAL, 101)
    theirs = package.DMP(n_dims=2, execution_time=1.0, dt=0.01, n_weights_per_dim=10)
    theirs.imitate(np.linspace(0, 1, 101), demonstration)
    theirs.configure(start_y=demonstration[0], goal_y=demonstration[-1])
    _, path = theirs.open_loop()
    ours = moved(fit_dmp(jnp.asarray(demonstration, jnp.float32), 10)).pos
    np.testing.assert_allclose(ours, path[1:], atol=0.02)


def test_shapes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match=r"start must have shape \(2,\) beside weights \(5, 2\), got \(3,\)"):
        dmp_trajectory(WEIGHTS, jnp.zeros(3), GOAL, duration=1.0, num_steps=100)
    with pytest.raises(ValueError, match="num_steps must be at least 1, got 0"):
        moved(num_steps=0)
    with pytest.raises(ValueError, match=r"duration must be finite and above 0, got 0\.0"):
        moved(duration=0.0)
    with pytest.raises(ValueError, match=r"weights must have shape \(b, d\), got \(0, 2\)"):
        moved(jnp.zeros((0, 2)))
    with pytest.raises(ValueError, match="num_basis must be less than the 5 positions of pos, got 5"):
        fit_dmp(jnp.zeros((5, 2)), 5)
