"""Compare ways to learn: trials of each, judged by their mean policies on one grid of contexts."""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from creps_jax.policies.features import FeatureMap
from creps_jax.policies.gaussian import LinearGaussian, start_policy
from creps_jax.search.creps import Creps, creps
from creps_jax.search.fit import fit_within
from creps_jax.search.importance import Importance
from creps_jax.tasks.base import Task
from creps_jax.tools import plots
from creps_jax.training import evaluate
from experiments.learning import Plan, Session, learn, trial_keys

NUM_EVALUATED = 40


class Contender(NamedTuple):
    """One way to learn a task.

    Attributes:
        task: the task; contenders may differ in how its contexts are drawn.
        algorithm: what learns it.
        start: the first policy of every trial.
    """

    task: Task
    algorithm: Creps
    start: LinearGaussian


@dataclasses.dataclass(frozen=True)
class LearnerSettings:
    """Settings that all comparisons have; the paper gives samples, archive and KL bound.

    Attributes:
        iterations: iterations of learning.
        trials: trials of each contender; the paper has 5.
        samples: N, new samples of an iteration.
        first_samples: new samples of the first iteration; None is `samples`.
        archive_size: L, samples kept.
        kl_bound: epsilon, nats.
        ridge: relative penalty on the policy's coefficients.
        mean_kl_bound: bound on the change of the policy's mean in an update, nats, see `bounded_ml`; None
            is the paper's unbounded fit.
        cov_kl_bound: the same for the covariance, nats.
        start_std: standard deviation of the first policy, whose mean is zero.
        significance: p-value from which on the covariance stays, see `creps_jax.creps`; None is the paper's
            update, which moves it whatever the evidence.
        importance_policies: number of last policies whose samples are weighed by importance, see
            `creps_jax.Importance`; None is the paper's archive, all of whose samples count equally.
    """

    iterations: int = 1000
    trials: int = 20
    samples: int = 40
    first_samples: int | None = None
    archive_size: int = 2000
    kl_bound: float = 0.5
    ridge: float = 1e-4
    mean_kl_bound: float | None = None
    cov_kl_bound: float | None = None
    start_std: float = 1.0
    significance: float | None = None
    importance_policies: int | None = None


def make_contender(
    task: Task, features: tuple[FeatureMap, FeatureMap], settings: LearnerSettings
) -> Contender:
    """Put a contender together from policy and baseline features and an experiment's settings."""
    algorithm = creps(
        *features,
        kl_bound=settings.kl_bound,
        archive_size=settings.archive_size,
        ridge=settings.ridge,
        m_step=fit_within(settings.mean_kl_bound, settings.cov_kl_bound),
        significance=settings.significance,
        importance=None if settings.importance_policies is None else Importance(settings.importance_policies),
    )
    start = start_policy(features[0], task.theta_dim, std=settings.start_std)
    return Contender(task, algorithm, start)


def compare(
    contenders: Mapping[str, Contender],
    settings: LearnerSettings,
    key: jax.Array,
    *,
    grid: jax.Array,
    session: Session = Session(),
) -> dict[str, np.ndarray]:
    """Let each contender learn, all its trials at once, and judge its mean policies on a grid of contexts.

    Args:
        contenders: by name; all begin with the same keys.
        settings: iterations, trials and samples.
        key: random key.
        grid: (n, s) contexts to judge on.
        session: where to keep checkpoints and show progress.

    Returns:
        `context`, the grid; `episodes` (iterations,) and `evaluated`, the iterations (from 1) after which
        mean policies were judged; and for each NAME: `NAME.sample_reward` and `plots.TRACES` of the
        updates (trials, iterations), `NAME.grid_reward` (trials, evaluated, n), `NAME.coef` (trials, p, d),
        the last policies'.
    """
    # Rollouts as short as these are not worth sharing out, trials are.
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
        contender.algorithm.init(
            contender.start
        )  # Refuses settings before hours are spent on another contender.
    for name, contender in contenders.items():
        _, log = learn(keys, *contender, plan, session=session, name=name, devices=devices)
        # A resumed run may have gone on for longer than is asked of it now.
        coef = log["coef"][:, evaluated - 1]
        arrays[f"{name}.sample_reward"] = log["mean_reward"][:, : plan.iterations]
        for field in plots.TRACES:
            arrays[f"{name}.{field}"] = log[f"info.{field}"][:, : plan.iterations]
        arrays[f"{name}.grid_reward"] = _grid_reward(evaluate_key, contender, coef, grid)
        arrays[f"{name}.coef"] = coef[:, -1]
    return arrays


