"""Judge by a significance test whether rewards say anything about the parameters.

The covariance that is fitted to weighted samples is smaller than that of the samples even where the weights
are noise: fewer samples carry the weight, and the logarithm of a sample covariance is biased downwards. A
search that takes this for success loses its exploration. So the covariance of the policy moves in proportion
to the evidence that weights and parameters depend on each other.
"""

import math

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import erfc

from creps_jax.linalg import exact_dot, normalised, safe_sqrt, weighted_mean
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["blended_cov_chol", "independence_p_value", "share_of_evidence"]

_LEAST_VARIANCE = 1e-4
"""Squares of whitened parameters, which have a variance of 2 if Gaussian, are constant below this one."""
_NUM_TESTS = 3


def independence_p_value(
    weights: Float[Array, " n"],
    prior: Float[Array, " n"],
    features: Float[Array, "n p"],
    theta: Float[Array, "n d"],
) -> Scalar:
    """Test whether the weights of samples are independent of their parameters, given the context.

    Three F-tests, of which the most significant counts, times three (Bonferroni): the change of the weights
    is regressed on the parameters, on their squares, and on the sum of their squares. Parameters are whitened
    after a regression on the features of the context.

    Args:
        weights: Weights d of the samples that follow from their rewards; they sum to one.
        prior: Weights before rewards were seen, such as those of importance; zero where a sample does not
            count. Their scale does not matter.
        features: Policy features of the contexts. Rows that do not count have to be finite.
        theta: Parameters, likewise, or what a policy has added to its mean: a linear function of features and
            parameters tests the same. Of parameters that are nearly dependent on others or on the features,
            with less than a hundredth of their spread left, only the others are tested.

    Returns:
        The p-value: how likely a dependence as strong as this one is where there is none. It is 1 where there
        are too few samples to test for it, no more than features and parameters, or where no weight differs
        from that of before.

    Source: Fisher 1925, Statistical methods for research workers (analysis of variance).
    """
    prior = normalised(prior)
    change = jnp.where(prior > 0, weights - prior, 0.0)
    noise, num_features, num_directions = _whitened_noise(prior, features, theta)
    squares = noise**2
    sums = jnp.sum(squares, axis=1, keepdims=True) - num_directions
    num_samples = 1.0 / jnp.maximum(jnp.sum(prior**2), jnp.finfo(prior.dtype).tiny)
    freedom = num_samples - num_features

    total = jnp.sum(change**2 / jnp.where(prior > 0, prior, 1.0))
    of_noise = exact_dot(change, noise) ** 2
    of_squares = _explained(change, prior, squares)
    of_sums = _explained(change, prior, sums)
    one = jnp.ones_like(num_directions)
    p_values = jnp.stack(
        [
            _regression_p_value(of_noise, total, num_directions, freedom),
            _regression_p_value(of_squares, total, num_directions, freedom),
            # The size of whitened noise is constant where there are no more samples than directions.
            _regression_p_value(of_sums, total, one, freedom - num_directions),
        ]
    )
    return jnp.minimum(_NUM_TESTS * jnp.min(p_values), 1.0)


def share_of_evidence(p_value: ScalarLike, significance: float) -> Scalar:
    """Return how far the evidence lets the covariance move: 1 for a p-value of 0, 0 from `significance`."""
    return jnp.clip(1.0 - p_value / significance, 0.0, 1.0)


def blended_cov_chol(
    old: Float[Array, "d d"], new: Float[Array, "d d"], share: ScalarLike
) -> Float[Array, "d d"]:
    """Return the Cholesky factor of `(1 - share) old old' + share new new'`, to the bit at 0 and 1.

    The relative entropy to the old covariance is convex in the new one: the blend keeps its bounds.
    """
    share = jnp.asarray(share, new.dtype)
    # In units of the old one nothing is lost to the squares of small spreads.
    change = solve_triangular(old, new, lower=True)
    blend = (1.0 - share) * jnp.eye(old.shape[0], dtype=new.dtype) + share * exact_dot(change, change.T)
    is_between = (share > 0.0) & (share < 1.0)
    factor = jnp.linalg.cholesky(jnp.where(is_between, blend, jnp.eye(old.shape[0], dtype=new.dtype)))
    return jnp.where(share >= 1.0, new, jnp.where(share <= 0.0, old, jnp.tril(exact_dot(old, factor))))


