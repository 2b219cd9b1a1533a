"""The walking experiment with a stand-in for the physics: everything but the robot."""

import csv
import dataclasses
import json
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.policies.bounds import RUN_CONSTRAINTS
from creps_jax.policies.feature_settings import Features
from creps_jax.policies.learned import load
from creps_jax.robots.robot import NAO, NAO_H25
from creps_jax.simulation import c
from creps_jax.tasks.base import Task
from creps_jax.tasks.walking import WalkOutcome, nao_walk
from creps_jax.tools import play, results, tables
from creps_jax.tools.cli import main as tools
from creps_jax.tools.play import balance_of, load_walking_policy, robot_of, shipped_policy
from creps_jax.tools.robots import ROBOTS
from creps_jax.tools.session.plain import read
from creps_jax.tools.video import Clip, VideoError
from creps_jax.training import evaluate
from creps_jax.walking.params import (
    AUTHOR_BOUNDS,
    NAO_BOUNDS,
    NAO_H25_BOUNDS,
    PAPER_BOUNDS,
    PARAM_NAMES,
)
from creps_jax.walking.posture import Balance
from experiments import claims, fig11_walk, registry, request, runner, walk, walk_slope
from experiments.cli import main
from experiments.walking import learning as walk_learning
from experiments.walking.settings import BOUNDS, PHYSICS, SAMPLERS

SHIPPED = shipped_policy()


def stand_in(low, high, *, sample_context, duration, **_) -> Task:
    """Return a task in which the step length over the step duration is the speed."""
    del low, high

    def rollout(key, context, theta):
        speed = jnp.stack([theta[7] / theta[3], jnp.zeros_like(theta[0])])
        fell = speed[0] > 0.9
        reward = -10.0 * (speed[0] - context[0]) ** 2 - 100.0 * fell.astype(jnp.float32)
        return WalkOutcome(reward, jnp.zeros(0), fell, speed, jnp.float32(duration))

    return Task(sample_context, rollout, context_dim=1, theta_dim=len(PARAM_NAMES), worst_reward=-200.0)


@pytest.fixture
def bench(tmp_path, monkeypatch):
    """Work in an empty folder, without physics and without a camera."""
    filmed = []
    clips = [Clip("asked 0.30 m/s, reached 0.30 m/s", np.zeros((5, 29)), 0.02)]
    settings = walk.Settings(iterations=2, trials=2, eval_seeds=3, first_samples=30, samples=30)
    monkeypatch.setattr(walk_learning, "nao_walk", stand_in)
    for module in (walk, play):
        monkeypatch.setattr(module, "record", lambda policy, speeds, **_: (policy.theta(speeds[0]), clips)[1])
    monkeypatch.setattr(play, "write_video", lambda path, *_, **__: filmed.append(path))
    monkeypatch.setattr(walk, "SETTINGS", {"quick": settings})
    monkeypatch.chdir(tmp_path)
    return filmed


