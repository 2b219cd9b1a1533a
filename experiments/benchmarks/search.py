"""Compare searches at equal numbers of episodes: contextual REPS, the surrogate, and others.

    python -m experiments.benchmarks.search [--tasks sphere,hole] [--trials 20] [--out FOLDER]

Prints a table for each task: the regret of the mean policy on a grid of contexts without noise, as the median
of the trials with quartiles, the episodes of a trial, and the seconds of all trials, with compilation. Draws
the regrets of all tasks as one figure. `random` varies the coefficients of the policy, and is judged at
four fixed contexts; `CMA-ES x 4` searches for the parameters at each of them.
"""

import dataclasses
import importlib.util
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import lax
from matplotlib.figure import Figure

from creps_jax.errors import UserError
from creps_jax.search.base import Search
from creps_jax.search.creps import creps
from creps_jax.search.surrogate import surrogate
from creps_jax.tools import plots, tables
from creps_jax.tools.command_line import answer
from creps_jax.training import train_trials
from experiments.benchmarks.contextual_cma import contextual_cma
from experiments.benchmarks.search_tasks import PROBLEMS, Problem
from experiments.learning import trial_keys

NUM_EVALUATED = 20
FACTOR = 1.1
"""Growth of the step size of the random search after a success; four failures undo it (one success in 5)."""


class Curve(NamedTuple):
    """The regrets of a search on a task.

    Attributes:
        episodes: (k,) rollouts so far.
        regret: (trials, k) regrets of the mean policies, without noise.
        seconds: time of all trials, with compilation.
    """

    episodes: np.ndarray
    regret: np.ndarray
    seconds: float


Learner = Callable[[Problem, jax.Array], tuple[np.ndarray, np.ndarray]]
"""Called as (problem, keys (trials,)); returns episodes (k,) and coefficients (trials, k, p, d)."""


def main(
    tasks: tuple[str, ...] = tuple(PROBLEMS),
    trials: int = 20,
    out: Path | None = None,
    episodes: int | None = None,
) -> None:
    """Measure, and print a table for each task.

    Args:
        tasks: Names of the tasks, separated by commas or spaces.
        trials: Trials of each search.
        out: Folder for the figure `regret.png` and the curves `regret.npz`; by default neither is written.
        episodes: Rollouts of a trial, if not the task's own number.
    """
    names = [name for text in tasks for name in text.split(",")]
    check(names, trials, episodes)
    learners = dict(LEARNERS)
    if importlib.util.find_spec("cma") is None:
        del learners["CMA-ES x 4"]
        print("CMA-ES x 4 is left out: the package cma is not installed")
    found: dict[str, dict[str, Curve]] = {}
    keys = trial_keys(jax.random.key(0), trials)
    for name in names:
        problem = PROBLEMS[name]()
        asked = problem.episodes if episodes is None else episodes
        problem = dataclasses.replace(problem, episodes=asked)
        found[name] = {}
        for label, learner in learners.items():
            print(f"{name}, {label} ...", file=sys.stderr, flush=True)
            found[name][label] = measure(problem, learner, keys)
        print(f"{name}\n\n{tables.to_markdown(columns(found[name]))}", flush=True)
        if out is not None:
            save(found, out)


def check(names: list[str], trials: int, episodes: int | None) -> None:
    """Check what is asked.

    Raises:
        UserError: for an unknown task, or a number that is not at least 1.
    """
    for name in names:
        if name not in PROBLEMS:
            raise UserError(f"tasks must be among {', '.join(PROBLEMS)}, got {name!r}")
    for what, number in (("trials", trials), ("episodes", episodes)):
        if number is not None and number < 1:
            raise UserError(f"{what} must be at least 1, got {number}")


def measure(problem: Problem, learner: Learner, keys: jax.Array) -> Curve:
    """Learn all trials, and evaluate their mean policies."""
    begin = time.perf_counter()
    episodes, coef = learner(problem, keys)
    seconds = time.perf_counter() - begin
    regret = jax.jit(jax.vmap(jax.vmap(partial(regret_of, problem))))(jnp.asarray(coef))
    return Curve(episodes, np.asarray(regret), seconds)


