"""The tasks on which `experiments.benchmarks.search` compares searches."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax.contexts import context_grid, uniform_contexts
from creps_jax.policies.base import MStep
from creps_jax.policies.features import FeatureMap, linear_features, rbf_features
from creps_jax.policies.gaussian import LinearGaussian, start_policy
from creps_jax.search.fit import bounded_ml
from creps_jax.tasks import PlainOutcome, Task, contextual_function, hole_reaching, via_point_reaching
from creps_jax.tasks.functions import rosenbrock, sphere
from experiments.updates import CONTEXT_DIM, FUNCTION_KL_BOUNDS, FUNCTIONS, THETA_DIM

FALL_REWARD = -1000.0


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """A task, the settings of the searches on it, and how mean policies are evaluated.

    Attributes:
        task: the task to learn.
        noise_free: the task by which mean policies are evaluated.
        features: features of policy and baseline.
        start: the first policy.
        grid: (n, s) contexts of the evaluation.
        tried: (4, s) contexts of the searches with fixed contexts.
        episodes: rollouts of a trial.
        samples: new samples of an iteration.
        surrogate_samples: the same for the surrogate, which needs fewer on smooth functions.
        m_step: the bounded fit.
        archive_sizes: samples kept by weighted ML and by the bounded fit.
        kl_bound: bound of contextual REPS, nats.
        ridge: relative penalty on the coefficients of the policy.
    """

    task: Task
    noise_free: Task
    features: FeatureMap
    start: LinearGaussian
    grid: jax.Array
    tried: jax.Array
    episodes: int
    samples: int
    surrogate_samples: int
    m_step: MStep
    archive_sizes: tuple[int, int]
    kl_bound: float = 1.0
    ridge: float = 1e-4


def function(
    test_function: Callable[[jax.Array], jax.Array], dim: int = THETA_DIM, *, falls: float = 0.0
) -> Problem:
    """Make the usual benchmark: 2 contexts move the minimum of a function, 10,000 episodes.

    Args:
        test_function: the function to minimise.
        dim: number of parameters.
        falls: probability of the reward -1000 instead.
    """
    transform_key, start_key = jax.random.split(jax.random.key(7))
    clean = contextual_function(test_function, jax.random.normal(transform_key, (dim, CONTEXT_DIM)))
    features = linear_features(CONTEXT_DIM)
    coef = jnp.zeros((features.size, dim)).at[0].set(jax.random.normal(start_key, (dim,)))
    mean_kl_bound, cov_kl_bound = FUNCTION_KL_BOUNDS

    def rollout(key: jax.Array, context: jax.Array, theta: jax.Array) -> PlainOutcome:
        outcome = clean.rollout(key, context, theta)
        is_fall = jax.random.bernoulli(key, falls)
        return outcome._replace(reward=jnp.where(is_fall, FALL_REWARD, outcome.reward))

    return Problem(
        task=dataclasses.replace(clean, rollout=rollout) if falls else clean,
        noise_free=clean,
        features=features,
        start=LinearGaussian(coef, jnp.eye(dim)),
        grid=context_grid((1.0, 1.0), (2.0, 2.0), 5),
        tried=context_grid((1.0, 1.0), (2.0, 2.0), 2),
        episodes=10_000,
        samples=50,
        surrogate_samples=25 if dim <= THETA_DIM else 50,
        m_step=bounded_ml(mean_kl_bound=mean_kl_bound, cov_kl_bound=cov_kl_bound),
        archive_sizes=(1000, 10 * (dim + features.size) if dim > THETA_DIM else 200),
        ridge=1e-10,
    )


def quadratic(
    dim: int, context_dim: int, episodes: int, samples: int, *, noise: float = 0.0, is_root: bool = False
) -> Problem:
    """Make a rotated quadratic of condition number 100, whose optimum is affine in the context.

    Args:
        dim: number of parameters.
        context_dim: number of context variables.
        episodes: rollouts of a trial.
        samples: new samples of an iteration.
        noise: standard deviation of noise in the reward.
        is_root: whether the reward is minus the root of the quadratic.
    """
    transform_key, offset_key, rotation_key = jax.random.split(jax.random.key(3), 3)
    transform = jax.random.normal(transform_key, (dim, context_dim))
    offset = jax.random.normal(offset_key, (dim,))
    rotation, _ = np.linalg.qr(np.asarray(jax.random.normal(rotation_key, (dim, dim))))
    curvature = jnp.asarray(rotation @ np.diag(np.logspace(0, 2, dim)) @ rotation.T, jnp.float32)

    def make(noise: float) -> Task:
        def rollout(key: jax.Array, context: jax.Array, theta: jax.Array) -> PlainOutcome:
            error = theta - transform @ context - offset
            loss = error @ curvature @ error
            loss = jnp.sqrt(loss) if is_root else loss
            return PlainOutcome(noise * jax.random.normal(key) - loss, jnp.zeros(0))

        contexts = uniform_contexts((-1.0,) * context_dim, (1.0,) * context_dim)
        return Task(contexts, rollout, context_dim, dim, worst_reward=-1e4)

    features = linear_features(context_dim)
    low, high = (-1.0,) * context_dim, (1.0,) * context_dim
    size = max(10 * (dim + features.size), 2 * samples)
    return Problem(
        task=make(noise),
        noise_free=make(0.0),
        features=features,
        start=start_policy(features, dim),
        grid=context_grid(low, high, 5),
        tried=context_grid(low, high, 4 if context_dim == 1 else 2),
        episodes=episodes,
        samples=samples,
        surrogate_samples=samples,
        m_step=bounded_ml(),
        archive_sizes=(2 * size, size),
    )


def curve(best: Callable[[jax.Array], jax.Array]) -> Problem:
    """Make a single parameter whose best value is a curve over one context; 10 RBFs leave a regret at a jump.

    Args:
        best: the best value at a context from 0 to 10. The reward is minus the square of the error.
    """
    low, high = 0.0, 10.0

    def rollout(key: jax.Array, context: jax.Array, theta: jax.Array) -> PlainOutcome:
        return PlainOutcome(-jnp.sum((theta - best(context)) ** 2), jnp.zeros(0))

    features = rbf_features(low, high, 10)
    task = Task(uniform_contexts(low, high), rollout, 1, 1, worst_reward=-1e4)
    return Problem(
        task=task,
        noise_free=task,
        features=features,
        start=start_policy(features, 1),
        grid=context_grid(low, high, 101),
        tried=context_grid(low, high, 4),
        episodes=10_000,
        samples=50,
        surrogate_samples=50,
        m_step=bounded_ml(),
        archive_sizes=(1000, 200),
    )


def via_points() -> Problem:
    """Make the paper's reaching of via-points."""
    low, high = (-1.5, -1.5), (-0.5, -0.5)
    grid, tried = context_grid(low, high, 6), context_grid(low, high, 2)
    return _of_paper(via_point_reaching(), rbf_features(low, high, 2), grid, tried, std=1.0)


