"""Hold the bounded fit of the policy against the paper's, on test functions and all tasks but walking.

Each has the archive that it does best with: without bounds a long one, which slows the policy down as bounds
do; with bounds a short one, as older samples say less. The paper's fit with the short one tells what the
archive does from what the bounds do, and the bounded one whose samples are weighed by importance what these
weights do. The functions also show the paper's fit without an archive.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from creps_jax.contexts import context_grid
from creps_jax.policies.features import FeatureMap, linear_features, rbf_features
from creps_jax.tasks import Task, contextual_function, hole_reaching, sinus, via_point_reaching
from creps_jax.tasks.functions import ackley, ellipsoid, rastrigin, rosenbrock, sphere
from creps_jax.tools import plots
from creps_jax.tools.tables import save_table
from experiments import comparison
from experiments.comparison import Contender, LearnerSettings, compare, make_contender, mean_policy_curve
from experiments.learning import Session
from experiments.registry import Claim

LABELS = {
    "plain": "weighted ML, no archive",
    "archive": "weighted ML",
    "short": "weighted ML, short archive",
    "bounded": "bounded",
    "importance": "bounded, importance weights",
}
FUNCTIONS = {
    "sphere": sphere,
    "ellipsoid": ellipsoid,
    "rosenbrock": rosenbrock,
    "rastrigin": rastrigin,
    "ackley": ackley,
}
THETA_DIM, CONTEXT_DIM = 20, 2
SIGNIFICANCE = 0.1
"""Of the evidence that the bounded fits ask for; weighted ML is the paper's, which asks for none."""
FUNCTION_KL_BOUNDS = (1.0, 0.05)
"""Bounds of the bounded fit on the change of mean and covariance on the functions, nats."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of the experiment: 10,000 rollouts of each trial.

    Attributes:
        iterations: iterations of learning.
        trials: trials of each contender.
        samples: new samples of an iteration.
        first_samples: new samples of the first iteration; None is `samples`.
    """

    iterations: int = 200
    trials: int = 20
    samples: int = 50
    first_samples: int | None = None


SETTINGS = {"best": Settings(), "quick": Settings(trials=4)}


class Bench(NamedTuple):
    """Who learns a task, by fit, and the contexts to judge them on."""

    contenders: Mapping[str, Contender]
    grid: jax.Array


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn each task with each fit, from the same first policy and the same keys."""
    setup_key, learn_key = jax.random.split(key)
    plan = LearnerSettings(settings.iterations, settings.trials, settings.samples, settings.first_samples)
    arrays = {}
    for name, make in BENCHES.items():
        bench = make(setup_key, plan)
        contenders = {f"{name}-{fit}": contender for fit, contender in bench.contenders.items()}
        found = compare(contenders, plan, learn_key, grid=bench.grid, session=session)
        arrays |= {f"{name}/{field}": values for field, values in found.items()}
    return arrays


def _function_bench(
    function: Callable[[jax.Array], jax.Array], key: jax.Array, plan: LearnerSettings
) -> Bench:
    transform_key, start_key = jax.random.split(key)
    task = contextual_function(function, jax.random.normal(transform_key, (THETA_DIM, CONTEXT_DIM)))
    features = linear_features(CONTEXT_DIM)
    coef = jnp.zeros((features.size, THETA_DIM)).at[0].set(jax.random.normal(start_key, (THETA_DIM,)))
    plain = dataclasses.replace(plan, archive_size=plan.samples, kl_bound=1.0, ridge=1e-10)
    mean_kl_bound, cov_kl_bound = FUNCTION_KL_BOUNDS
    learners = {
        "plain": plain,
        "archive": dataclasses.replace(plain, archive_size=1000),
        **_with_bounds(plain, 200, mean_kl_bound, cov_kl_bound),
    }
    contenders = {}
    for fit, learner in learners.items():
        contender = make_contender(task, (features, features), learner)
        contenders[fit] = contender._replace(start=contender.start._replace(coef=coef))
    return Bench(contenders, context_grid((1.0, 1.0), (2.0, 2.0), 5))


def _with_bounds(
    learner: LearnerSettings, archive_size: int, mean_kl_bound: float, cov_kl_bound: float
) -> dict[str, LearnerSettings]:
    """Return a learner with a shorter archive, the same within bounds, and that with importance weights."""
    short = dataclasses.replace(learner, archive_size=archive_size)
    bounded = dataclasses.replace(
        short, mean_kl_bound=mean_kl_bound, cov_kl_bound=cov_kl_bound, significance=SIGNIFICANCE
    )
    # As many policies as have samples in the archive.
    importance = dataclasses.replace(bounded, importance_policies=math.ceil(archive_size / learner.samples))
    return {"short": short, "bounded": bounded, "importance": importance}


def _task_bench(
    task: Task,
    features: FeatureMap,
    grid: jax.Array,
    plan: LearnerSettings,
    *,
    start_std: float,
    cov_kl_bound: float,
) -> Bench:
    paper = dataclasses.replace(plan, start_std=start_std)
    learners = {"archive": paper, **_with_bounds(paper, 400, 0.3, cov_kl_bound)}
    pair = (features, features)
    return Bench({fit: make_contender(task, pair, learner) for fit, learner in learners.items()}, grid)


def _sinus_bench(key: jax.Array, plan: LearnerSettings) -> Bench:
    del key
    high = 5 * math.pi
    features, grid = rbf_features(0.0, high, 11), context_grid(0.0, high, 201)
    return _task_bench(sinus(0.0, high), features, grid, plan, start_std=1.0, cov_kl_bound=0.02)


def _reaching_bench(key: jax.Array, plan: LearnerSettings) -> Bench:
    del key
    low, high = (-1.5, -1.5), (-0.5, -0.5)
    features, grid = rbf_features(low, high, 2), context_grid(low, high, 6)
    return _task_bench(via_point_reaching(), features, grid, plan, start_std=1.0, cov_kl_bound=0.005)


def _hole_bench(key: jax.Array, plan: LearnerSettings) -> Bench:
    del key
    features, grid = rbf_features(1.4, 2.0, 6), context_grid(1.4, 2.0, 25)
    return _task_bench(hole_reaching(), features, grid, plan, start_std=0.5, cov_kl_bound=0.005)


BENCHES: dict[str, Callable[[jax.Array, LearnerSettings], Bench]] = {
    **{name: partial(_function_bench, function) for name, function in FUNCTIONS.items()},
    "sinus": _sinus_bench,
    "reaching": _reaching_bench,
    "hole": _hole_bench,
}


def of_bench(arrays: Mapping[str, np.ndarray], bench: str) -> dict[str, np.ndarray]:
    """Return the arrays of one task, as `compare` named them."""
    prefix = f"{bench}/"
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}


def fits(arrays: Mapping[str, np.ndarray], bench: str) -> dict[str, str]:
    """Return the contenders of a task by their labels."""
    found = of_bench(arrays, bench)
    return {label: f"{bench}-{fit}" for fit, label in LABELS.items() if f"{bench}-{fit}.coef" in found}


def share_of_episodes(arrays: Mapping[str, np.ndarray], bench: str) -> float:
    """Return in which share of the episodes the bounded fit is as good as the paper's after all of them."""
    found = of_bench(arrays, bench)
    episodes, bounded = mean_policy_curve(found, f"{bench}-bounded")
    _, archive = mean_policy_curve(found, f"{bench}-archive")
    return comparison.share_of_episodes(episodes, bounded, archive)