def _whitened_noise(prior: Array, features: Array, theta: Array) -> tuple[Array, Scalar, Scalar]:
    """Return what a regression on the features leaves of the parameters, whitened, and two numbers: of
    independent features, a constant included, and of independent directions of the parameters.

    Columns that depend on others become zero.
    """
    counts = (prior > 0)[:, None]
    columns = jnp.where(counts, jnp.concatenate([features, theta], axis=1), 0.0)
    # Squares of the columns have to stay within the format, whatever their units.
    size = jnp.max(jnp.abs(columns), axis=0)
    columns = columns / jnp.where(size > 0, size, 1.0)[None, :]
    means = weighted_mean(columns, prior)
    columns = jnp.where(counts, columns - means[None, :], 0.0)
    products = exact_dot(columns.T, prior[:, None] * columns)
    eps, spread = jnp.finfo(columns.dtype).eps, safe_sqrt(jnp.diagonal(products))
    # What is constant up to rounding becomes zero; the others are scaled to a spread of one.
    is_spread = spread > 4.0 * eps * jnp.abs(means)
    unit = jnp.where(is_spread, 1.0 / jnp.where(is_spread, spread, 1.0), 0.0)
    # One factorisation regresses and whitens, as it frees each column of those before it.
    identity, rounding = jnp.eye(unit.size, dtype=unit.dtype), 4.0 * unit.size * eps
    factor = jnp.linalg.cholesky(unit[:, None] * products * unit[None, :] + rounding * identity)
    is_independent = is_spread & (jnp.diagonal(factor) > 2.0 * rounding**0.5)
    inverse = solve_triangular(factor, identity, lower=True).T
    white = jnp.where(is_independent[None, :], unit[:, None] * inverse, 0.0)
    num_features = features.shape[1]
    counts = is_independent.astype(prior.dtype)
    noise = exact_dot(columns, white[:, num_features:])
    return noise, 1.0 + jnp.sum(counts[:num_features]), jnp.sum(counts[num_features:])


def _explained(change: Array, prior: Array, columns: Array) -> Array:
    """Return the part of `change / prior` that each column explains, once it has mean zero and spread one."""
    means = exact_dot(jnp.stack([change, prior]), columns)
    spread = exact_dot(prior, columns**2) - means[1] ** 2
    covariance = means[0] - jnp.sum(change) * means[1]
    is_spread = spread > _LEAST_VARIANCE
    return jnp.where(is_spread, covariance**2 / jnp.where(is_spread, spread, 1.0), 0.0)


def _regression_p_value(explained: Array, total: Scalar, num_regressors: Scalar, freedom: Scalar) -> Scalar:
    """Return the p-value of the F-test that no regressor explains `change / prior`.

    Regressors are standardised and nearly uncorrelated. `freedom` is what samples have without them.
    """
    r_squared = jnp.clip(jnp.sum(explained) / jnp.where(total > 0, total, 1.0), 0.0, 1.0)
    rest = freedom - num_regressors
    is_testable = (rest >= 1.0) & (num_regressors > 0) & (total > 0)
    p_value = _f_survival(
        r_squared, jnp.where(is_testable, num_regressors, 1.0), jnp.where(is_testable, rest, 1.0)
    )
    return jnp.where(is_testable, p_value, 1.0)


def _f_survival(r_squared: Array, num_regressors: Array, rest: Array) -> Scalar:
    """Return the probability of a share of explained variance above `r_squared`, by chance.

    Source: Paulson 1942, An approximate normalization of the analysis of variance distribution. The
    incomplete beta function would be exact, and compile for seconds.
    """
    left = jnp.maximum(1.0 - r_squared, jnp.finfo(r_squared.dtype).eps)
    root = jnp.cbrt(r_squared / num_regressors / (left / rest))
    spread = jnp.sqrt(2.0 / (9.0 * rest) * root**2 + 2.0 / (9.0 * num_regressors))
    normal = ((1.0 - 2.0 / (9.0 * rest)) * root - (1.0 - 2.0 / (9.0 * num_regressors))) / spread
    return 0.5 * erfc(normal / math.sqrt(2.0))
