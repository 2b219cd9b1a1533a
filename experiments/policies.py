"""Compare policies on the paper's four tasks: RBFs, polynomials, a Gaussian process and a network.

The paper's conclusion names networks and Gaussian processes as its future work. All policies learn with the
bounded fit, a short archive and the same baseline: only the mean of the policy differs.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from matplotlib.figure import Figure

from creps_jax.contexts import context_grid
from creps_jax.errors import UserError
from creps_jax.policies.features import (
    FeatureMap,
    kernel_features,
    rbf_features,
    scaled_polynomial_features,
)
from creps_jax.policies.network import network_policy, start_network
from creps_jax.tasks import Task, average_repeats, hole_reaching, sinus, via_point_reaching
from creps_jax.tools import plots
from creps_jax.typing import VectorLike
from experiments.comparison import (
    Contender,
    LearnerSettings,
    Schedule,
    compare,
    make_contender,
    mean_policy_curve,
    median_and_interval,
)
from experiments.learning import Session
from experiments.records import Arrays, Part, named, parts_with
from experiments.registry import Claim

LABELS = {"rbf": "RBFs", "polynomial": "polynomials", "kernel": "Gaussian process", "network": "network"}
ARCHIVE_SIZE, SIGNIFICANCE = 400, 0.1
MEAN_KL_BOUND, COV_KL_BOUND = 0.3, 0.02


@dataclasses.dataclass(frozen=True)
class Settings(Schedule):
    """Settings of the experiment.

    Attributes:
        tasks: the tasks: sinus, reaching, hole and walk.
        hidden: number of tanh units of the network.
        steps: training steps of the network in an update.
        walk_iterations: iterations of learning to walk, which takes hours.
    """

    iterations: int = 200
    samples: int = 50
    tasks: tuple[str, ...] = ("sinus", "reaching", "hole", "walk")
    hidden: int = 32
    steps: int = 100
    walk_iterations: int = 60

    def __post_init__(self) -> None:
        unknown = set(self.tasks) - set(BENCHES)
        if unknown or not self.tasks:
            raise UserError(f"tasks must be some of {', '.join(BENCHES)}, got {', '.join(self.tasks)}")


class Bench(NamedTuple):
    """A task, and the settings with which all policies learn it.

    Attributes:
        task: the task.
        low: lower end of the context.
        high: upper end of the context.
        num: number of evaluated contexts along each context variable.
        features: features of the policies that are linear in features, by name.
        learner: settings of the search.
    """

    task: Task
    low: VectorLike
    high: VectorLike
    num: int
    features: Mapping[str, FeatureMap]
    learner: LearnerSettings


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn each task with each policy, from the same keys.

    Returns:
        The arrays of `compare` of each task, see `of_task`; contenders are named by task and policy, such as
        sinus-rbf.
    """
    setup_key, learn_key = jax.random.split(key)
    plan = LearnerSettings(settings.iterations, settings.trials, settings.samples, settings.first_samples)
    arrays = {}
    for name in settings.tasks:
        iterations = settings.walk_iterations if name == "walk" else settings.iterations
        bench = BENCHES[name](dataclasses.replace(plan, iterations=iterations))
        contenders = {
            f"{name}-{policy}": contender
            for policy, contender in make_contenders(bench, settings, setup_key).items()
        }
        grid = context_grid(bench.low, bench.high, bench.num)
        found = compare(contenders, bench.learner, learn_key, grid=grid, session=session)
        arrays |= named(name, found, "/")
    return arrays


def make_contenders(bench: Bench, settings: Settings, key: jax.Array) -> dict[str, Contender]:
    """Make the contenders of a task, by policy; all have the RBFs as the features of their baseline."""
    learner, baseline = bench.learner, bench.features["rbf"]
    contenders = {
        name: make_contender(bench.task, (features, baseline), learner)
        for name, features in bench.features.items()
    }
    policy = network_policy(
        bench.low,
        bench.high,
        steps=settings.steps,
        mean_kl_bound=learner.mean_kl_bound or MEAN_KL_BOUND,
        cov_kl_bound=learner.cov_kl_bound or COV_KL_BOUND,
    )
    start = start_network(
        key, policy.features, bench.task.theta_dim, hidden=settings.hidden, std=learner.start_std
    )
    return contenders | {"network": make_contender(bench.task, (policy, baseline), learner, start)}


def _features(
    low: VectorLike,
    high: VectorLike,
    *,
    centers: int,
    degree: int,
    points: int,
    bandwidth: float | None = None,
) -> dict[str, FeatureMap]:
    """Make RBFs, polynomials of the scaled context, and a Gaussian process, over one range."""
    return {
        "rbf": rbf_features(low, high, centers),
        "polynomial": scaled_polynomial_features(low, high, degree),
        "kernel": kernel_features(low, high, points, bandwidth=bandwidth),
    }


def _bounded(plan: LearnerSettings, *, start_std: float, cov_kl_bound: float) -> LearnerSettings:
    return dataclasses.replace(
        plan,
        archive_size=ARCHIVE_SIZE,
        mean_kl_bound=MEAN_KL_BOUND,
        cov_kl_bound=cov_kl_bound,
        significance=SIGNIFICANCE,
        start_std=start_std,
    )


