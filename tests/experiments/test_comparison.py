"""Comparisons of learners, and the figures that are made of them."""

import dataclasses
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.errors import UserError
from creps_jax.tools.tables import save_table
from experiments import comparison, fig08_hole, policies, registry, updates
from experiments.fig08_hole import Settings as HoleSettings
from experiments.learning import Session


def made_up(**final):
    """Return arrays of contenders whose mean policies end with the given rewards (trials, contexts)."""
    arrays = {"episodes": np.array([10, 20, 30]), "evaluated": np.array([1, 3])}
    for name, rewards in final.items():
        last = np.array(rewards, float)
        arrays[f"{name}.grid_reward"] = np.stack([last - 7.0, last], axis=1)
    return arrays


def test_regret_is_what_is_missing_to_the_best_known_at_each_context():
    arrays = made_up(a=[[-1.0, -4.0], [-2.0, -3.0]], b=[[-3.0, 0.0], [-5.0, -5.0]])
    # Best known: -1 and 0.
    np.testing.assert_allclose(comparison.regret(arrays, "a"), [2.0, 2.0])
    np.testing.assert_allclose(comparison.regret(arrays, "b"), [1.0, 4.5])


def test_curves_stand_at_the_episodes_of_the_evaluated_iterations():
    episodes, curve = comparison.mean_policy_curve(made_up(a=[[-1.0, -3.0]]), "a")
    np.testing.assert_array_equal(episodes, [10, 30])
    np.testing.assert_allclose(curve, [[-9.0, -2.0]])


def test_a_difference_is_believed_when_all_trials_show_it():
    rng = np.random.default_rng(0)
    good, bad = -rng.uniform(1, 2, (10, 3)), -rng.uniform(2, 3, (10, 3))
    arrays = made_up(good=good, bad=bad, same=good)
    assert comparison.p_value(arrays, "good", "bad") == pytest.approx(2.0**-10)
    assert comparison.p_value(arrays, "bad", "good") == pytest.approx(1.0)
    assert comparison.p_value(arrays, "good", "same") == 1.0


@pytest.mark.usefixtures("simple_updates")
@pytest.mark.parametrize("name", ["fig05_sinus", "fig06_reaching", "fig08_hole"])
def test_a_figure_searches_draws_and_judges(name):
    check_figure(name)


def check_figure(name):
    experiment = importlib.import_module(f"experiments.{name}")
    few = {"iterations": 2, "trials": 2, "samples": 30, "first_samples": 60, "archive_size": 60}
    settings = dataclasses.replace(experiment.SETTINGS["quick"], **few)
    arrays = experiment.run(settings, jax.random.key(0), Session())
    names = [key.removesuffix(".coef") for key in arrays if key.endswith(".coef")]
    assert len(names) >= 2
    np.testing.assert_array_equal(arrays["episodes"], [60, 90])
    for contender in names:
        assert arrays[f"{contender}.sample_reward"].shape == (2, 2)
        assert arrays[f"{contender}.grid_reward"].shape == (2, 2, len(arrays["context"]))
        # Two trials are two searches.
        assert not np.array_equal(*arrays[f"{contender}.sample_reward"])
        assert not np.array_equal(*arrays[f"{contender}.coef"])
    assert len(experiment.plot(arrays)) >= 2
    for claim in experiment.CLAIMS:
        value = claim.measure(arrays)
        # What needs other numbers of RBFs says so.
        assert np.isfinite(value) or "numbers of RBFs" in claim.metric or "20 RBFs" in claim.metric


@pytest.mark.parametrize("name", ["fig06_reaching", "fig08_hole"])
def test_the_arm_is_learned_from_a_full_archive(name):
    for settings in importlib.import_module(f"experiments.{name}").SETTINGS.values():
        assert settings.first_samples == settings.archive_size


def test_the_worst_number_of_rbfs_is_the_worst_of_all():
    rng = np.random.default_rng(0)
    rewards = {"rbf4": -2.0, "rbf6": -1.0, "rbf10": -3.0, "rbf20": -4.0}
    arrays = made_up(**{name: rng.uniform(x, x + 0.5, (10, 3)) for name, x in rewards.items()})
    arrays |= {f"{name}.coef": np.zeros(1) for name in rewards}
    assert fig08_hole._p_of_the_worst(arrays) < 0.05
    arrays["rbf10.grid_reward"] = arrays["rbf20.grid_reward"] - 0.1
    assert fig08_hole._p_of_the_worst(arrays) > 0.9
    del arrays["rbf4.coef"]
    assert np.isnan(fig08_hole._p_of_the_worst(arrays))


