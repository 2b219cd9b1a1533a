"""The walking task: reward, speeds, falls, keys, solver settings, and C MuJoCo as oracle."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from creps_jax.robots.robot import NAO
from creps_jax.simulation import c, mjx
from creps_jax.simulation.models import load_nao
from creps_jax.tasks.closed_loop import CONTROL_PERIOD, begin, make_setup
from creps_jax.tasks.walking import WalkNoise, WalkReward, nao_walk, record_walk
from creps_jax.training import evaluate
from creps_jax.walking.gaits import AHEAD, straight_walker
from creps_jax.walking.open_loop import open_loop_walk
from tests.oracles import walk_c

# Gaits of about 0.08, 0.33 and 0.50 m/s, and one that trips at once.
SLOW = (0.002, 0.19, 0.02, 0.30, 3.0, 0.3, 0.3, 0.03, 0.015, 0.1)
MIDDLE = (0.001, 0.176, 0.039, 0.224, 3.2, 0.46, 0.31, 0.074, 0.038, 0.11)
FAST = (0.0015, 0.161, 0.041, 0.188, -2.295, 0.427, 0.506, 0.090, 0.007, 0.084)
FALLING = (0.0, 0.15, 0.06, 0.40, 5.0, 0.0, 0.0, 0.15, 0.0, 0.2)
BALANCE = walk_c.BALANCE
DURATION = 4.0
SEEDS = 4


def rolled_out(task, thetas, seeds, asked=0.3):
    contexts = jnp.full((len(thetas), 1), asked)
    # MJX relies on implicit promotion.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        outcome = evaluate(jax.random.key(1), task, contexts, jnp.array(thetas), repeats=seeds)
    return jax.tree.map(np.asarray, outcome)


@pytest.fixture(scope="module")
def task():
    return nao_walk(duration=DURATION, balance=BALANCE)


@pytest.fixture(scope="module")
def outcome(task):
    return rolled_out(task, [SLOW, MIDDLE, FAST, FALLING], SEEDS)


def test_gaits_walk_at_their_speeds_and_a_bad_one_falls(outcome):
    assert not outcome.fell[:3].any()
    assert outcome.fell[3].all()
    np.testing.assert_allclose(outcome.speed[:3, :, 0].mean(axis=1), [0.08, 0.33, 0.50], atol=0.04)
    assert (outcome.seconds[:3] == DURATION).all()
    assert (outcome.seconds[3] < DURATION).all()


def rolled_out_by_c(model=None):
    task = nao_walk(duration=DURATION, balance=BALANCE, model=model, physics=c.make_control_step)
    return rolled_out(task, [SLOW, MIDDLE, FAST, FALLING], SEEDS)


@pytest.fixture(scope="module")
def outcome_by_c():
    return rolled_out_by_c()


def test_either_physics_walks_alike(outcome, outcome_by_c):
    np.testing.assert_array_equal(outcome_by_c.fell, outcome.fell)
    np.testing.assert_allclose(
        outcome_by_c.speed[:3, :, 0].mean(axis=1), outcome.speed[:3, :, 0].mean(axis=1), atol=0.02
    )


def test_reward_is_that_of_eq_18(outcome):
    expected = -10 * (outcome.speed[..., 0] - 0.3) ** 2 - outcome.speed[..., 1] ** 2 - 100.0 * outcome.fell
    np.testing.assert_allclose(outcome.reward, expected, rtol=1e-5, atol=1e-6)


def test_repeats_differ_by_their_keys_and_a_key_repeats(task, outcome):
    assert np.std(outcome.speed[1, :, 0]) > 1e-4
    again = rolled_out(task, [SLOW, MIDDLE, FAST, FALLING], SEEDS)
    np.testing.assert_array_equal(again.reward, outcome.reward)


@pytest.mark.usefixtures("relaxed_promotion")
def test_a_record_is_the_same_walk_with_the_speed_of_the_displacement(outcome):
    # C's program is quickly compiled.
    settings = {"duration": DURATION, "balance": BALANCE, "physics": c.make_control_step}
    key = jax.random.fold_in(jax.random.key(1), SEEDS)
    record = jax.jit(lambda key, theta: record_walk(key, theta, **settings))(key, jnp.array(MIDDLE))
    start = round(2.0 / 0.02) - 1
    np.testing.assert_allclose(record.time[start], 2.0, atol=1e-6)
    displacement = np.asarray(record.qpos[-1, :2] - record.qpos[start, :2])
    np.testing.assert_allclose(displacement / (DURATION - 2.0), outcome.speed[1, 0], atol=0.02)
    assert not record.has_fallen.any()


def test_set_points_of_a_trunk_that_leans_as_intended_are_the_open_loop_ones():
    commands = jnp.tile(jnp.array(AHEAD), (100, 1))

    def stay(model, num_substeps):
        return lambda robot, before, after, speed: robot

    def walk(key, theta):
        quiet = WalkNoise(0.0, 0.0, 0.0)
        record = record_walk(key, theta, duration=2.0, noise=quiet, balance=BALANCE, physics=stay)
        return record.set_point, open_loop_walk(straight_walker(theta), commands).set_point

    recorded, planned = jax.jit(walk)(jax.random.key(0), jnp.array(MIDDLE))
    assert jnp.abs(jnp.diff(planned, axis=0)).max() > 0.01
    np.testing.assert_allclose(planned[1:], recorded, atol=1e-5)


@pytest.mark.usefixtures("relaxed_promotion")
def test_speed_and_falls_agree_with_c_mujoco(outcome):
    model = load_nao()
    model.opt.iterations, model.opt.ls_iterations = 50, 50
    for row, theta in ((1, MIDDLE), (2, FAST)):
        theta = jnp.array(theta)
        start = _start_of(theta)
        walks = [
            walk_c.walk(model, start, theta, duration=DURATION, noise=0.01, seed=seed) for seed in range(3)
        ]
        speeds = np.array([speed for speed, _ in walks])
        assert not any(fell for _, fell in walks)
        spread = max(float(np.std(outcome.speed[row, :, 0])), 0.005)
        np.testing.assert_allclose(speeds.mean(), outcome.speed[row, :, 0].mean(), atol=4 * spread)


def _start_of(theta):
    """Return the position in which a walk begins, without noise."""
    quiet = WalkNoise(0.0, 0.0, 0.0)
    setup = make_setup(NAO, None, 0.1, quiet, (), mjx.make_control_step)
    walker = straight_walker(theta, period=CONTROL_PERIOD)
    _, start = begin(setup, walker, jax.random.key(0), jnp.zeros(0))
    return np.asarray(start.robot.qpos, float)


def test_the_solver_is_converged_on_walking_gaits(outcome_by_c):
    """By C MuJoCo, whose program is quickly compiled, and which either physics equals step by step."""
    model = load_nao()
    model.opt.iterations, model.opt.ls_iterations = 30, 30
    reference = rolled_out_by_c(model)
    np.testing.assert_array_equal(reference.fell, outcome_by_c.fell)
    np.testing.assert_allclose(
        reference.speed[:3, :, 0].mean(axis=1), outcome_by_c.speed[:3, :, 0].mean(axis=1), atol=0.01
    )


@pytest.mark.slow
def test_the_solver_falls_as_often_as_a_converged_one():
    """In more noise than learning has, where enough walks end in a fall to tell."""
    model = load_nao()
    model.opt.iterations, model.opt.ls_iterations = 30, 30
    noise = WalkNoise(0.018, 0.018, 0.018)
    ours, reference = (
        rolled_out(nao_walk(balance=BALANCE, noise=noise, model=m), [MIDDLE, FAST], 96) for m in (None, model)
    )
    difference = np.abs(ours.fell.mean(axis=1) - reference.fell.mean(axis=1))
    # Two standard deviations of the difference between two shares of a tenth.
    assert (difference <= 0.09).all()
    speeds = [np.nanmean(np.where(o.fell, np.nan, o.speed[..., 0]), axis=1) for o in (ours, reference)]
    np.testing.assert_allclose(*speeds, atol=0.01)


def test_weights_of_the_reward_are_arguments():
    task = nao_walk(duration=0.1, start_up=0.0, reward=WalkReward(speed=1.0, drift=0.0, fall=7.0))
    assert task.worst_reward == -(7.0 + (3.0 * 0.6) ** 2)


@pytest.mark.parametrize(("duration", "start_up"), [(2.0, 2.0), (8.0, -1.0)])
def test_a_start_up_as_long_as_the_episode_is_an_error(duration, start_up):
    with pytest.raises(ValueError, match=f"start_up {start_up} and duration {duration}"):
        nao_walk(duration=duration, start_up=start_up)


def test_another_robot_is_an_error():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="hinge"/><geom size="0.1"/></body></worldbody>
        <actuator><position name="a" joint="hinge"/></actuator></mujoco>"""
    )
    with pytest.raises(ValueError, match="hinge"):
        nao_walk(model=model)


def test_a_state_that_is_not_finite_ends_the_episode_as_a_failure():
    def break_down(*_):
        return lambda robot, before, after, speed: jax.tree.map(lambda x: x * jnp.nan, robot)

    broken = nao_walk(duration=0.2, start_up=0.0, physics=break_down)
    outcome = rolled_out(broken, [MIDDLE], 1)
    assert (outcome.reward == np.float32(broken.worst_reward)).all()
    assert outcome.seconds[0, 0] < 0.2


def test_contexts_stay_in_the_asked_range(task):
    contexts = jax.vmap(task.sample_context)(jax.random.split(jax.random.key(0), 500))
    assert contexts.shape == (500, 1)
    assert (contexts >= 0.1).all()
    assert (contexts <= 0.6).all()
    assert dataclasses.is_dataclass(task)
