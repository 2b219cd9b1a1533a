"""The steered walk is learned from its mirror images too, and evaluated at commands in the ellipsoid."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.errors import UserError
from creps_jax.files import policies_folder
from creps_jax.search.archive import Batch
from creps_jax.walking.controller import Stage
from experiments import steer

SETTINGS = steer.SETTINGS["quick"]
MIDDLE, HALF = np.mean([steer.LOW, steer.HIGH], axis=0), np.subtract(steer.HIGH, steer.LOW) / 2


@pytest.mark.parametrize("commands", [steer.command_grid(), steer.random_commands(0, 3, 20.0).reshape(-1, 3)])
def test_commands_are_in_the_ellipsoid(commands):
    offsets = (commands - MIDDLE) / HALF
    assert np.all(np.sum(offsets**2, axis=1) <= 1.0 + 1e-5)


def test_the_grid_reaches_the_ends_and_the_corners_of_the_ellipsoid():
    grid = steer.command_grid()
    np.testing.assert_allclose(grid.min(axis=0), steer.LOW, atol=1e-6)
    np.testing.assert_allclose(grid.max(axis=0), steer.HIGH, atol=1e-6)
    offsets = (grid - MIDDLE) / HALF
    assert np.sum(np.isclose(np.abs(offsets), 1 / np.sqrt(3), atol=1e-5).all(axis=1)) == 8


def test_random_commands_last_one_to_two_seconds():
    commands = steer.random_commands(1, 1, 60.0)[0]
    changes = np.flatnonzero(np.any(np.diff(commands, axis=0) != 0, axis=1))
    assert np.all(np.diff(changes) >= 49) and np.all(np.diff(changes) <= 101)


def test_the_first_policy_steps_as_far_as_it_is_told():
    learned = steer.as_learned(SETTINGS, steer.first_policy(SETTINGS))
    ahead, left, turning = learned(0.3, 0.0, 0.0), learned(0.2, 0.1, 0.0), learned(0.2, 0.0, 0.4)
    duration = ahead["step_duration"]
    np.testing.assert_allclose(ahead["step_length"], 0.3 * duration, rtol=0.15)
    np.testing.assert_allclose(left["step_side"], 0.1 * duration, rtol=0.15)
    np.testing.assert_allclose(turning["step_turn"], 0.4 * duration, rtol=0.15)


def test_what_is_learned_from_samples_and_mirror_images_is_symmetric():
    algorithm = steer.mirrored(steer.make_algorithm(SETTINGS))
    state = algorithm.init(steer.first_policy(SETTINGS))
    rng = np.random.default_rng(0)
    contexts = jnp.asarray(rng.uniform(steer.LOW, steer.HIGH, (120, 3)), jnp.float32)
    thetas = algorithm.ask(jax.random.key(0), state, contexts)
    rewards = jnp.asarray(-np.sum((np.asarray(thetas) - 0.3) ** 2, axis=1), jnp.float32)
    state, info = algorithm.tell(state, Batch(contexts, thetas, rewards))
    assert bool(info.is_updated)
    mirror = contexts * jnp.array([[1.0, -1.0, -1.0]])
    signs = np.array([1.0] * 10 + [-1.0, -1.0])
    means, mirrored = algorithm.mean(state, contexts), algorithm.mean(state, mirror)
    np.testing.assert_allclose(mirrored, np.asarray(means) * signs, atol=2e-3)


@pytest.mark.parametrize(("candidates", "tried"), [(1, [20]), (3, [10, 15, 20])])
def test_the_policy_that_stays_up_longest_is_kept_and_the_latest_of_equals(candidates, tried, monkeypatch):
    first = steer.first_policy(SETTINGS)
    swing = steer.STEERED_PARAM_NAMES.index("swing_height")
    # The swing is lower, and falls in this test, at iteration 10 alone.
    coef = jnp.tile(first.coef, (21, 1, 1)).at[10, 0, swing].add(-2.0)

    def drive_all(settings, walker, key, commands, *, noise):
        is_low = walker.gait(jnp.zeros(3)).params.swing_height < 0.03
        return steer.Drive(*[None] * 6, has_fallen=jnp.full((2, 5), is_low))

    monkeypatch.setattr(steer, "drive_all", drive_all)
    settings = dataclasses.replace(SETTINGS, candidates=candidates, candidate_drives=2, candidate_seconds=1.0)
    kept, upright = steer.keep_steadiest(settings, jax.random.key(0), first._replace(coef=coef))
    assert list(upright) == tried and kept == 20
    assert upright[20] == 1.0 and upright.get(10, 0.0) == 0.0


def test_the_time_to_stand_counts_from_the_command_to_stop():
    stage = np.full((2, 700), Stage.WALKING)
    stage[0, 260:] = Stage.STANDING
    np.testing.assert_allclose(steer.time_to_stand(stage), [60 * 0.02, np.inf])


def test_a_policy_of_another_walk_cannot_be_continued():
    path = str(policies_folder() / "walk.npz")
    with pytest.raises(UserError, match="must have the features and bounds"):
        steer.first_policy(dataclasses.replace(SETTINGS, start_policy=path))
