"""Compare the paper's fit of the policy with the bounded fit, on test functions and all tasks but walking.

Each fit has the archive with which it learns best. Without bounds this is a long archive, which slows the
policy down as bounds do; with bounds it is a short one, as older samples fit the policy less. Two more
contenders separate the effects: the paper's fit with the short archive, and the bounded fit with importance
weights. On the functions the paper's fit also learns without an archive.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial
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
from experiments import comparison
from experiments.comparison import (
    Contender,
    LearnerSettings,
    Schedule,
    compare,
    make_contender,
    mean_policy_curve,
)
from experiments.learning import Session
from experiments.records import Arrays, Part, named, parts_with, traces
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
"""Significance of the test on evidence in the bounded fits; weighted ML, the paper's fit, has no test."""
FUNCTION_KL_BOUNDS = (1.0, 0.05)
"""Bounds of the bounded fit on the change of mean and covariance on the functions, nats."""


@dataclasses.dataclass(frozen=True)
class Settings(Schedule):
    """Settings of the experiment: 10,000 rollouts of each trial."""

    iterations: int = 200
    samples: int = 50


SETTINGS = {"best": Settings(), "quick": Settings(trials=4)}


class Bench(NamedTuple):
    """The contenders of a task, by fit, and the contexts of the evaluation."""

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
        arrays |= named(name, found, "/")
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
    """Return a learner with a short archive, with bounds too, and with importance weights too."""
    short = dataclasses.replace(learner, archive_size=archive_size)
    bounded = dataclasses.replace(
        short, mean_kl_bound=mean_kl_bound, cov_kl_bound=cov_kl_bound, significance=SIGNIFICANCE
    )
    # The number of policies that have samples in the archive.
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


def of_bench(arrays: Arrays, bench: str) -> Part:
    """Return the arrays of one task, as `compare` returned them."""
    return Part(arrays, bench, "/")


def fits(arrays: Arrays, bench: str) -> dict[str, str]:
    """Return the contenders of a task by the labels of their fits."""
    contenders = parts_with(of_bench(arrays, bench), "coef")
    return {label: name for fit, label in LABELS.items() if (name := f"{bench}-{fit}") in contenders}


def share_of_episodes(arrays: Arrays, bench: str) -> float:
    """Return the share of the episodes after which the bounded fit reaches the paper's last reward."""
    found = of_bench(arrays, bench)
    episodes, bounded = mean_policy_curve(found, f"{bench}-bounded")
    _, archive = mean_policy_curve(found, f"{bench}-archive")
    return comparison.share_of_episodes(episodes, bounded, archive)


def table(arrays: Arrays) -> dict[str, list[str]]:
    """Return the rewards of the last mean policies and the share of episodes.

    Rewards are medians of the trials, with intervals if there are enough trials.
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


def plot(arrays: Arrays) -> dict[str, Figure]:
    """Draw the learning curves of each task, and traces of the updates on the sphere."""
    panels = {
        bench: {
            label: mean_policy_curve(of_bench(arrays, bench), contender)
            for label, contender in fits(arrays, bench).items()
        }
        for bench in BENCHES
    }
    found = of_bench(arrays, "sphere")
    updates = {label: traces(Part(found, name)) for label, name in fits(arrays, "sphere").items()}
    return {
        "learning_curves": plots.learning_curves(panels, columns=4, share=False),
        "sphere_updates": plots.update_traces(found["episodes"], updates),
    }


def _on_sphere(arrays: Arrays, fit: str) -> Part:
    return Part(of_bench(arrays, "sphere"), f"sphere-{fit}")


def _last_samples(arrays: Arrays, fit: str) -> float:
    return float(_on_sphere(arrays, fit)["sample_reward"][:, -1].mean())


def _largest_kl(arrays: Arrays) -> float:
    """Return the largest KL divergence of the bounded fit on the sphere, divided by its bound."""
    return float(_on_sphere(arrays, "bounded")["policy_kl"].max() / sum(FUNCTION_KL_BOUNDS))


CLAIMS = (
    Claim(
        "sphere, weighted ML: mean reward of the last new samples (bolero's C-REPS, five seeds: -48.6)",
        lambda arrays: _last_samples(arrays, "archive"),
        low=-48.6,
    ),
    Claim("sphere, bounded: the same", lambda arrays: _last_samples(arrays, "bounded"), low=-1e-4),
    Claim("sphere, bounded: largest KL of the policy, divided by its bound", _largest_kl, high=1.01),
    *(
        Claim(
            f"{bench}: share of episodes after which the bounded fit is as good as weighted ML after all",
            lambda arrays, bench=bench: share_of_episodes(arrays, bench),
            high=0.5,
        )
        for bench in BENCHES
    ),
)
