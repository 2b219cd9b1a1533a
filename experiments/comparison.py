"""Compare ways to learn: trials of each, judged by their mean policies on one grid of contexts."""

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from creps_jax.creps import Creps, creps
from creps_jax.features import FeatureMap
from creps_jax.policy import LinearGaussian
from creps_jax.tasks.base import Task
from creps_jax.train import evaluate
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


class LearnerSettings(Protocol):
    """The settings of an experiment that `make_contender` reads."""

    @property
    def kl_bound(self) -> float:
        """The bound epsilon, nats."""
        ...

    @property
    def archive_size(self) -> int:
        """L, samples kept."""
        ...

    @property
    def ridge(self) -> float:
        """Relative penalty on the policy's coefficients."""
        ...

    @property
    def start_std(self) -> float:
        """Standard deviation of the first policy, whose mean is zero."""
        ...


def make_contender(
    task: Task, features: tuple[FeatureMap, FeatureMap], settings: LearnerSettings
) -> Contender:
    """Put a contender together from policy and baseline features and an experiment's settings."""
    algorithm = creps(
        *features, kl_bound=settings.kl_bound, archive_size=settings.archive_size, ridge=settings.ridge
    )
    dim = task.theta_dim
    start = LinearGaussian(jnp.zeros((features[0].size, dim)), settings.start_std * jnp.eye(dim))
    return Contender(task, algorithm, start)


def compare(
    contenders: Mapping[str, Contender],
    plan: Plan,
    key: jax.Array,
    *,
    trials: int,
    grid: jax.Array,
    session: Session = Session(),
) -> dict[str, np.ndarray]:
    """Let each contender learn, all its trials at once, and judge its mean policies on a grid of contexts.

    Args:
        contenders: by name; all begin with the same keys.
        plan: iterations and samples.
        key: random key.
        trials: trials of each.
        grid: (n, s) contexts to judge on.
        session: where to keep checkpoints and show progress.

    Returns:
        `context`, the grid; `episodes` (iterations,) and `evaluated`, the iterations (from 1) after which
        mean policies were judged; and for each NAME: `NAME.sample_reward` and `NAME.kl` (trials, iterations),
        `NAME.grid_reward` (trials, evaluated, n), `NAME.coef` (trials, p, d), the last policies'.
    """
    # Rollouts as short as these are not worth sharing out.
    devices = jax.local_devices()[:1]
    learn_key, evaluate_key = jax.random.split(key)
    evaluated = np.unique(np.linspace(1, plan.iterations, NUM_EVALUATED).round().astype(int))
    arrays = {
        "episodes": plan.episodes(np.arange(1, plan.iterations + 1)),
        "evaluated": evaluated,
        "context": np.asarray(grid),
    }
    keys = trial_keys(learn_key, trials)
    for name, (task, algorithm, start) in contenders.items():
        _, log = learn(keys, task, algorithm, start, plan, session=session, name=name, devices=devices)
        # A resumed run may have gone on for longer than is asked of it now.
        coef = log["coef"][:, evaluated - 1]
        arrays[f"{name}.sample_reward"] = log["mean_reward"][:, : plan.iterations]
        arrays[f"{name}.kl"] = log["info.kl"][:, : plan.iterations]
        arrays[f"{name}.grid_reward"] = _grid_reward(evaluate_key, task, algorithm, coef, grid)
        arrays[f"{name}.coef"] = coef[:, -1]
    return arrays


def mean_policy_curve(arrays: Mapping[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return episodes, and the mean reward over the grid of each trial's mean policy (trials, evaluated)."""
    return arrays["episodes"][arrays["evaluated"] - 1], arrays[f"{name}.grid_reward"].mean(axis=2)


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
    differences = regret(arrays, better) - regret(arrays, worse)
    return float(stats.wilcoxon(differences, alternative="less").pvalue) if differences.any() else 1.0


def postures(
    contender: Contender, coef: np.ndarray, contexts: jax.Array, points: Callable[[jax.Array], jax.Array]
) -> np.ndarray:
    """Return the postures of an arm under a mean policy: what `points` makes of each context's theta."""
    policy = LinearGaussian(jnp.asarray(coef), contender.start.cov_chol)
    return np.asarray(jax.vmap(points)(contender.algorithm.mean(policy, contexts)))


def _grid_reward(
    key: jax.Array, task: Task, algorithm: Creps, coef: np.ndarray, grid: jax.Array
) -> np.ndarray:
    """Return the reward of mean policies (trials, k, p, d) at contexts (n, s), as (trials, k, n)."""
    trials, num, _, dim = coef.shape

    def mean(coef: jax.Array) -> jax.Array:
        return algorithm.mean(LinearGaussian(coef, jnp.eye(dim)), grid)

    thetas = jax.vmap(jax.vmap(mean))(jnp.asarray(coef)).reshape(-1, dim)
    contexts = jnp.tile(grid, (trials * num, 1))
    outcome = evaluate(key, task, contexts, thetas, devices=jax.local_devices()[:1])
    return np.asarray(outcome.reward).reshape(trials, num, len(grid))