def hole() -> Problem:
    """Make the paper's reaching into a hole."""
    grid, tried = context_grid(1.4, 2.0, 25), context_grid(1.4, 2.0, 4)
    return _of_paper(hole_reaching(), rbf_features(1.4, 2.0, 6), grid, tried, std=0.5)


def _of_paper(task: Task, features: FeatureMap, grid: jax.Array, tried: jax.Array, *, std: float) -> Problem:
    return Problem(
        task=task,
        noise_free=task,
        features=features,
        start=start_policy(features, task.theta_dim, std=std),
        grid=grid,
        tried=tried,
        episodes=10_000,
        samples=50,
        surrogate_samples=50,
        m_step=bounded_ml(mean_kl_bound=0.3, cov_kl_bound=0.005),
        archive_sizes=(2000, 400),
        kl_bound=0.5,
    )


def _function(name: str) -> Callable[[], Problem]:
    return lambda: function(FUNCTIONS[name])


PROBLEMS: dict[str, Callable[[], Problem]] = {
    **{name: _function(name) for name in FUNCTIONS},
    "sphere50": lambda: function(sphere, 50),
    "rosenbrock50": lambda: function(rosenbrock, 50),
    "falls": lambda: function(sphere, falls=0.1),
    "via-points": via_points,
    "hole": hole,
    "sine": lambda: curve(jnp.sin),
    "step": lambda: curve(lambda context: jnp.sign(context - 5.0)),
    "quadratic5": lambda: quadratic(5, 1, 300, 10),
    "root5": lambda: quadratic(5, 1, 300, 10, is_root=True),
    "quadratic10": lambda: quadratic(10, 2, 1000, 20),
    "root10": lambda: quadratic(10, 2, 1000, 20, is_root=True),
    "noise": lambda: quadratic(10, 2, 1000, 20, noise=1.0),
}
"""By name: test functions with 20 parameters, two with 50, the sphere with 10 % falls, the paper's tasks,
curves of one parameter, and rotated quadratics and their roots with 5 and 10 parameters, one with noise of
standard deviation 1."""
