"""Compare learners: train several trials of each, evaluate their mean policies on one grid of contexts."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from creps_jax.policies.base import Policy
from creps_jax.policies.features import FeatureMap
from creps_jax.policies.gaussian import LinearGaussian, start_policy
from creps_jax.search.creps import Creps, creps
from creps_jax.search.fit import fit_within
from creps_jax.search.importance import Importance
from creps_jax.tasks.base import Task
from creps_jax.training import evaluate
from experiments import records
from experiments.learning import Plan, Session, learn, mean_arrays, trial_keys, with_mean
from experiments.records import Arrays, Part

NUM_EVALUATED = 40


class Contender(NamedTuple):
    """A learner and its task.

    Attributes:
        task: the task; contenders may draw its contexts from different distributions.
        algorithm: the search.
        start: the first policy of every trial, a `LinearGaussian` or a `NetworkGaussian`.
    """

    task: Task
    algorithm: Creps
    start: Any


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Numbers of iterations, trials and samples.

    Attributes:
        iterations: iterations of learning.
        trials: trials of each contender; the paper has 5.
        samples: N, new samples of an iteration.
        first_samples: new samples of the first iteration; None is `samples`.
    """

    iterations: int = 1000
    trials: int = 20
    samples: int = 40
    first_samples: int | None = None


@dataclasses.dataclass(frozen=True)
class LearnerSettings(Schedule):
    """Settings of all comparisons; the paper gives samples, archive and KL bound.

    Attributes:
        archive_size: L, samples kept.
        kl_bound: epsilon, nats.
        ridge: relative penalty on the policy's coefficients.
        mean_kl_bound: bound on the change of the policy's mean in an update, nats, see `bounded_ml`; None
            is the paper's unbounded fit.
        cov_kl_bound: the same for the covariance, nats.
        start_std: standard deviation of the first policy, whose mean is zero.
        significance: p-value above which the covariance is not updated, see `creps_jax.creps`; None is the
            paper's update, which has no such test.
        importance_policies: number of last policies whose samples get importance weights, see
            `creps_jax.Importance`; None is the paper's archive, in which all samples have the same weight.
    """

    archive_size: int = 2000
    kl_bound: float = 0.5
    ridge: float = 1e-4
    mean_kl_bound: float | None = None
    cov_kl_bound: float | None = None
    start_std: float = 1.0
    significance: float | None = None
    importance_policies: int | None = None


def make_contender(
    task: Task, features: tuple[FeatureMap | Policy, FeatureMap], settings: LearnerSettings, start: Any = None
) -> Contender:
    """Make a contender from policy and baseline features and the settings of an experiment.

    Args:
        task: the task.
        features: features of policy and baseline; or another kind of policy, and the latter.
        settings: settings of the experiment.
        start: the first policy; by default the same Gaussian for every context.
    """
    policy, baseline = features
    fit: dict[str, Any] = {}
    if isinstance(policy, FeatureMap):
        m_step = fit_within(settings.mean_kl_bound, settings.cov_kl_bound)
        fit = {"ridge": settings.ridge, "m_step": m_step}
        start = start_policy(policy, task.theta_dim, std=settings.start_std) if start is None else start
    algorithm = creps(
        policy,
        baseline,
        kl_bound=settings.kl_bound,
        archive_size=settings.archive_size,
        significance=settings.significance,
        importance=None if settings.importance_policies is None else Importance(settings.importance_policies),
        **fit,
    )
    return Contender(task, algorithm, start)


def compare(
    contenders: Mapping[str, Contender],
    settings: LearnerSettings,
    key: jax.Array,
    *,
    grid: jax.Array,
    session: Session = Session(),
) -> dict[str, np.ndarray]:
    """Train each contender, all its trials at once, and evaluate its mean policies on a grid of contexts.

    Args:
        contenders: by name; all begin with the same keys.
        settings: iterations, trials and samples.
        key: random key.
        grid: (n, s) contexts of the evaluation.
        session: where to keep checkpoints and show progress.

    Returns:
        `context`, the grid; `episodes` (iterations,) and `evaluated`, the iterations (from 1) after which
        mean policies were evaluated; and a part for each contender (see `records.Part`): `sample_reward` and
        the fields of `plots.TRACES` (trials, iterations), `grid_reward` (trials, evaluated, n), and the
        arrays of the last policies, such as `coef` (trials, p, d).
    """
    # Rollouts are too short to share between devices: share the trials.
    devices = jax.local_devices()
    devices = devices[: max(num for num in range(1, len(devices) + 1) if settings.trials % num == 0)]
    plan = Plan(settings.iterations, settings.samples, settings.first_samples)
    learn_key, evaluate_key = jax.random.split(key)
    evaluated = np.unique(np.linspace(1, plan.iterations, NUM_EVALUATED).round().astype(int))
    arrays = {
        "episodes": plan.episodes(np.arange(1, plan.iterations + 1)),
        "evaluated": evaluated,
        "context": np.asarray(grid),
    }
    keys = trial_keys(learn_key, settings.trials)
    for contender in contenders.values():
        # Refuses settings before hours are spent on another contender.
        contender.algorithm.init(contender.start)
    for name, contender in contenders.items():
        _, log = learn(keys, *contender, plan, session=session, name=name, devices=devices)
        # A resumed run may have gone on for longer than is asked of it now.
        means = {field: log[field][:, evaluated - 1] for field in mean_arrays(contender.start)}
        curves = {"sample_reward": log["mean_reward"], **records.traces(Part(log, "info"))}
        found = {field: values[:, : plan.iterations] for field, values in curves.items()}
        found["grid_reward"] = _grid_reward(evaluate_key, contender, means, grid)
        arrays |= records.named(name, found | {field: values[:, -1] for field, values in means.items()})
    return arrays


