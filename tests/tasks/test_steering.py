"""The steered walk follows its command, and measures it in the frame of the body."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.files import policies_folder
from creps_jax.policies.learned import load
from creps_jax.simulation import c
from creps_jax.tasks.closed_loop import WalkNoise
from creps_jax.tasks.conditions import slope
from creps_jax.tasks.steering import moved, nao_steered_walk, record_drive
from creps_jax.walking.controller import Stage, Walker
from creps_jax.walking.gaits import learned_walker, steered_gait
from creps_jax.walking.params import NAO_STEERED_BOUNDS, STEERED_PARAM_NAMES
from creps_jax.walking.posture import Balance

GAIT = {"amplitude": 0.002, "hip_height": 0.17, "swing_height": 0.03, "step_duration": 0.22, "lean": 1.0}
GAIT |= {"tilt_gain": 0.4, "roll_gain": 0.3, "double_support": 0.02, "step_growth": 0.12}
QUIET = WalkNoise(0.0, 0.0, 0.0)


def theta_of(vx, vy, turn):
    steps = {"step_length": vx, "step_side": vy, "step_turn": turn}
    steps = {name: speed * GAIT["step_duration"] for name, speed in steps.items()}
    return jnp.array([(GAIT | steps)[name] for name in STEERED_PARAM_NAMES], jnp.float32)


@pytest.fixture(scope="module")
def walks():
    """Outcomes of commands straight ahead, backward, to the left and turning."""
    commands = jnp.array([[0.2, 0.0, 0.0], [-0.15, 0.0, 0.0], [0.05, 0.1, 0.0], [0.05, 0.0, 0.6]])
    # The gait was set for the tilt as it is measured.
    settings = {"noise": QUIET, "balance": Balance(0.0, 0.6), "physics": c.make_control_step}
    task = nao_steered_walk(duration=4.0, start_up=1.5, **settings)
    thetas = jnp.stack([theta_of(*command) for command in commands])
    keys = jax.random.split(jax.random.key(0), len(commands))
    return commands, jax.jit(jax.vmap(task.rollout))(keys, commands, thetas)


def test_it_walks_about_as_it_is_told(walks):
    commands, outcome = walks
    assert not np.any(outcome.fell)
    np.testing.assert_allclose(outcome.speed, commands, atol=0.15)
    np.testing.assert_allclose(outcome.error, commands - outcome.speed, atol=0.02)


def test_the_reward_is_the_weighted_square_of_the_error(walks):
    _, outcome = walks
    wanted = -np.sum(np.asarray(outcome.error) ** 2 * np.array([30.0, 30.0, 6.0]), axis=1)
    np.testing.assert_allclose(outcome.reward, wanted, rtol=1e-4)


def test_speeds_are_in_the_frame_of_the_body():
    yaw = 0.7
    before = jnp.array([1.0, 2.0, 0.3, np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    after = jnp.array([1.0 + np.cos(yaw), 2.0 + np.sin(yaw), 0.3, np.cos(0.4), 0.0, 0.0, np.sin(0.4)])
    np.testing.assert_allclose(moved(before, after), [1.0, 0.0, 0.8 - yaw], atol=1e-6)


def test_a_profile_scales_the_command_and_each_part_is_measured():
    settings = {"duration": 4.0, "start_up": 1.0, "noise": QUIET, "physics": c.make_control_step}
    task = nao_steered_walk(profile=((0.0, 1.0, 1.0), (2.5, 0.0, 1.0)), **settings)
    outcome = jax.jit(task.rollout)(jax.random.key(0), jnp.array([0.2, 0.0, 0.0]), theta_of(0.2, 0.0, 0.0))
    assert not outcome.fell and 0.02 < outcome.speed[0] < 0.18


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"low": (0.0, 0.0), "high": (1.0, 1.0)}, "low must have three entries, vx, vy, turn"),
        ({"start_up": 9.0}, "start_up must lie in"),
        ({"profile": ((1.0, 1.0, 1.0),)}, "profile must be parts"),
        ({"profile": ((0.0, 1.0, 1.0), (0.5, 0.0, 1.0))}, "profile must not change before start_up"),
        ({"com": "two_step"}, "com must be one of"),
    ],
)
def test_bad_settings_are_named(settings, expected):
    with pytest.raises(ValueError, match=expected):
        nao_steered_walk(**({"duration": 4.0} | settings))


def test_a_robot_is_driven_stops_and_stands():
    low, high = np.array(NAO_STEERED_BOUNDS)
    assert np.all(np.asarray(theta_of(0.2, 0.0, 0.0)) <= high) and np.all(low <= high)

    def gait(command):
        return steered_gait(theta_of(*command))

    commands = np.zeros((300, 3), np.float32)
    commands[:120, 0] = 0.2
    walker = Walker(gait, balance=Balance(0.3, 0.6))
    drive = jax.jit(
        lambda key, commands: record_drive(key, walker, commands, noise=QUIET, physics=c.make_control_step)
    )(jax.random.key(0), jnp.asarray(commands))
    assert not drive.has_fallen[-1]
    assert drive.stage[-1] == Stage.STANDING
    np.testing.assert_allclose(np.asarray(drive.speed[250:]).mean(axis=0), 0.0, atol=0.02)
    assert np.asarray(drive.speed[60:110]).mean(axis=0)[0] > 0.1


def test_a_robot_walks_a_circle_on_a_slope():
    """Uphill lies ahead, to the left, behind and to the right in turn: the robot stands upright in each."""
    walker = learned_walker(load(policies_folder() / "steer.npz"))
    commands = jnp.tile(jnp.array([0.2, 0.0, 0.5]), (700, 1))

    def drive(key):
        settings = {"conditions": (slope(-10.0, 10.0),), "values": jnp.array([8.0])}
        return record_drive(key, walker, commands, physics=c.make_control_step, **settings)

    drives = jax.jit(jax.vmap(drive))(jax.random.split(jax.random.key(0), 4))
    assert not drives.has_fallen.any()
    turned = np.sum(np.asarray(drives.speed[:, :, 2]), axis=1) * 0.02
    assert (turned > np.radians(270.0)).all()


def test_a_walker_of_another_period_cannot_be_simulated():
    walker = Walker(lambda command: steered_gait(theta_of(0.2, 0.0, 0.0)), period=0.01)
    with pytest.raises(ValueError, match="walker must have a period of"):
        record_drive(jax.random.key(0), walker, jnp.zeros((10, 3)))
