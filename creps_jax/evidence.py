"""Judge by a significance test whether rewards say anything about the parameters.

The covariance that is fitted to weighted samples is smaller than that of the samples even where the weights
are noise: fewer samples carry the weight, and the logarithm of a sample covariance is biased downwards. A
search that takes this for success loses its exploration. So the covariance of the policy moves in proportion
to the evidence that weights and parameters depend on each other.
"""

import math

import jax.numpy as jnp
from jax.scipy.special import erfc

from creps_jax.linalg import centre_columns, cholesky_of_root, exact_dot, normalised, whitening
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["blended_cov_chol", "independence_p_value", "share_of_evidence"]

_LEAST_SPREAD = 3e-4
"""Directions with less spread than this, as a share of a column's, count as rounding."""
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
        theta: Parameters, likewise.

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
    sums = jnp.sum(squares, axis=1, keepdims=True)

    num_samples = 1.0 / jnp.maximum(jnp.sum(prior**2), jnp.finfo(prior.dtype).tiny)
    freedom = num_samples - num_features
    one = jnp.ones_like(num_directions)
    p_values = jnp.stack(
        [
            _regression_p_value(change, prior, noise, num_directions, freedom),
            _regression_p_value(change, prior, _standardised(squares, prior), num_directions, freedom),
            # The size of whitened noise is constant where there are no more samples than directions.
            _regression_p_value(change, prior, _standardised(sums, prior), one, freedom - num_directions),
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
    blend = cholesky_of_root(jnp.concatenate([jnp.sqrt(1.0 - share) * old, jnp.sqrt(share) * new], axis=1))
    return jnp.where(share >= 1.0, new, jnp.where(share <= 0.0, old, blend))


def _whitened_noise(prior: Array, features: Array, theta: Array) -> tuple[Array, Scalar, Scalar]:
    """Return what a regression on the features leaves of the parameters, whitened, and two numbers: of
    independent features, a constant included, and of independent directions of the parameters.
    """
    white_features, num_features = _whitened(features, prior)
    centred = centre_columns(theta, prior)
    explained = exact_dot(white_features, exact_dot(white_features.T, prior[:, None] * centred))
    noise, num_directions = _whitened(centred - explained, prior)
    return noise, 1.0 + num_features, num_directions


def _whitened(columns: Array, prior: Array) -> tuple[Array, Scalar]:
    """Return uncorrelated columns of mean zero and mean square one, zeros in place of those that depend on
    others, and how many there are.
    """
    centred = centre_columns(columns, prior)
    matrix = whitening(centred, prior, least_spread=_LEAST_SPREAD)
    return exact_dot(centred, matrix), jnp.sum(jnp.any(matrix != 0, axis=0), dtype=prior.dtype)


def _standardised(columns: Array, prior: Array) -> Array:
    """Return columns of mean zero and mean square one; those without spread are zero."""
    centred = centre_columns(columns, prior)
    mean_square = exact_dot(prior, centred**2)
    is_spread = mean_square > jnp.finfo(prior.dtype).eps
    root = jnp.sqrt(jnp.where(is_spread, mean_square, 1.0))
    return jnp.where(is_spread[None, :], centred / root[None, :], 0.0)


def _regression_p_value(
    change: Array, prior: Array, regressors: Array, num_regressors: Scalar, freedom: Scalar
) -> Scalar:
    """Return the p-value of the F-test that no regressor explains `change / prior`.

    Regressors are standardised and nearly uncorrelated. `freedom` is what samples have without them.
    """
    explained = jnp.sum(exact_dot(change, regressors) ** 2)
    total = jnp.sum(change**2 / jnp.where(prior > 0, prior, 1.0))
    r_squared = jnp.clip(explained / jnp.where(total > 0, total, 1.0), 0.0, 1.0)
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
