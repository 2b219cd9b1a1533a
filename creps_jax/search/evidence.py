"""Test whether rewards depend on the parameters, so that noise alone does not reduce the exploration.

A covariance fitted to weighted samples is too small even if the weights are noise: fewer samples carry the
weight, and the logarithm of a sample covariance is biased downwards. Therefore the covariance of the policy
moves in proportion to the evidence that weights and parameters depend on each other.
"""

import math

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import erfc

from creps_jax.numerics.linalg import exact_dot, normalised, safe_sqrt, weighted_mean
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["independence_p_value", "share_of_evidence"]

_LEAST_VARIANCE = 1e-4
"""Variance below which squares of whitened parameters count as constant; if Gaussian, they have 2."""
_ROUNDING = 64.0
"""Largest spread of a constant column by rounding of its sums, in units of the rounding of its mean."""
_NUM_TESTS = 3


def independence_p_value(
    weights: Float[Array, " n"],
    prior: Float[Array, " n"],
    features: Float[Array, "n p"],
    theta: Float[Array, "n d"],
) -> Scalar:
    """Test whether the weights of samples are independent of their parameters, given the context.

    The result is the smallest p-value of three tests, times three (Bonferroni). Parameters are whitened
    after a regression on the features of the context. Two F-tests regress the change of the weights on the
    parameters and on their squares. A chi-squared test checks whether the samples that gain weight lie closer
    to each other than all samples do. p-values far below 0.01 are approximate, as weights are not Gaussian.

    Args:
        weights: Weights d of the samples that follow from their rewards; they sum to one.
        prior: Weights before rewards were seen, such as importance weights; zero where a sample does not
            count. Their scale does not matter.
        features: Policy features of the contexts. Rows of samples that do not count must be finite, too.
        theta: Parameters, likewise; or the noise that a policy has added to its mean, which is linear in
            features and parameters and gives the same result. A parameter is left out if the features and the
            parameters before it explain all but about 1 % of its standard deviation (in float32).

    Returns:
        The p-value: the probability of a dependence at least this strong if there is none. It is 1 if there
        are too few samples for a test, no more than features and parameters, or if all weights equal the
        prior.

    Source: Fisher 1925, Statistical methods for research workers (analysis of variance).
    """
    prior = normalised(prior)
    change = jnp.where(prior > 0, weights - prior, 0.0)
    white_features, noise, num_features, num_directions = _whitened(prior, features, theta)
    num_samples = 1.0 / jnp.maximum(jnp.sum(prior**2), jnp.finfo(prior.dtype).tiny)
    freedom = num_samples - num_features
    total = jnp.sum(change**2 / jnp.where(prior > 0, prior, 1.0))
    squares = noise**2
    p_values = jnp.stack(
        [
            _regression_p_value(exact_dot(change, noise) ** 2, total, num_directions, freedom),
            _regression_p_value(_explained(change, prior, squares), total, num_directions, freedom),
            _concentration_p_value(change, prior, white_features, noise, num_features, num_directions),
        ]
    )
    return jnp.minimum(_NUM_TESTS * jnp.min(p_values), 1.0)


def share_of_evidence(p_value: ScalarLike, significance: float) -> Scalar:
    """Return the fraction of the way to the fitted covariance that the covariance moves, from 0 to 1.

    Args:
        p_value: From `independence_p_value`, from 0 to 1.
        significance: Least p-value, above 0, at which the covariance does not move.
    """
    return jnp.clip(1.0 - p_value / significance, 0.0, 1.0)


def _whitened(prior: Array, features: Array, theta: Array) -> tuple[Array, Array, Scalar, Scalar]:
    """Regress the parameters on the features, and whiten both.

    Returns:
        Whitened features; whitened residuals of the parameters; the number of independent features, a
        constant included; the number of independent directions of the residuals. Columns that depend on
        others are zero.
    """
    counts = (prior > 0)[:, None]
    columns = jnp.where(counts, jnp.concatenate([features, theta], axis=1), 0.0)
    # Squares of the columns must not overflow, whatever their units.
    size = jnp.max(jnp.abs(columns), axis=0)
    columns = columns / jnp.where(size > 0, size, 1.0)[None, :]
    means = weighted_mean(columns, prior)
    columns = jnp.where(counts, columns - means[None, :], 0.0)
    products = exact_dot(columns.T, prior[:, None] * columns)
    eps, spread = jnp.finfo(columns.dtype).eps, safe_sqrt(jnp.diagonal(products))
    # Columns that are constant up to rounding become zero; the others are scaled to a spread of one.
    is_spread = spread > _ROUNDING * eps * jnp.abs(means)
    unit = jnp.where(is_spread, 1.0 / jnp.where(is_spread, spread, 1.0), 0.0)
    # One factorisation regresses and whitens: it makes each column uncorrelated with those before it.
    identity, rounding = jnp.eye(unit.size, dtype=unit.dtype), 4.0 * unit.size * eps
    factor = jnp.linalg.cholesky(unit[:, None] * products * unit[None, :] + rounding * identity)
    is_independent = is_spread & (jnp.diagonal(factor) > 2.0 * rounding**0.5)
    inverse = solve_triangular(factor, identity, lower=True).T
    white = jnp.where(is_independent[None, :], unit[:, None] * inverse, 0.0)
    num_features = features.shape[1]
    counts = is_independent.astype(prior.dtype)
    white = exact_dot(columns, white)
    return (
        white[:, :num_features],
        white[:, num_features:],
        1.0 + jnp.sum(counts[:num_features]),
        jnp.sum(counts[num_features:]),
    )