def _sinus_bench(plan: LearnerSettings) -> Bench:
    low, high = 0.0, 5 * math.pi
    features = _features(low, high, centers=11, degree=10, points=15, bandwidth=1.5)
    learner = _bounded(plan, start_std=1.0, cov_kl_bound=COV_KL_BOUND)
    return Bench(sinus(low, high), low, high, 201, features, learner)


def _reaching_bench(plan: LearnerSettings) -> Bench:
    low, high = (-1.5, -1.5), (-0.5, -0.5)
    features = _features(low, high, centers=2, degree=2, points=10)
    learner = _bounded(plan, start_std=1.0, cov_kl_bound=0.005)
    return Bench(via_point_reaching(), low, high, 6, features, learner)


def _hole_bench(plan: LearnerSettings) -> Bench:
    low, high = 1.4, 2.0
    features = _features(low, high, centers=6, degree=3, points=6, bandwidth=0.2)
    learner = _bounded(plan, start_std=0.5, cov_kl_bound=0.005)
    return Bench(hole_reaching(), low, high, 25, features, learner)


def _walk_bench(plan: LearnerSettings) -> Bench:
    # They import MuJoCo, which the other tasks do not need.
    from experiments.walking import learning
    from experiments.walking.settings import SETTINGS as WALK_SETTINGS

    walk = WALK_SETTINGS["quick"]
    (low,), (high,) = (map(float, end) for end in walk.context_range())
    task = learning.make_task(walk, noise=walk.learning_noise, duration=walk.learning_duration)
    learner = dataclasses.replace(
        plan,
        samples=walk.samples,
        first_samples=walk.first_samples,
        archive_size=walk.archive_size,
        kl_bound=walk.kl_bound,
        mean_kl_bound=walk.mean_kl_bound,
        cov_kl_bound=walk.cov_kl_bound,
        significance=walk.significance,
        start_std=walk.start_std,
    )
    features = _features(low, high, centers=5, degree=3, points=6, bandwidth=0.4 * (high - low))
    return Bench(average_repeats(task, walk.repeats), low, high, 11, features, learner)


BENCHES: dict[str, Callable[[LearnerSettings], Bench]] = {
    "sinus": _sinus_bench,
    "reaching": _reaching_bench,
    "hole": _hole_bench,
    "walk": _walk_bench,
}

SETTINGS = {
    "quick": Settings(iterations=100, trials=4, tasks=("sinus", "reaching", "hole")),
    "full": Settings(),
}


def of_task(arrays: Arrays, task: str) -> Part:
    """Return the arrays of one task, as `compare` returned them."""
    return Part(arrays, task, "/")


def tasks_of(arrays: Arrays) -> list[str]:
    """Return the names of the tasks of a result."""
    return [task for task in BENCHES if f"{task}/context" in arrays]


def curves(arrays: Arrays, task: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return episodes and the rewards of the mean policies of a task (trials, evaluated), by label."""
    found = of_task(arrays, task)
    names = parts_with(found, "coef")
    return {
        label: mean_policy_curve(found, name)
        for policy, label in LABELS.items()
        if (name := f"{task}-{policy}") in names
    }


def table(arrays: Arrays) -> dict[str, list[str]]:
    """Return the rewards of the last mean policies: medians, with intervals if there are enough trials."""
    tasks = tasks_of(arrays)
    columns: dict[str, list[str]] = {"task": tasks}
    for label in LABELS.values():
        columns[label] = [median_and_interval(curves(arrays, task)[label][1][:, -1]) for task in tasks]
    return columns


def plot(arrays: Arrays) -> dict[str, Figure]:
    """Draw the learning curves of each task."""
    panels = {task: curves(arrays, task) for task in tasks_of(arrays)}
    return {"learning_curves": plots.learning_curves(panels, columns=min(len(panels), 2), share=False)}


def last_reward(arrays: Arrays, task: str, policy: str) -> float:
    """Return the reward of the last mean policies of a task, the median of the trials; NaN if not learned."""
    if task not in tasks_of(arrays):
        return math.nan
    return float(np.median(curves(arrays, task)[LABELS[policy]][1][:, -1]))


def cost_of_rbfs(arrays: Arrays, task: str, policy: str) -> float:
    """Return the cost, the reward with the other sign, of a policy, divided by the cost of the RBFs."""
    return last_reward(arrays, task, policy) / last_reward(arrays, task, "rbf")


CLAIMS = (
    *(
        Claim(
            f"sine, {LABELS[policy]}: reward of the mean policy, median of trials (a policy of zero: -0.5)",
            partial(last_reward, task="sinus", policy=policy),
            low=low,
        )
        for policy, low in (("rbf", -0.005), ("kernel", -0.005), ("network", -0.2))
    ),
    *(
        Claim(
            f"{place}, {LABELS[policy]}: cost of the mean policy, divided by that of RBFs, medians of trials",
            partial(cost_of_rbfs, task=task, policy=policy),
            high=high,
        )
        for task, place, policy, high in (
            ("reaching", "via-points", "network", 1.5),
            ("reaching", "via-points", "polynomial", 2.0),
            ("reaching", "via-points", "kernel", 4.0),
            ("hole", "hole", "network", 1.2),
            ("hole", "hole", "polynomial", 1.3),
        )
    ),
)
