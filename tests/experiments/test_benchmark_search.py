"""The comparison of searches: what it prints and draws, and the searches that only it has."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import creps_jax as cj
from creps_jax.errors import UserError
from creps_jax.tasks.functions import sphere
from experiments.benchmarks import search
from experiments.benchmarks.contextual_cma import contextual_cma
from experiments.benchmarks.search_tasks import PROBLEMS, function, quadratic
from experiments.learning import trial_keys

KEYS = trial_keys(jax.random.key(1), 2)


def test_prints_a_table_for_each_task_and_draws_the_regrets(monkeypatch, capsys, tmp_path):
    cheap = {name: search.LEARNERS[name] for name in ("random", "contextual CMA-ES", "CMA-ES x 4")}
    monkeypatch.setattr(search, "LEARNERS", cheap)
    monkeypatch.setattr(search.importlib.util, "find_spec", lambda name: None)
    search.main(tasks=("quadratic5,hole",), trials=1, out=tmp_path, episodes=40)
    out = capsys.readouterr().out
    assert "CMA-ES x 4 is left out: the package cma is not installed" in out
    tables = out.split("search |")
    assert len(tables) == 3 and all("quartiles | episodes | seconds" in table for table in tables[1:])
    assert (tmp_path / "regret.png").stat().st_size > 10_000
    with np.load(tmp_path / "regret.npz") as arrays:
        assert arrays["hole/random/regret"].shape == (1, 10)
        assert arrays["quadratic5/contextual CMA-ES/episodes"].tolist() == [10, 20, 30, 40]
        assert all(np.isfinite(arrays[name]).all() for name in arrays.files)


@pytest.mark.parametrize("name", ["creps", "bounded", "surrogate"])
def test_the_searches_of_the_library_learn(name):
    problem = dataclasses.replace(quadratic(2, 1, 40, 10), episodes=40)
    curve = search.measure(problem, search.LEARNERS[name], KEYS)
    assert curve.episodes.tolist() == [10, 20, 30, 40] and curve.regret.shape == (2, 4)
    first = search.regret_of(problem, problem.start.coef)
    assert (curve.regret[:, -1] < first).all()


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_searches_accept_the_features_and_the_first_policy_of_each_task(name):
    problem = PROBLEMS[name]()
    for make in (search.weighted, search.bounded, search.by_model):
        make(problem).init(problem.start)
    assert problem.features(problem.tried).shape == (4, problem.features.size)
    assert float(search.regret_of(problem, problem.start.coef)) > 0


def test_contextual_cma_and_random_search_solve_a_sphere():
    problem = dataclasses.replace(function(sphere, 3), episodes=6000, samples=30)
    for learner, limit in (
        (partial(search.learn, lambda it: contextual_cma(it.features)), 1e-3),
        (search.random_search, 1e-2),
    ):
        curve = search.measure(problem, learner, KEYS)
        assert curve.regret[:, -1].max() < limit < curve.regret[:, 0].min()


def test_separate_cma_solves_a_sphere():
    pytest.importorskip("cma")
    problem = dataclasses.replace(function(sphere, 3), episodes=2000)
    curve = search.measure(problem, search.separate_cma, KEYS)
    assert curve.regret[:, -1].max() < 1e-6


def test_cma_is_invariant_to_the_order_of_samples(key):
    features = cj.linear_features(2)
    cma = contextual_cma(features)
    state = cma.init(cj.start_policy(features, 3))
    contexts = jax.random.normal(key, (12, 2))
    theta = cma.ask(key, state, contexts)
    batch = cj.Batch(contexts, theta, -jnp.sum(theta**2, axis=1))
    found, _ = cma.tell(state, batch)
    turned, _ = cma.tell(state, jax.tree.map(lambda x: x[::-1], batch))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), found, turned)


@pytest.mark.parametrize(
    ("names", "trials", "episodes", "message"),
    [
        (["sphere", "cube"], 1, None, "tasks must be among sphere, .*, got 'cube'"),
        (["sphere"], 0, None, "trials must be at least 1, got 0"),
        (["sphere"], 1, 0, "episodes must be at least 1, got 0"),
    ],
)
def test_what_cannot_be_measured_is_refused(names, trials, episodes, message):
    with pytest.raises(UserError, match=message):
        search.check(names, trials, episodes)