def mean_policy_curve(arrays: Arrays, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return episodes, and the mean reward over the grid of each trial's mean policy (trials, evaluated)."""
    grid_reward = Part(arrays, name)["grid_reward"]
    return arrays["episodes"][arrays["evaluated"] - 1], grid_reward.mean(axis=2)


def learning_panels(
    arrays: Arrays, panels: Mapping[str, Iterable[str]], labels: Mapping[str, str]
) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Return what `plots.learning_curves` draws: by title, the labelled curves of some contenders."""
    return {
        title: {labels[name]: mean_policy_curve(arrays, name) for name in names}
        for title, names in panels.items()
    }


def last_regrets(arrays: Arrays, labels: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return what `plots.final_values` draws: the labelled regrets (trials,) of all contenders."""
    return {label: regret(arrays, name) for name, label in labels.items()}


def regret(arrays: Arrays, name: str) -> np.ndarray:
    """Return the regret of each trial's last mean policy (trials,), the mean over the grid.

    The regret at a context is the difference to the best reward of any mean policy of any contender.
    """
    rewards = {each: Part(arrays, each)["grid_reward"] for each in records.parts_with(arrays, "grid_reward")}
    best = np.max([values.max(axis=(0, 1)) for values in rewards.values()], axis=0)
    return (best - rewards[name][:, -1]).mean(axis=1)


def p_value(arrays: Arrays, better: str, worse: str) -> float:
    """Return the p-value of Wilcoxon's signed-rank test that the regrets of `better` are lower.

    Trials with the same index have the same key, and are pairs.
    """
    return signed_rank_p(regret(arrays, worse) - regret(arrays, better))


def signed_rank_p(gains: np.ndarray) -> float:
    """Return the p-value of Wilcoxon's signed-rank test that gains (pairs,) are above zero."""
    return float(stats.wilcoxon(gains, alternative="greater").pvalue) if gains.any() else 1.0


def median_and_interval(rewards: np.ndarray) -> str:
    """Return the median and, for six trials or more, its 95 % confidence interval, by order statistics."""
    median = f"{np.median(rewards):.3g}"
    low, high = stats.quantile_test(rewards, p=0.5).confidence_interval(0.95)
    return median if math.isnan(low) else f"{median} ({low:.3g} to {high:.3g})"


def share_of_episodes(
    episodes: np.ndarray, curve: np.ndarray, reference: np.ndarray, *, total: float | None = None
) -> float:
    """Return the share of the episodes of a reference after which a curve reaches its last reward.

    Both are medians of the trials; infinite if the curve never reaches it.

    Args:
        episodes: (k,) rollouts so far.
        curve: (trials, k) rewards.
        reference: (trials, j) rewards of the reference.
        total: rollouts of the reference, if not `episodes[-1]`.
    """
    has_reached = np.median(curve, axis=0) >= np.median(reference[:, -1])
    total = episodes[-1] if total is None else total
    return float(episodes[has_reached][0] / total) if has_reached.any() else math.inf


def mean_thetas(contender: Contender, coef: np.ndarray | jax.Array, contexts: jax.Array) -> jax.Array:
    """Return the parameters (n, d) of a mean policy (p, d) at contexts (n, s)."""
    policy = LinearGaussian(jnp.asarray(coef), contender.start.cov_chol)
    return contender.algorithm.mean(policy, contexts)


def postures(
    arrays: Arrays,
    contenders: Mapping[str, Contender],
    contexts: jax.Array,
    points: Callable[[jax.Array], jax.Array],
) -> dict[str, np.ndarray]:
    """Return the array `postures` of contenders: `points` of the last parameters of the first trial."""
    found = {}
    for name, contender in contenders.items():
        thetas = mean_thetas(contender, Part(arrays, name)["coef"][0], contexts)
        found |= records.named(name, {"postures": jax.vmap(points)(thetas)})
    return found


def _grid_reward(key: jax.Array, contender: Contender, means: Arrays, grid: jax.Array) -> np.ndarray:
    """Return the reward of mean policies (trials, k, ...) at contexts (n, s), as (trials, k, n)."""

    def thetas_of(means: Mapping[str, Any]) -> jax.Array:
        return contender.algorithm.mean(with_mean(contender.start, means), grid)

    thetas = jax.vmap(jax.vmap(thetas_of))({name: jnp.asarray(values) for name, values in means.items()})
    trials, num, _, dim = thetas.shape
    contexts = jnp.tile(grid, (trials * num, 1))
    devices = jax.local_devices()[:1]
    outcome = evaluate(key, contender.task, contexts, thetas.reshape(-1, dim), devices=devices)
    return np.asarray(outcome.reward).reshape(trials, num, len(grid))