def mean_policy_curve(arrays: Mapping[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return episodes, and the mean reward over the grid of each trial's mean policy (trials, evaluated)."""
    return arrays["episodes"][arrays["evaluated"] - 1], arrays[f"{name}.grid_reward"].mean(axis=2)


def learning_panels(
    arrays: Mapping[str, np.ndarray], panels: Mapping[str, Iterable[str]], labels: Mapping[str, str]
) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Return what `plots.learning_curves` draws: by title, the labelled curves of some contenders."""
    return {
        title: {labels[name]: mean_policy_curve(arrays, name) for name in names}
        for title, names in panels.items()
    }


def last_regrets(arrays: Mapping[str, np.ndarray], labels: Mapping[str, str]) -> dict[str, np.ndarray]:
    """Return what `plots.final_values` draws: the labelled regrets (trials,) of all contenders."""
    return {label: regret(arrays, name) for name, label in labels.items()}


def regret(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """Return what each trial's last mean policy (trials,) lacks, on average, to the best that is known.

    The best known at a context is the best reward of any mean policy of any contender.
    """
    rewards = [values for key, values in arrays.items() if key.endswith(".grid_reward")]
    best = np.max([values.max(axis=(0, 1)) for values in rewards], axis=0)
    return (best - arrays[f"{name}.grid_reward"][:, -1]).mean(axis=1)


def p_value(arrays: Mapping[str, np.ndarray], better: str, worse: str) -> float:
    """Return how likely regrets so much in favour of `better` are if it is no better.

    This is Wilcoxon's signed-rank test: trials of one number share their key, and so make pairs.
    """
    return signed_rank_p(regret(arrays, worse) - regret(arrays, better))


def signed_rank_p(gains: np.ndarray) -> float:
    """Return how likely gains (pairs,) so much above zero are if there are none, by Wilcoxon's test."""
    return float(stats.wilcoxon(gains, alternative="greater").pvalue) if gains.any() else 1.0


def median_and_interval(rewards: np.ndarray) -> str:
    """Return the median and, of six trials or more, its interval of 95 % confidence, by order statistics."""
    median = f"{np.median(rewards):.3g}"
    low, high = stats.quantile_test(rewards, p=0.5).confidence_interval(0.95)
    return median if math.isnan(low) else f"{median} ({low:.3g} to {high:.3g})"


def share_of_episodes(
    episodes: np.ndarray, curve: np.ndarray, reference: np.ndarray, *, total: float | None = None
) -> float:
    """Return in which share of the episodes a curve gets as far as another does in all of them.

    Both by the median of the trials; infinite if it never does.

    Args:
        episodes: (k,) rollouts so far.
        curve: (trials, k) rewards.
        reference: (trials, j) rewards of the other.
        total: rollouts of the other after all, if not `episodes[-1]`.
    """
    is_there = np.median(curve, axis=0) >= np.median(reference[:, -1])
    total = episodes[-1] if total is None else total
    return float(episodes[is_there][0] / total) if is_there.any() else math.inf


def mean_thetas(contender: Contender, coef: np.ndarray | jax.Array, contexts: jax.Array) -> jax.Array:
    """Return what a mean policy (p, d) gives at contexts (n, s), as (n, d)."""
    policy = LinearGaussian(jnp.asarray(coef), contender.start.cov_chol)
    return contender.algorithm.mean(policy, contexts)


def postures(
    contender: Contender, coef: np.ndarray, contexts: jax.Array, points: Callable[[jax.Array], jax.Array]
) -> np.ndarray:
    """Return the postures of an arm under a mean policy: what `points` makes of each context's theta."""
    return np.asarray(jax.vmap(points)(mean_thetas(contender, coef, contexts)))


def _grid_reward(key: jax.Array, contender: Contender, coef: np.ndarray, grid: jax.Array) -> np.ndarray:
    """Return the reward of mean policies (trials, k, p, d) at contexts (n, s), as (trials, k, n)."""
    trials, num, _, dim = coef.shape
    means = jax.vmap(jax.vmap(lambda coef: mean_thetas(contender, coef, grid)))(jnp.asarray(coef))
    contexts = jnp.tile(grid, (trials * num, 1))
    devices = jax.local_devices()[:1]
    outcome = evaluate(key, contender.task, contexts, means.reshape(-1, dim), devices=devices)
    return np.asarray(outcome.reward).reshape(trials, num, len(grid))
