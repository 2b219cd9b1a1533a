"""The walk on slopes with a stand-in for the physics: contexts, first policy, maps, files."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.files import policies_folder
from creps_jax.policies.learned import load
from creps_jax.tasks.base import Task
from creps_jax.tasks.walking import WalkOutcome, WalkRecord
from creps_jax.tools import play
from creps_jax.tools.video import Clip
from creps_jax.walking.params import PARAM_NAMES
from experiments import request, runner, walk, walk_slope
from experiments.walking import learning as walk_learning

STEEPEST = 9.0


def stand_in(low, high, *, sample_context, duration, conditions, **_) -> Task:
    """Return a task in which a slope takes from the speed, and the steepest one makes the robot fall."""
    del low, high
    assert [condition.name for condition in conditions] == ["slope"]

    def rollout(key, context, theta):
        speed = theta[7] / theta[3] - 0.005 * context[1]
        fell = context[1] > STEEPEST
        reward = -10.0 * (speed - context[0]) ** 2 - 100.0 * fell.astype(jnp.float32)
        both = jnp.stack([speed, jnp.zeros_like(speed)])
        return WalkOutcome(reward, jnp.zeros(0), fell, both, jnp.float32(duration))

    return Task(sample_context, rollout, context_dim=2, theta_dim=len(PARAM_NAMES), worst_reward=-200.0)


@pytest.fixture
def settings(tmp_path, monkeypatch):
    """Work in an empty folder, without physics and without a camera."""
    small = {"iterations": 2, "trials": 2, "eval_seeds": 3, "first_samples": 30, "samples": 30}
    settings = dataclasses.replace(walk_slope.SETTINGS["quick"], **small)
    clips = [Clip("caption", np.zeros((5, 29)), 0.02)]
    monkeypatch.setattr(walk_learning, "nao_walk", stand_in)
    monkeypatch.setattr(walk_slope, "record", lambda policy, speeds, **_: clips)
    monkeypatch.setattr(walk_slope, "save_film", lambda clips, path, say, robot: say(f"video: {path}"))
    monkeypatch.setattr(walk_slope, "SETTINGS", {"quick": settings})
    monkeypatch.chdir(tmp_path)
    return settings


@pytest.mark.usefixtures("simple_updates")
def test_the_result_folder_is_complete(settings):
    said = []
    folder = runner.run(
        request.Request("walk_slope", walk_slope.SETTINGS["quick"]), console=None, say=said.append
    )
    names = "arrays.npz manifest.json checkpoint-walk_slope.npz claims.md policy.npz table.md"
    figures = "learning_curve.png updates.png falls.png speed.png parameters.png"
    assert {path.name for path in folder.iterdir()} == {*names.split(), *figures.split()}
    arrays = files.load_arrays(folder / "arrays.npz")
    speeds, slopes = arrays["speeds"], arrays["slopes"]
    np.testing.assert_allclose(speeds, [0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4], rtol=1e-6)
    np.testing.assert_allclose(slopes, [-10, -7.5, -5, -2.5, 0, 2.5, 5, 7.5, 10])
    assert arrays["fell"].shape == (2, 7, 9, 3)

    # Numbers lie at the speed and the slope that they are of, and the file's policy is the one evaluated.
    policy, trial = load(folder / "policy.npz"), walk.chosen_trial(arrays)
    assert policy.contexts.names == ("speed", "slope") and policy.contexts.units == ("m/s", "deg")
    for i, j in ((0, 0), (2, 7), (6, 3)):
        theta = policy.theta(float(speeds[i]), float(slopes[j]))
        np.testing.assert_allclose(arrays["theta"][trial, i, j], theta, rtol=1e-4, atol=1e-6)
        expected = theta[7] / theta[3] - 0.005 * slopes[j]
        np.testing.assert_allclose(arrays["speed"][trial, i, j, :, 0], expected, atol=1e-5)
    np.testing.assert_array_equal(arrays["start.fell"], arrays["fell"][0])
    claims = {claim.metric: claim.measure(arrays) for claim in walk_slope.CLAIMS}
    assert claims["falls on slopes up to 5 degrees"] == 0
    assert claims["share of falls on all slopes"] == pytest.approx(1 / 9)
    rows = (folder / "table.md").read_text().splitlines()
    assert rows[-1].split("|")[1].strip() == "+10" and "21/21" in rows[-1]
    assert rows[2].split("|")[1].strip() == "-10" and "0/21" in rows[2]


def test_contexts_are_drawn_a_little_beyond_both_ranges(settings):
    sample = walk_learning.make_task(settings).sample_context
    contexts = np.asarray(jax.vmap(sample)(jax.random.split(jax.random.key(0), 2000)))
    np.testing.assert_allclose(contexts.min(axis=0), [0.08, -11.0], atol=0.05)
    np.testing.assert_allclose(contexts.max(axis=0), [0.42, 11.0], atol=0.05)


def test_learning_begins_with_the_shipped_walk_on_every_slope(settings):
    start = walk_learning.as_learned(settings, walk_slope.warm_start(settings))
    shipped = load(policies_folder() / "walk.npz")
    width = np.subtract(shipped.parameters.high, shipped.parameters.low)
    for speed in (0.1, 0.22, 0.4):
        for degrees in (-10.0, 1.0, 10.0):
            # 3 RBFs along the speed follow its 5 so far.
            np.testing.assert_array_less(
                np.abs(start.theta(speed, degrees) - shipped.theta(speed)), 0.06 * width
            )


def test_a_first_policy_of_other_bounds_is_refused(settings):
    with pytest.raises(UserError, match=r"walk.npz has other bounds than sigmoid within paper"):
        walk_slope.warm_start(dataclasses.replace(settings, bounds="paper"))


def test_the_first_policy_is_the_shipped_one_of_the_robot(settings):
    h25 = dataclasses.replace(settings, robot="nao_h25", low=0.1, high=0.3)
    start = walk_learning.as_learned(h25, walk_slope.warm_start(h25))
    shipped = load(policies_folder("nao_h25") / "walk.npz")
    width = np.subtract(shipped.parameters.high, shipped.parameters.low)
    np.testing.assert_array_less(np.abs(start.theta(0.2, 5.0) - shipped.theta(0.2)), 0.1 * width)


def test_speeds_that_the_first_policy_does_not_know_are_refused(settings):
    message = r"low and high must be within the speeds of .*walk\.npz, 0\.05 to 0\.3 m/s, got 0\.1 and 0\.4"
    with pytest.raises(UserError, match=message):
        walk_slope.warm_start(dataclasses.replace(settings, robot="nao_h25"))


def test_films_show_each_walk_on_its_slope(settings, monkeypatch):
    def recorded(key, theta, *, values, duration, balance, physics, conditions, robot, com):
        del key, theta, balance, physics, robot
        assert com == "one_step"
        assert [condition.name for condition in conditions] == ["slope"]
        time = 0.02 * jnp.arange(1.0, 1 + round(duration / 0.02))
        qpos = jnp.zeros((len(time), 29)).at[:, 0].set(0.1 * values[0] * time)
        return WalkRecord(time, qpos, qpos, qpos, jnp.zeros(len(time), bool))

    policy = walk_learning.as_learned(settings, walk_learning.first_policy(settings))
    monkeypatch.setattr(play, "record_walk", recorded)
    clips = play.record(policy, (0.2, 0.3), seed=0, slopes=(2.0, -4.0))
    assert [clip.slope for clip in clips] == [2.0, -4.0]
    captions = [clip.caption for clip in clips]
    assert captions[0] == "slope 2°, asked 0.20 m/s, reached 0.20 m/s"
    assert captions[1] == "slope -4°, asked 0.30 m/s, reached -0.40 m/s"
    with pytest.raises(UserError, match="slope must be within its range, -10 to 10 deg, got 12"):
        play.record(policy, (0.2,), seed=0, slopes=(12.0,))


def test_settings_come_back_from_a_manifest(settings):
    assert walk_slope.Settings(**dataclasses.asdict(settings)) == settings
