"""Contextual CMA-ES, a search to compare with: ranks of advantages instead of rewards, and two paths.

Source: Abdolmaleki et al. 2017, Contextual covariance matrix adaptation evolutionary strategies.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from creps_jax.numerics.linalg import safe_cholesky
from creps_jax.policies.features import FeatureMap
from creps_jax.policies.gaussian import LinearGaussian, sample_rows
from creps_jax.search.archive import Batch
from creps_jax.search.base import Search

RIDGE = 1e-6
"""Penalty on the coefficients of mean and baseline, relative to the mean square of each feature."""
LARGEST_STEP = 0.6
"""Largest change of the logarithm of the step size in an update."""


class State(NamedTuple):
    """The policy N(coef' x, step_size^2 shape), and the paths of its mean."""

    coef: jax.Array
    shape: jax.Array
    log_step_size: jax.Array
    path_of_shape: jax.Array
    path_of_step_size: jax.Array
    iteration: jax.Array


class Info(NamedTuple):
    """Diagnostics of an update."""

    step_size: jax.Array


def contextual_cma(features: FeatureMap) -> Search:
    """Make the search; baseline and policy have the same features, and an update uses the new samples only.

    The first policy is a `LinearGaussian`; the first step size is one.
    """
    return Search(_init, partial(_ask, features), partial(_tell, features), _policy)


def _init(policy: LinearGaussian) -> State:
    zero = jnp.zeros(policy.coef.shape[1], policy.coef.dtype)
    shape = policy.cov_chol @ policy.cov_chol.T
    return State(policy.coef, shape, jnp.zeros((), zero.dtype), zero, zero, jnp.zeros((), jnp.int32))


def _policy(state: State) -> LinearGaussian:
    return LinearGaussian(state.coef, jnp.exp(state.log_step_size) * safe_cholesky(state.shape))


def _ask(features: FeatureMap, key: jax.Array, state: State, contexts: ArrayLike) -> jax.Array:
    return sample_rows(key, _policy(state), features(jnp.asarray(contexts)))


def _tell(features: FeatureMap, state: State, batch: Batch) -> tuple[State, Info]:
    theta, reward = jnp.asarray(batch.theta), jnp.asarray(batch.reward)
    x = features(jnp.asarray(batch.context))
    num, dim = theta.shape
    total = dim + batch.context.shape[1]
    by_rank = math.log(num + 0.5) - np.log(np.arange(1, num + 1))
    by_rank = by_rank / by_rank.sum()
    effective = 1.0 / float(np.sum(by_rank**2))

    advantage = reward - x @ _regress(x, reward[:, None], jnp.ones(num))[:, 0]
    weights = jnp.zeros(num, theta.dtype).at[jnp.argsort(-advantage)].set(by_rank)
    coef = _regress(x, theta, weights)
    step_size = jnp.exp(state.log_step_size)
    change = (jnp.mean(x, axis=0) @ (coef - state.coef)) / step_size

    rate = (effective + 2.0) / (total + effective + 3.0)
    damping = (
        1.0
        + 2.0 * max(0.0, math.sqrt((effective - 1.0) / (total + 1.0)) - 1.0)
        + rate
        + math.log(1 + 2 * total)
    )
    squares, axes = jnp.linalg.eigh(state.shape)
    squares = jnp.maximum(squares, jnp.finfo(theta.dtype).eps * squares[-1])
    white = axes @ ((axes.T @ change) / jnp.sqrt(squares))
    path = (1.0 - rate) * state.path_of_step_size + math.sqrt(rate * (2.0 - rate) * effective) * white
    length = jnp.sum(path**2) / dim
    first = 1.0 - (1.0 - rate) ** (2.0 * (state.iteration.astype(theta.dtype) + 1.0))
    is_slow = length / first < 2.0 + 4.0 / (dim + 1.0)

    rate_of_path = 4.0 / (4.0 + total)
    gain = jnp.where(is_slow, math.sqrt(rate_of_path * (2.0 - rate_of_path) * effective), 0.0)
    path_of_shape = (1.0 - rate_of_path) * state.path_of_shape + gain * change
    of_one = 2.0 * min(1.0, num / 6.0) / ((total + 1.3) ** 2 + effective)
    of_many = 2.0 * (effective - 2.0 + 1.0 / effective) / ((total + 2.0) ** 2 + effective)
    of_many = min(1.0 - of_one, of_many)
    kept = jnp.where(is_slow, 0.0, of_one * rate_of_path * (2.0 - rate_of_path))
    noise = (theta - x @ state.coef) / step_size
    shape = (1.0 - of_one - of_many + kept) * state.shape
    shape += of_one * jnp.outer(path_of_shape, path_of_shape) + of_many * (noise.T * weights[None, :]) @ noise
    growth = jnp.minimum(rate / (2.0 * damping) * (length - 1.0), LARGEST_STEP)
    new = State(coef, shape, state.log_step_size + growth, path_of_shape, path, state.iteration + 1)
    return new, Info(jnp.exp(new.log_step_size))


def _regress(x: jax.Array, values: jax.Array, weights: jax.Array) -> jax.Array:
    """Return the coefficients of a weighted ridge regression."""
    weights = weights / jnp.sum(weights)
    products = (x.T * weights[None, :]) @ x
    penalty = RIDGE * jnp.diag(products) + jnp.finfo(x.dtype).tiny
    return jnp.linalg.solve(products + jnp.diag(penalty), (x.T * weights[None, :]) @ values)
