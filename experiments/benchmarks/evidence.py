"""Measure searches without evidence, and with rare evidence.

    python -m experiments.benchmarks.evidence [--trials 8] [--searches 40]
    python -m experiments.benchmarks.evidence --trade-off FILE.png

Pure noise: rewards that do not depend on the parameters, 2 contexts, affine features. The spread of the
policy should not change; the logarithm of its last value over its first is printed, for several sizes of the
archive, with and without the test on evidence. Sparse: a reward of 1 for hits, in 0.4 % of the episodes of
the first policy, and 0 otherwise. Trade-off: the effect of `significance` in noise and on test functions, as
a figure.
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from creps_jax.contexts import context_grid, uniform_contexts
from creps_jax.policies.features import linear_features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.search.creps import Creps, creps
from creps_jax.search.fit import bounded_ml, weighted_ml
from creps_jax.tasks import PlainOutcome, Task
from creps_jax.tools import plots, tables
from creps_jax.tools.command_line import answer
from creps_jax.training import train_trials
from experiments import comparison, updates
from experiments.comparison import LearnerSettings, compare, mean_policy_curve

M_STEPS = {"weighted ML": weighted_ml, "bounded": bounded_ml()}
NOISE = ((10, 20, 3_000, (60, 100, 200)), (20, 50, 10_000, (200,)))
"""Parameters, samples of an iteration, episodes, and sizes of the archive."""
SIGNIFICANCES = {"default": 0.1, "no test": None}
SPARSE_ARCHIVE, SPARSE_SAMPLES, SPARSE_EPISODES = 200, 20, 3_000
HIT_RADIUS = 0.17
LEVELS = (0.02, 0.05, 0.1, 0.2, 0.5, None)
TRADED = ("sphere", "ellipsoid", "rastrigin", "ackley", "sinus")


def main(trials: int = 8, searches: int = 40, trade_off: Path | None = None) -> None:
    """Measure, and print a table for each.

    Args:
        trials: Searches of each row in pure noise.
        searches: Searches for the sparse reward.
        trade_off: Draw the effect of `significance` into this file, and measure nothing else.
    """
    if trade_off is not None:
        draw_trade_off(measure_trade_off(), trade_off)
        return
    print("Pure noise: log(spread after / before), mean of the parameters; mean (lowest) of the trials")
    for fit in M_STEPS:
        for dim, samples, episodes, archives in NOISE:
            for archive in archives:
                found = []
                for name, significance in SIGNIFICANCES.items():
                    spread = log_spread(fit, dim, samples, episodes, archive, trials, significance)
                    found.append(f"{name} {spread.mean():.2f} ({spread.min():.2f})")
                print(f"{fit}, {dim} parameters, archive {archive}: {', '.join(found)}", flush=True)
    print(f"Sparse reward: share of {searches} searches that hit in at least 90 % of contexts")
    print(
        tables.to_markdown({"fit": list(M_STEPS), "solved": [f"{solved(f, searches):.0%}" for f in M_STEPS]})
    )


def measure_trade_off(trials: int = 20) -> dict[str, np.ndarray]:
    """Return, for each of `LEVELS`, rows of trials: the last spread in noise, and the last rewards."""
    rows: dict[str, list[np.ndarray]] = {}
    plan = LearnerSettings(iterations=200, trials=trials, samples=50)
    setup_key, learn_key = jax.random.split(jax.random.key(0))
    for level in LEVELS:
        for fit in M_STEPS:
            spread = log_spread(fit, 20, 50, 10_000, 200, trials, level)
            rows.setdefault(f"pure noise, {fit}", []).append(spread)
        for name in TRADED:
            bench = updates.BENCHES[name](setup_key, plan)
            bounded = bench.contenders["bounded"]
            algorithm = bounded.algorithm.with_settings(significance=level)
            found = compare({name: bounded._replace(algorithm=algorithm)}, plan, learn_key, grid=bench.grid)
            rows.setdefault(name, []).append(mean_policy_curve(found, name)[1][:, -1])
        found = ", ".join(f"{name} {comparison.median_and_interval(row[-1])}" for name, row in rows.items())
        print(f"significance {level}: {found}", flush=True)
    return {name: np.stack(row) for name, row in rows.items()}


def draw_trade_off(rows: dict[str, np.ndarray], path: Path) -> None:
    """Draw medians and quartiles over `LEVELS`."""
    figure, _, panels = plots.new_panels(len(rows), 4, width=2.75, height=2.5, margin=0.0)
    for panel, (name, row) in zip(panels, rows.items(), strict=True):
        low, middle, high = np.percentile(row, (25, 50, 75), axis=1)
        panel.errorbar(range(len(LEVELS)), middle, (middle - low, high - middle), marker="o", capsize=3)
        panel.set(title=name, xlabel="significance")
        panel.set_xticks(range(len(LEVELS)), ["none" if x is None else f"{x:g}" for x in LEVELS])
        panel.set_ylabel("log(spread after / before)" if name.startswith("pure noise") else "mean reward")
    plots.save_figure(path, figure)


def log_spread(
    fit: str, dim: int, samples: int, episodes: int, archive: int, trials: int, significance: float | None
) -> np.ndarray:
    """Return the logarithm of the geometric mean of the last spread, for each trial; the first one is 1."""

    def rollout(key: jax.Array, context: jax.Array, theta: jax.Array) -> PlainOutcome:
        return PlainOutcome(jax.random.normal(key), jnp.zeros(0))

    features = linear_features(2)
    algorithm = creps(
        features, features, archive_size=archive, m_step=M_STEPS[fit], significance=significance
    )
    task = Task(uniform_contexts((0.0, 0.0), (1.0, 1.0)), rollout, 2, dim, worst_reward=-100.0)
    cov_chol = _last_policies(algorithm, task, samples, episodes, trials).cov_chol
    return np.log(np.diagonal(cov_chol, axis1=-2, axis2=-1)).mean(axis=-1)


def solved(fit: str, searches: int) -> float:
    """Return the share of searches that solve the sparse task."""

    def is_hit(context: jax.Array, theta: jax.Array) -> jax.Array:
        target = jnp.concatenate([1.2 + 0.3 * context, -0.8 + 0.3 * context])
        return jnp.sum((theta - target) ** 2) < HIT_RADIUS**2

    def rollout(key: jax.Array, context: jax.Array, theta: jax.Array) -> PlainOutcome:
        return PlainOutcome(jnp.where(is_hit(context, theta), 1.0, 0.0), jnp.zeros(0))

    features = linear_features(1)
    algorithm = creps(features, features, archive_size=SPARSE_ARCHIVE, m_step=M_STEPS[fit])
    task = Task(uniform_contexts(0.0, 1.0), rollout, 1, 2, worst_reward=-1.0)
    policies = _last_policies(algorithm, task, SPARSE_SAMPLES, SPARSE_EPISODES, searches)
    grid = context_grid(0.0, 1.0, 21)
    thetas = jax.vmap(algorithm.mean, (0, None))(policies, grid)
    hits = jax.vmap(jax.vmap(is_hit), (None, 0))(grid, thetas)
    return float(np.mean(np.asarray(hits).mean(axis=1) >= 0.9))


def _last_policies(algorithm: Creps, task: Task, samples: int, episodes: int, trials: int) -> LinearGaussian:
    size = 1 + task.context_dim
    start = LinearGaussian(jnp.zeros((size, task.theta_dim)), jnp.eye(task.theta_dim))
    keys = jax.random.split(jax.random.key(0), trials)
    settings = {"iterations": episodes // samples, "samples": samples, "devices": jax.devices()[:1]}
    states, _ = train_trials(keys, task, algorithm, start, **settings)
    return jax.tree.map(np.asarray, states.policy)


if __name__ == "__main__":
    sys.exit(answer(lambda: tyro.cli(main)))