def _explained(change: Array, prior: Array, columns: Array) -> Array:
    """Return the part of `change / prior` that each column explains, standardised."""
    means = exact_dot(jnp.stack([change, prior]), columns)
    spread = exact_dot(prior, columns**2) - means[1] ** 2
    covariance = means[0] - jnp.sum(change) * means[1]
    is_spread = spread > _LEAST_VARIANCE
    return jnp.where(is_spread, covariance**2 / jnp.where(is_spread, spread, 1.0), 0.0)


def _regression_p_value(explained: Array, total: Scalar, num_regressors: Scalar, freedom: Scalar) -> Scalar:
    """Return the p-value of the F-test that no regressor explains `change / prior`.

    Regressors are standardised and nearly uncorrelated. `freedom` is the degrees of freedom without them.
    """
    r_squared = jnp.clip(jnp.sum(explained) / jnp.where(total > 0, total, 1.0), 0.0, 1.0)
    rest = freedom - num_regressors
    is_testable = (rest >= 1.0) & (num_regressors > 0) & (total > 0)
    p_value = _f_survival(
        r_squared, jnp.where(is_testable, num_regressors, 1.0), jnp.where(is_testable, rest, 1.0)
    )
    return jnp.where(is_testable, p_value, 1.0)


def _concentration_p_value(
    change: Array, prior: Array, features: Array, noise: Array, num_features: Scalar, num_directions: Scalar
) -> Scalar:
    """Return the p-value of the chi-squared test that samples that gain weight have the common spread.

    A few samples that lie close to each other are evidence that regressions on all samples hardly detect.
    """
    gain = jnp.maximum(change, 0.0)
    gain = gain / jnp.where(jnp.any(gain > 0), jnp.sum(gain), 1.0)
    # Their spread after a regression on the features, from the products of all columns.
    columns = jnp.concatenate([jnp.ones_like(gain)[:, None], features, noise], axis=1)
    products = exact_dot(columns.T, gain[:, None] * columns)
    size = 1 + features.shape[1]
    identity = jnp.eye(size, dtype=gain.dtype)
    jitter = 10.0 * size * jnp.finfo(gain.dtype).eps * (1.0 + jnp.trace(products[:size, :size]))
    factor = jnp.linalg.cholesky(products[:size, :size] + jitter * identity)
    explained = solve_triangular(factor, products[:size, size:], lower=True)
    spread = jnp.trace(products[size:, size:]) - jnp.sum(explained**2)

    num_samples = 1.0 / jnp.maximum(jnp.sum(gain**2), jnp.finfo(gain.dtype).tiny)
    rest = num_samples - num_features
    sizes = jnp.sum(noise**2, axis=1)
    variance = exact_dot(prior, (sizes - num_directions) ** 2)
    # Fewer degrees of freedom if sizes vary more than for a Gaussian, as for a mixture of policies.
    freedom = (
        rest
        * num_directions
        * jnp.minimum(2.0 * num_directions / jnp.where(variance > 0, variance, 1.0), 1.0)
    )
    is_testable = (rest > 0.5) & (num_directions > 0) & jnp.any(gain > 0)
    freedom = jnp.where(is_testable, freedom, 1.0)
    ratio = jnp.maximum(spread, 0.0) / jnp.where(is_testable, num_directions * rest / num_samples, 1.0)
    return jnp.where(is_testable, _chi_squared_cdf(ratio, freedom), 1.0)


def _chi_squared_cdf(ratio: Array, freedom: Array) -> Scalar:
    """Return the probability of a chi-squared number below `ratio` times its mean, by chance.

    Source: Wilson and Hilferty 1931, The distribution of chi-square.
    """
    spread = 2.0 / (9.0 * freedom)
    normal = (jnp.cbrt(ratio) - (1.0 - spread)) / jnp.sqrt(spread)
    return 0.5 * erfc(-normal / math.sqrt(2.0))


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