def regret_of(problem: Problem, coef: jax.Array) -> jax.Array:
    """Return the mean loss of a mean policy over the grid; no reward is above zero on these tasks."""
    return -_mean_reward(problem.noise_free, problem, jax.random.key(0), coef, problem.grid)


def columns(curves: Mapping[str, Curve]) -> dict[str, list[str]]:
    """Return the columns of the table of a task."""
    last = [np.percentile(curve.regret[:, -1], (50, 25, 75)) for curve in curves.values()]
    return {
        "search": list(curves),
        "regret": [f"{middle:.3g}" for middle, _, _ in last],
        "quartiles": [f"{low:.3g} to {high:.3g}" for _, low, high in last],
        "episodes": [f"{curve.episodes[-1]:,}" for curve in curves.values()],
        "seconds": [f"{curve.seconds:.1f}" for curve in curves.values()],
    }


def draw(found: Mapping[str, Mapping[str, Curve]]) -> Figure:
    """Draw the median and the quartiles of the regret against episodes, a panel for each task."""
    wide = min(len(found), 4)
    figure, grid, panels = plots.new_panels(len(found), wide, width=3.2, height=2.6, margin=0.6)
    colours = dict(zip(LEARNERS, plots.COLOURS, strict=False))
    for panel, (name, curves) in zip(panels, found.items(), strict=True):
        for label, curve in curves.items():
            low, middle, high = np.percentile(curve.regret, (25, 50, 75), axis=0)
            panel.plot(curve.episodes, middle, color=colours[label], label=label)
            panel.fill_between(curve.episodes, low, high, color=colours[label], alpha=0.18, linewidth=0)
        panel.set(title=name, xlabel="episodes", yscale="log")
    for panel in grid[:, 0]:
        panel.set_ylabel("regret")
    lines, labels = panels[0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside lower center", ncols=2 * wide)
    return figure


def save(found: Mapping[str, Mapping[str, Curve]], folder: Path) -> None:
    """Write the figure and the curves into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    plots.save_figure(folder / "regret.png", draw(found))
    arrays: dict[str, Any] = {}
    for name, curves in found.items():
        for label, curve in curves.items():
            arrays |= {f"{name}/{label}/{field}": value for field, value in curve._asdict().items()}
    np.savez(folder / "regret.npz", **arrays)


def weighted(problem: Problem) -> Search:
    """Make contextual REPS with the paper's fit and update."""
    return _creps(problem, archive_size=problem.archive_sizes[0], significance=None)


def bounded(problem: Problem) -> Search:
    """Make contextual REPS with the bounded fit."""
    return _creps(problem, archive_size=problem.archive_sizes[1], m_step=problem.m_step)


def _creps(problem: Problem, **settings: Any) -> Search:
    bounds = {"kl_bound": problem.kl_bound, "ridge": problem.ridge}
    return creps(problem.features, problem.features, **bounds, **settings)


def by_model(problem: Problem) -> Search:
    """Make the surrogate, with its own KL bound, and the task's bounded fit to fall back to."""
    return surrogate(problem.features, problem.features, ridge=problem.ridge, m_step=problem.m_step)


def learn(
    make: Callable[[Problem], Search], problem: Problem, keys: jax.Array, *, is_surrogate: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Learn with a search of the library's interface."""
    search = make(problem)
    samples = problem.surrogate_samples if is_surrogate else problem.samples
    iterations = max(1, problem.episodes // samples)
    chunk = max(1, iterations // NUM_EVALUATED)
    state, episodes, coefs = problem.start, [], []
    for done in range(chunk, iterations + 1, chunk):
        state, _ = train_trials(
            keys, problem.task, search, state, iterations=chunk, samples=samples, devices=jax.devices()[:1]
        )
        episodes.append(done * samples)
        coefs.append(np.asarray(jax.vmap(search.policy)(state).coef))
    return np.asarray(episodes), np.stack(coefs, axis=1)


def random_search(problem: Problem, keys: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """Change all coefficients at random, and keep a change that does not lower the reward.

    The reward is the mean of one rollout at each of the fixed contexts; the step size follows the rule of one
    success in five.
    """
    num = len(problem.tried)
    steps = max(1, problem.episodes // num)
    size = float(jnp.mean(jnp.diagonal(problem.start.cov_chol))) / problem.features.size**0.5

    def one(carry: tuple, key: jax.Array) -> tuple[tuple, jax.Array]:
        coef, reward, size = carry
        change_key, rollout_key = jax.random.split(key)
        tried = coef + size * jax.random.normal(change_key, coef.shape)
        found = _mean_reward(problem.task, problem, rollout_key, tried, problem.tried)
        is_better = found >= reward
        coef, reward = jnp.where(is_better, tried, coef), jnp.where(is_better, found, reward)
        return (coef, reward, size * jnp.where(is_better, FACTOR, FACTOR**-0.25)), coef

    @jax.jit
    @jax.vmap
    def run(key: jax.Array) -> jax.Array:
        first = (problem.start.coef, jnp.asarray(-jnp.inf), jnp.asarray(size))
        return lax.scan(one, first, jax.random.split(key, steps))[1]

    kept = evaluated(steps)
    return num * kept, np.asarray(run(keys)[:, kept - 1])


def separate_cma(problem: Problem, keys: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """Run CMA-ES (pycma) at each fixed context, and fit the coefficients to its means by least squares."""
    found = [_separate_cma(problem, key) for key in keys]
    return found[0][0], np.stack([coef for _, coef in found])


def _separate_cma(problem: Problem, key: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    import cma  # pyright: ignore[reportMissingImports]

    features = np.asarray(problem.features(problem.tried))
    seeds = np.asarray(jax.random.randint(key, (len(problem.tried),), 1, 2**30))
    std = float(jnp.mean(jnp.diagonal(problem.start.cov_chol)))
    searches = [
        cma.CMAEvolutionStrategy(start, std, {"seed": int(seed), "verbose": -9})
        for start, seed in zip(features @ np.asarray(problem.start.coef), seeds, strict=True)
    ]
    rewards = jax.jit(jax.vmap(partial(_reward, problem.task)))
    per_step = sum(search.popsize for search in searches)
    steps = max(1, problem.episodes // per_step)
    kept = evaluated(steps)
    coefs = []
    for step in range(1, steps + 1):
        asked = [np.asarray(search.ask()) for search in searches]
        contexts = np.repeat(problem.tried, [len(thetas) for thetas in asked], axis=0)
        rollout_keys = jax.random.split(jax.random.fold_in(key, step), len(contexts))
        loss = -np.asarray(rewards(rollout_keys, contexts, np.concatenate(asked, dtype=np.float32)), float)
        for search, thetas, part in zip(searches, asked, np.split(loss, len(searches)), strict=True):
            search.tell(list(thetas), list(part))
        if step in kept:
            means = np.stack([search.mean for search in searches])
            coefs.append(np.linalg.lstsq(features, means, rcond=None)[0])
    return per_step * kept, np.stack(coefs)


def evaluated(steps: int) -> np.ndarray:
    """Return the numbers of the steps after which a search is evaluated."""
    return np.unique(np.linspace(1, steps, min(steps, NUM_EVALUATED)).round().astype(int))


def _reward(task: Any, key: jax.Array, context: jax.Array, theta: jax.Array) -> jax.Array:
    reward = task.rollout(key, context, theta).reward
    return jnp.where(jnp.isfinite(reward), reward, task.worst_reward)


def _mean_reward(
    task: Any, problem: Problem, key: jax.Array, coef: jax.Array, contexts: jax.Array
) -> jax.Array:
    thetas = problem.features(contexts) @ coef
    keys = jax.random.split(key, len(contexts))
    return jnp.mean(jax.vmap(partial(_reward, task))(keys, contexts, thetas))


LEARNERS: dict[str, Learner] = {
    "random": random_search,
    "creps": partial(learn, weighted),
    "bounded": partial(learn, bounded),
    "surrogate": partial(learn, by_model, is_surrogate=True),
    "contextual CMA-ES": partial(learn, lambda problem: contextual_cma(problem.features)),
    "CMA-ES x 4": separate_cma,
}


if __name__ == "__main__":
    sys.exit(answer(lambda: tyro.cli(main)))