def test_the_result_folder_is_complete(bench):
    folder = runner.run(request.Request("walk", walk.SETTINGS["quick"]), console=None, say=lambda _: None)
    names = "arrays.npz manifest.json checkpoint-walk.npz claims.md policy.npz table.csv table.md"
    figures = "learning_curve.png parameters.png speed.png updates.png"
    assert {path.name for path in folder.iterdir()} == {*names.split(), *figures.split()}
    assert bench == [folder / "walk.mp4"]
    arrays = files.load_arrays(folder / "arrays.npz")
    assert arrays["reward"].shape == (2, 11, 3)
    assert arrays["speed"].shape == (2, 11, 3, 2)
    assert arrays["fine_theta"].shape == (2, 51, 10)
    np.testing.assert_array_equal(arrays["episodes"], [90, 180])
    assert arrays["trial_reward"].shape == (2,)

    # The file's policy does what was evaluated, and the table says so.
    policy, trial = load(folder / "policy.npz"), walk.chosen_trial(arrays)
    reached = [policy.theta(float(speed))[7] / policy.theta(float(speed))[3] for speed in arrays["speeds"]]
    np.testing.assert_allclose(arrays["speed"][trial, :, 0, 0], reached, rtol=1e-4)
    with (folder / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    np.testing.assert_allclose([float(row["reached m/s"]) for row in rows], reached, rtol=1e-4)
    assert rows[0]["paper RBF"] == "-0.166"

    said = []
    play.show([0.3], None, out=Path("results/walk.mp4"), seed=0, say=said.append)
    assert said[0] == f"policy: {folder / 'policy.npz'}"
    assert said[-1] == "video: results/walk.mp4"


def test_the_policy_is_kept_that_walks_best_in_the_noise_of_learning(bench, monkeypatch):
    asked = []
    walk_at_all_speeds = walk_learning.walk_at_all_speeds

    def watched(settings, key, policy, *, noise=1.0):
        asked.append((noise, jax.random.key_data(key).tolist()))
        return walk_at_all_speeds(settings, key, policy, noise=noise)

    monkeypatch.setattr(walk_learning, "walk_at_all_speeds", watched)
    arrays = walk.run(dataclasses.replace(walk.SETTINGS["quick"], learning_noise=1.6), jax.random.key(0))
    assert [noise for noise, _ in asked] == [1.6, 1.0]
    # What chooses does not judge.
    assert asked[0][1] != asked[1][1]
    for best in (0, 1):
        arrays["trial_reward"] = np.where(np.arange(2) == best, -1.0, -2.0)
        assert walk.chosen_trial(arrays) == best


def test_of_several_iterations_the_best_is_kept_and_the_latest_of_equals(bench, monkeypatch):
    settings = dataclasses.replace(walk.SETTINGS["quick"], iterations=5, candidates=3)
    tried = []

    def walks(of_candidates):
        def walk_at_all_speeds(settings, key, policy, *, noise=1.0):
            tried.append(np.asarray(policy.coef))
            reward = np.array(of_candidates if len(policy.coef) == 6 else [0.0, 0.0])
            reward = np.broadcast_to(reward[:, None, None], (len(reward), 11, 3))
            return settings.speeds(), WalkOutcome(*[reward] * 5)

        monkeypatch.setattr(walk_learning, "walk_at_all_speeds", walk_at_all_speeds)
        return walk.run(settings, jax.random.key(0))

    # Candidates of each of the two trials: the iterations 5, 4 and 3.
    arrays = walks([-2.0, -1.0, -3.0, -1.0, -1.0, -2.0])
    np.testing.assert_array_equal(arrays["kept"], [4, 5])
    np.testing.assert_array_equal(arrays["trial_reward"], [-1.0, -1.0])
    candidates, kept = tried
    np.testing.assert_array_equal(kept, candidates[[1, 3]])
    np.testing.assert_array_equal(arrays["coef"], kept)
    assert not (candidates[0] == candidates[1]).all()


@pytest.mark.usefixtures("simple_updates")
def test_ways_to_learn_are_compared_from_the_same_start(bench, tmp_path):
    settings = dataclasses.replace(walk.SETTINGS["quick"], mean_kl_bound=0.5, cov_kl_bound=0.05)
    key = jax.random.key(0)
    arrays = fig11_walk.run(settings, key)
    for name in fig11_walk.CONTENDERS:
        assert arrays[f"{name}.episodes"].shape == (2,)
        assert arrays[f"{name}.sample_reward"].shape == (2, 2)
        assert arrays[f"{name}.reward"].shape == (2, 11, 3)
    # The same samples but for how they are kept within bounds and what features round.
    first = {name: arrays[f"{name}.sample_reward"][:, 0] for name in fig11_walk.CONTENDERS}
    np.testing.assert_allclose(first["rbf"], first["unbounded"])
    np.testing.assert_allclose(first["rbf"], first["linear"], rtol=1e-3)
    assert (first["penalty"] < first["linear"] - 100).all()
    assert set(fig11_walk.plot(arrays)) == {"learning_curve", "final"}
    said = []
    tables.save_table(fig11_walk.table(arrays), tmp_path, said.append)
    assert (tmp_path / "table.md").read_text() == said[0]
    assert len(said[0].splitlines()) == 2 + 11 and "-3338.082" in said[0]
    for claim in fig11_walk.CLAIMS:
        assert claim.measure(arrays) >= 0
    # A mean of five of our iterations is as good as the other's last after the ninth, of its 930 episodes.
    steps = np.arange(12.0)
    curves = {"rbf.episodes": 90 * (steps + 1), "rbf.sample_reward": np.tile(steps, (3, 1))}
    curves |= {"plain.episodes": 300 + 90 * steps[:8], "plain.sample_reward": np.full((3, 8), 6.0)}
    assert fig11_walk.share_of_episodes(curves, "plain") == pytest.approx(810 / 930)
    assert arrays["rbf.halfway_reward"].shape == (2, 11, 3)
    lacks = {"rbf.halfway_reward": np.full((3, 2, 2), -1.0), "plain.reward": np.full((3, 2, 2), -4.0)}
    assert fig11_walk.halfway_ratio(lacks) == 0.25
    lack = 1.0 / np.arange(1.0, 6.0)[:, None, None]
    assert fig11_walk.p_value({"a.reward": -lack, "b.reward": -2 * lack}, "a", "b") == pytest.approx(2.0**-5)


def test_a_penalised_search_starts_where_a_squashed_one_does():
    settings = dataclasses.replace(walk.SETTINGS["quick"], constraint="penalty")
    low, high = (np.array(bound) for bound in settings.box())
    start = walk_learning.first_policy(settings)
    np.testing.assert_allclose(start.coef[0], low + (high - low) / (1 + np.exp(0.3)), rtol=1e-5, atol=1e-6)
    # The slope of the sigmoid there, 0.244, times the standard deviation of one before it.
    np.testing.assert_allclose(jnp.diagonal(start.cov_chol), 0.2445 * (high - low), rtol=1e-3)


def test_a_run_with_a_penalty_keeps_a_policy_that_is_clipped_to_the_bounds(bench):
    settings = dataclasses.replace(walk.SETTINGS["quick"], constraint="penalty")
    folder = runner.run(request.Request("walk", settings), console=None, say=lambda _: None)
    policy, arrays = load(folder / "policy.npz"), files.load_arrays(folder / "arrays.npz")
    assert policy.parameters.constraint == "clip"
    trial = walk.chosen_trial(arrays)
    thetas = np.stack([policy.theta(float(speed)) for speed in arrays["speeds"]])
    np.testing.assert_allclose(arrays["speed"][trial, :, 0, 0], thetas[:, 7] / thetas[:, 3], rtol=1e-4)


def listed(names):
    *first, last = names
    return f"{', '.join(first)} or {last}"


def test_the_help_lists_the_values_of_settings():
    text = " ".join((walk.Settings.__doc__ or "").split())
    for name, values in (
        ("robot: robot that walks", [*ROBOTS, "the .toml file that describes a humanoid"]),
        ("bounds: bounds of the parameters", BOUNDS),
        ("constraint: limit on the parameters at their bounds", RUN_CONSTRAINTS),
        ("sampler: distribution of the contexts in learning", SAMPLERS),
        ("physics: simulation of the robot", PHYSICS),
    ):
        assert f"{name}: {listed(values)}" in text


def test_mistakes_are_one_clear_line(bench, monkeypatch, capsys):
    monkeypatch.setattr(play, "policies_folder", lambda robot: Path("none"))
    Path("bad.npz").write_text("no policy")
    for match, arguments in (
        ("no policy has been learned yet", ["play", "--speed", "0.3"]),
        ("one: python -m experiments run walk --robot nao_h25 --", ["play", "--robot", "nao_h25"]),
        ("unknown robot 'nao_h26', did you mean 'nao_h25'?", ["play", "--robot", "nao_h26"]),
        ("cannot read bad.npz", ["play", "--speed", "0.3", "--policy", "bad.npz"]),
        ("no such file: none.npz", ["play", "--policy", "none.npz"]),
    ):
        assert tools(arguments) == 2
        error = capsys.readouterr().err
        assert match in error
        assert len(error.splitlines()) == 1
    settings = walk.SETTINGS["quick"]
    walk_learning.as_learned(settings, walk_learning.first_policy(settings)).save(Path("p.npz"))
    assert tools(["play", "--speed", "0.9", "--policy", "p.npz"]) == 2
    assert "within its range, 0.1 to 0.6 m/s, got 0.9" in capsys.readouterr().err
    assert tools(["play", "--speed", "0.5", "--policy", "p.npz"]) == 0


@pytest.mark.parametrize("task", [{"heading_gain": 0.3}, {"balance": {"ankle": 1.0}}, {"balance": None}])
def test_a_policy_that_was_balanced_otherwise_is_refused(tmp_path, task):
    settings = walk.SETTINGS["quick"]
    saved = walk_learning.as_learned(settings, walk_learning.first_policy(settings))
    saved.save(tmp_path / "p.npz")
    assert balance_of(load_walking_policy(tmp_path / "p.npz")) == Balance(0.3, 0.6) == settings.balance()
    dataclasses.replace(saved, task=task).save(tmp_path / "p.npz")
    with pytest.raises(UserError, match=r"p.npz must have the balance of its steps, heading"):
        load_walking_policy(tmp_path / "p.npz")


def test_a_machine_without_opengl_only_lacks_the_video(bench, monkeypatch):
    def fail(*_, **__):
        raise VideoError("no video: OpenGL is not to be had; apt-get install ...")

    monkeypatch.setattr(play, "write_video", fail)
    settings, said = walk.SETTINGS["quick"], []
    walk_learning.as_learned(settings, walk_learning.first_policy(settings)).save(Path("p.npz"))
    play.show([0.3], Path("p.npz"), out=Path("walk.mp4"), seed=0, say=said.append)
    assert said[-2].startswith("asked 0.30")
    assert "apt-get" in said[-1]


@pytest.mark.parametrize("kind", ["linear", "polynomial", "rbf"])
def test_the_first_policy_is_the_same_for_every_speed(kind):
    settings = walk.Settings(features=Features(kind), start_mean=-0.5, low=0.1, high=0.6)
    policy = walk_learning.as_learned(settings, walk_learning.first_policy(settings))
    for speed in (0.1, 0.25, 0.6):
        np.testing.assert_allclose(policy.mean(speed), np.full(10, -0.5), rtol=1e-5)


def test_settings_within_settings_are_options(bench):
    options = ["--features.num-centers", "7", "--kl-bound", "1", "--iterations", "1", "--trials", "1"]
    assert main(["run", "walk", *options, "--out", "seven"]) == 0
    kept = results.load_manifest(Path("seven"))["settings"]
    assert (kept["features"]["num_centers"], kept["kl_bound"]) == (7, 1.0)


def test_polynomials_of_a_run_of_an_earlier_version_are_not_scaled():
    given = dataclasses.asdict(walk.Settings(features=Features("polynomial")))
    del given["features"]["scaled"]
    settings = request.settings_of(registry.load("walk"), Path("run"), {"settings": given})
    assert settings.features == Features("polynomial", scaled=False)


@pytest.mark.parametrize("num_centers", [None, 4, (4, 3)])
def test_the_numbers_of_centres_come_back_from_a_manifest(num_centers):
    settings = walk_slope.Settings(features=Features("rbf", num_centers))
    assert walk_slope.Settings(**dataclasses.asdict(settings)) == settings
    manifest = json.loads(json.dumps(dataclasses.asdict(settings)))
    assert read(walk_slope.Settings, manifest, "settings") == settings
    features = settings.features.make(*settings.context_range())
    assert features.size == {None: 9, 4: 16, (4, 3): 12}[num_centers]


def test_each_context_can_have_its_own_number_of_centres_on_the_command_line(capsys):
    options = ["--features.num-centers", "5", "3", "2", "--out", "three"]
    assert main(["run", "walk_slope", *options]) == 2
    wanted = r"num_centers must be one number or 2, one for each axis, got (5, 3, 2)"
    assert wanted in capsys.readouterr().err


def test_a_run_can_go_on_from_a_policy(tmp_path):
    settings = walk.SETTINGS["best"]
    shipped = dataclasses.replace(settings, start_policy=str(SHIPPED))
    start, loaded = walk_learning.first_policy(shipped), load(SHIPPED)
    jax.tree.map(np.testing.assert_array_equal, start, loaded.policy)
    for other in ({"bounds": "paper"}, {"features": Features("rbf", 4)}, {"high": 0.5}):
        with pytest.raises(UserError, match=r"walk\.npz has other features or bounds"):
            walk_learning.first_policy(dataclasses.replace(shipped, **other))


def test_settings_come_back_from_a_manifest():
    settings = walk.Settings(features=Features("linear"))
    assert walk.Settings(**dataclasses.asdict(settings)) == settings


def test_a_robot_brings_its_speeds_and_its_box_and_is_kept_with_the_policy(monkeypatch, tmp_path):
    asked = {}
    monkeypatch.setattr(
        walk_learning,
        "nao_walk",
        lambda *bounds, **settings: asked.update(settings) or stand_in(*bounds, **settings),
    )
    np.testing.assert_array_equal(walk.Settings().speeds(), np.float32(tables.PAPER_SPEEDS))
    assert walk.Settings().box() == NAO_BOUNDS
    settings = dataclasses.replace(walk.SETTINGS["quick"], robot="nao_h25")
    assert settings.box() == NAO_H25_BOUNDS
    assert dataclasses.replace(settings, bounds="paper").box() == PAPER_BOUNDS
    assert dataclasses.replace(settings, bounds="author").box() == AUTHOR_BOUNDS
    contexts = jax.vmap(walk_learning.make_task(settings).sample_context)(
        jax.random.split(jax.random.key(0), 500)
    )
    assert asked["robot"] is NAO_H25
    low, high = ROBOTS["nao_h25"].low, ROBOTS["nao_h25"].high
    np.testing.assert_allclose([contexts.min(), contexts.max()], [low - 0.02, high + 0.02], atol=5e-3)
    np.testing.assert_allclose(settings.speeds()[[0, -1]], [low, high], rtol=1e-6)
    assert not tables.are_the_papers(settings.speeds())

    saved = walk_learning.as_learned(settings, walk_learning.first_policy(settings))
    saved.save(tmp_path / "p.npz")
    assert robot_of(load_walking_policy(tmp_path / "p.npz")) is NAO_H25
    # Files from before there was a choice are the NAO's.
    dataclasses.replace(saved, task={"balance": saved.task["balance"]}).save(tmp_path / "old.npz")
    assert robot_of(load_walking_policy(tmp_path / "old.npz", "nao")) is NAO
    dataclasses.replace(saved, task={**saved.task, "robot": "pepper"}).save(tmp_path / "odd.npz")
    with pytest.raises(UserError, match=r"odd\.npz: .* robot 'pepper', not of nao, nao_h25: name the file"):
        load_walking_policy(tmp_path / "odd.npz")


@pytest.mark.parametrize(
    "command",
    [["play", "--speed", "0.2"], ["export", "--to", "w.csv", "--speed", "0.2"]],
    ids=lambda command: command[0],
)
def test_a_policy_of_another_robot_is_refused(bench, capsys, command):
    settings = walk.SETTINGS["quick"]
    walk_learning.as_learned(settings, walk_learning.first_policy(settings)).save(Path("p.npz"))
    assert tools([*command, "--policy", "p.npz", "--robot", "nao_h25"]) == 2
    assert capsys.readouterr().err == "error: p.npz: the policy is of the robot nao, not of nao_h25\n"
    assert not Path("w.csv").exists() and not bench


def test_each_robot_has_its_latest_run(bench):
    shipped = play.default_policy("nao_h25")
    assert shipped == shipped_policy("nao_h25") != play.default_policy()
    settings = dataclasses.replace(walk.SETTINGS["quick"], robot="nao_h25")
    folder = runner.run(request.Request("walk", settings), console=None, say=lambda _: None)
    assert play.default_policy("nao_h25") == folder / "policy.npz"
    assert play.default_policy() == play.default_policy("nao") == SHIPPED
    kept = results.load_manifest(folder)["settings"]
    assert (kept["robot"], kept["low"], kept["high"], kept["bounds"]) == ("nao_h25", 0.05, 0.3, "nao_h25")
    assert kept["physics"] == ("c" if jax.default_backend() == "cpu" else "mjx")
    # The paper says nothing about it.
    assert not (folder / "claims.md").exists() and "paper" not in (folder / "table.md").read_text()
    said = []
    assert claims.check(("walk",), say=said.append)
    assert said[0].startswith("walk: no results yet")


def test_films_show_six_speeds_of_the_policys_range():
    nao, h25 = (load_walking_policy(shipped_policy(robot)) for robot in ROBOTS)
    assert play.filmed_speeds(nao) == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
    ranges = ROBOTS["nao_h25"]
    assert play.filmed_speeds(h25)[0] == ranges.low
    assert play.filmed_speeds(h25)[-1] == ranges.high


@pytest.mark.parametrize(
    ("name", "known"), [("bounds", "nao, nao_h25, author, paper"), ("physics", "auto, mjx, c")]
)
def test_unknown_names_are_refused(name, known):
    with pytest.raises(UserError, match=f"{name} must be one of {known}, got 'moon'"):
        walk.Settings(**{name: "moon"})


@pytest.mark.parametrize("name", PHYSICS)
def test_physics_is_what_is_asked_for(monkeypatch, name):
    asked = {}
    monkeypatch.setattr(
        walk_learning,
        "nao_walk",
        lambda *bounds, **settings: asked.update(settings) or stand_in(*bounds, **settings),
    )
    walk_learning.make_task(walk.Settings(physics=name))
    assert asked["physics"] is PHYSICS[name]


@pytest.mark.parametrize(("platform", "name"), [("cpu", "c"), ("gpu", "mjx")])
def test_the_faster_physics_of_the_machine_are_chosen(monkeypatch, platform, name):
    monkeypatch.setattr(jax, "default_backend", lambda: platform)
    monkeypatch.setitem(PHYSICS, name, lambda model, num_substeps: (model, num_substeps))
    assert PHYSICS["auto"]("model", 5) == ("model", 5)
    assert walk.Settings().resolved().physics == name


def test_what_is_chosen_where_a_run_starts_is_what_is_meant_there():
    for settings in (walk.SETTINGS["best"], walk.SETTINGS["paper"], walk.Settings(robot="nao_h25", high=0.2)):
        resolved = settings.resolved()
        assert (resolved.context_range(), resolved.box()) == (settings.context_range(), settings.box())
        assert None not in (resolved.low, resolved.high, resolved.bounds)
    assert walk.SETTINGS["paper"].resolved().bounds == "paper"
    asked = walk.Settings(low=0.2, bounds="paper", physics="mjx").resolved()
    assert (asked.low, asked.high, asked.bounds, asked.physics) == (0.2, 0.6, "paper", "mjx")


def unfinished(name, settings):
    """Leave a folder as an interrupted run does, and return it."""
    folder = Path("results/walk") / name
    manifest = results.make_manifest("walk", "quick", walk.SETTINGS["quick"], 0)
    manifest |= {"settings": settings, "status": "interrupted", "started": name}
    files.save_json(folder / results.MANIFEST, manifest)
    return folder


def test_resume_finds_the_latest_unfinished_run_of_the_robot(bench):
    settings = {
        robot: dataclasses.asdict(dataclasses.replace(walk.SETTINGS["quick"], robot=robot).resolved())
        for robot in ROBOTS
    }
    others = unfinished("1", settings["nao_h25"])
    ours = unfinished("2", settings["nao"])
    for robot, folder in ((None, ours), ("nao", ours), ("nao_h25", others)):
        found = request.folder_to_resume("walk", None, robot)
        assert found == folder
        assert request.default_settings(walk, "walk", out=found, resume=True).robot == (robot or "nao")
    shutil.rmtree(others)
    with pytest.raises(UserError, match="no unfinished run of walk with the robot nao_h25 in results"):
        request.folder_to_resume("walk", None, "nao_h25")


@pytest.mark.parametrize("physics", ["mjx", "auto"])
def test_a_run_is_resumed_with_the_settings_of_its_manifest(bench, physics):
    settings = dataclasses.asdict(dataclasses.replace(walk.SETTINGS["quick"].resolved(), physics=physics))
    unfinished("1", settings)
    begin = request.default_settings(walk, "walk", resume=True)
    resumed, _, manifest = request.resumed(walk, request.Request("walk", begin, resume=True))
    del settings["iterations"]
    identity = request.identity("walk", resumed, manifest["seed"])
    # A run that began before these settings existed goes on.
    for name in ("degree", "num_points", "scaled"):
        del settings["features"][name]
    assert (identity["experiment"], identity["settings"]) == ("walk", settings)
    assert resumed.physics == physics


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.usefixtures("relaxed_promotion")
def test_the_shipped_policy_walks_at_the_asked_speed(robot):
    policy = load_walking_policy(shipped_policy(robot), robot)
    (low,), (high,) = policy.contexts.low, policy.contexts.high
    assert (low, high) == (ROBOTS[robot].low, ROBOTS[robot].high)
    speeds = low + jnp.array([[0.0], [0.3], [0.7], [1.0]]) * (high - low)
    thetas = jnp.stack([jnp.asarray(policy.theta(float(speed))) for (speed,) in speeds])
    physics = {"robot": robot_of(policy), "physics": c.make_control_step}
    task = nao_walk(duration=4.0, balance=balance_of(policy), **physics)
    outcome = evaluate(jax.random.key(0), task, speeds, thetas, repeats=4)
    assert not outcome.fell.any()
    np.testing.assert_allclose(outcome.speed[..., 0].mean(axis=1), speeds[:, 0], atol=0.05)