def test_updates_are_compared_on_the_same_problem(monkeypatch, tmp_path):
    fits = ("plain", "archive", "bounded")

    def make(key, plan, make=updates.BENCHES["sphere"]):
        bench = make(key, plan)
        return bench._replace(contenders={fit: bench.contenders[fit] for fit in fits})

    monkeypatch.setattr(updates, "BENCHES", {"sphere": make})
    said = []
    settings = updates.Settings(iterations=8, trials=2)
    arrays = updates.run(settings, jax.random.key(0), Session())
    first = [arrays[f"sphere/sphere-{fit}.sample_reward"][:, 0] for fit in fits]
    for other in first[1:]:
        np.testing.assert_array_equal(other, first[0])
    # The unbounded fit moves by many nats, the bounded one by what it may.
    assert arrays["sphere/sphere-plain.policy_kl"].min() > 5.0
    moved = arrays["sphere/sphere-bounded.policy_kl"]
    assert moved.max() == pytest.approx(1.05, rel=0.01)
    assert updates.share_of_episodes(arrays, "sphere") <= 1.0
    assert set(updates.plot(arrays)) == {"learning_curves", "sphere_updates"}
    save_table(updates.table(arrays), tmp_path, said.append)
    assert (tmp_path / "table.md").read_text() == said[0] and "sphere" in said[0]


@pytest.mark.usefixtures("simple_updates")
def test_policies_are_compared_on_the_same_problem(tmp_path):
    settings = policies.Settings(iterations=3, trials=2, tasks=("sinus", "hole"), hidden=7)
    arrays = policies.run(settings, jax.random.key(0), Session(tmp_path))
    for task in settings.tasks:
        found = policies.of_task(arrays, task)
        first = [found[f"{task}-{policy}.sample_reward"][:, 0] for policy in policies.LABELS]
        for other in first[1:]:
            np.testing.assert_allclose(other, first[0], rtol=1e-4)
        sizes = {policy: found[f"{task}-{policy}.coef"].shape[1] for policy in policies.LABELS}
        assert sizes["network"] == 8 and found[f"{task}-network.layers.0.weight"].shape == (2, 1, 7)
    again = policies.run(settings, jax.random.key(0), Session(tmp_path))
    for name, values in arrays.items():
        np.testing.assert_array_equal(again[name], values)
    for claim in policies.CLAIMS:
        assert np.isfinite(claim.measure(arrays)) == (not claim.metric.startswith("via-points"))
    columns = policies.table(arrays)
    assert columns["task"] == ["sinus", "hole"] and list(columns)[1:] == list(policies.LABELS.values())
    assert set(policies.plot(arrays)) == {"learning_curves"}


def test_the_walk_is_one_of_the_tasks_of_the_policies():
    plan = comparison.LearnerSettings(iterations=2, trials=1)
    bench = policies.BENCHES["walk"](plan)
    contenders = policies.make_contenders(bench, policies.Settings(), jax.random.key(0))
    assert set(contenders) == set(policies.LABELS)
    grid = jnp.array([[bench.low], [bench.high]])
    for contender in contenders.values():
        state = contender.algorithm.init(contender.start)
        assert contender.algorithm.mean(state, grid).shape == (2, contender.task.theta_dim)


def test_unknown_tasks_of_the_policies_are_named():
    with pytest.raises(UserError, match="tasks must be some of sinus, reaching, hole, walk, got sinus, jump"):
        policies.Settings(tasks=("sinus", "jump"))
    assert registry.load("policies").SETTINGS["quick"].tasks == ("sinus", "reaching", "hole")


def test_the_table_of_the_hole_tells_collisions_from_what_is_left():
    collides = np.zeros((2, 25), bool)
    collides[:, 0] = True
    reward = np.where(collides, -1e7, -5e3)[:, None]
    arrays = {"linear.coef": reward, "linear.collides": collides, "linear.grid_reward": reward}
    arrays |= {"rbf6.coef": reward, "rbf6.collides": np.ones((2, 25), bool), "rbf6.grid_reward": reward}
    assert fig08_hole.table(arrays) == {
        "policy": ["linear", "rbf6"],
        "collides": ["4%", "100%"],
        "at the ends": ["17%", "100%"],
        "else": ["-5,000", ""],
    }


def test_the_hole_needs_the_number_of_rbfs_of_the_paper():
    with pytest.raises(UserError, match=r"must have 6, the paper's, among them, got \(2, 4\)"):
        HoleSettings(num_centers=(2, 4))