def table(arrays: Mapping[str, np.ndarray]) -> dict[str, list[str]]:
    """Return the table of the last mean policies, and of the episodes that it took.

    Rewards are medians of the trials, with their intervals where there are trials enough.
    """
    columns: dict[str, list[str]] = {"task": list(BENCHES)}
    for label in LABELS.values():
        columns[label] = []
        for bench in BENCHES:
            contender = fits(arrays, bench).get(label)
            curve = None if contender is None else mean_policy_curve(of_bench(arrays, bench), contender)[1]
            columns[label].append("" if curve is None else comparison.median_and_interval(curve[:, -1]))
        if label == LABELS["bounded"]:
            columns["as good after"] = [f"{share_of_episodes(arrays, bench):.0%}" for bench in BENCHES]
    return columns


def plot(arrays: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """Draw the learning curves on each task, and how the updates on the sphere went."""
    panels = {
        bench: {
            label: mean_policy_curve(of_bench(arrays, bench), contender)
            for label, contender in fits(arrays, bench).items()
        }
        for bench in BENCHES
    }
    found = of_bench(arrays, "sphere")
    traces = {
        label: {field: found[f"{contender}.{field}"] for field in plots.TRACES}
        for label, contender in fits(arrays, "sphere").items()
    }
    return {
        "learning_curves": plots.learning_curves(panels, columns=4, share=False),
        "sphere_updates": plots.update_traces(found["episodes"], traces),
    }


def finish(settings: Settings, arrays: Mapping[str, np.ndarray], folder: Path, say: Callable) -> None:
    """Write and say the table."""
    del settings
    save_table(table(arrays), folder, say)


def _last_samples(arrays: Mapping[str, np.ndarray], contender: str) -> float:
    return float(of_bench(arrays, "sphere")[f"sphere-{contender}.sample_reward"][:, -1].mean())


def _largest_move(arrays: Mapping[str, np.ndarray]) -> float:
    """Return the largest relative entropy of the bounded fit on the sphere, as a share of its bound."""
    return float(of_bench(arrays, "sphere")["sphere-bounded.policy_kl"].max() / sum(FUNCTION_KL_BOUNDS))


CLAIMS = (
    Claim(
        "sphere, weighted ML: mean reward of the last new samples (bolero's C-REPS, five seeds: -48.6)",
        None,
        lambda arrays: _last_samples(arrays, "archive"),
        low=-48.6,
    ),
    Claim(
        "sphere, bounded: the same",
        None,
        lambda arrays: _last_samples(arrays, "bounded"),
        low=-1e-4,
    ),
    Claim("sphere, bounded: largest move of the policy, of its bound", None, _largest_move, high=1.01),
    *(
        Claim(
            f"{bench}: share of episodes in which the bounded fit is as good as weighted ML after all",
            None,
            lambda arrays, bench=bench: share_of_episodes(arrays, bench),
            high=0.5,
        )
        for bench in BENCHES
    ),
)
