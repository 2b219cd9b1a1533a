"""Fit a quadratic model of the reward to samples of a Gaussian policy, robustly.

The model of the reward in a context s, at parameters z in units of the policy's spread around its mean, is
`b(s) + z' B x(s) - z' A z / 2`. Coefficients are fitted by ridge regression; generalised cross-validation
chooses the penalty, and whether A has all entries, only its diagonal, or none.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax

from creps_jax.numerics.linalg import exact_dot, safe_sqrt
from creps_jax.typing import Array, Bool, Float, IntScalar, Scalar

__all__ = ["Quadratic", "fit_quadratic", "num_unknowns", "whitener"]

_FALL = 8.0
"""Distance below the median, in standard deviations, beyond which a reward is left out."""
_OUTLIER = 5.0
"""Distance from the model, in standard deviations of the residuals, beyond which a sample is left out."""
_MAX_ROUNDS = 3
_NORMAL = 1.4826
"""Standard deviation of normal numbers, in units of their median absolute deviation."""
_NUM_PENALTIES = 24
_MOST_FREEDOM = 0.85
"""Largest number of fitted coefficients per sample."""


class Quadratic(NamedTuple):
    """A quadratic model of the reward, in units of the deviation of the rewards."""

    slope: Float[Array, "d p"]
    """B: the gradient at the mean for each feature."""
    curvature: Float[Array, "d d"]
    """A: minus the second derivative, symmetric."""
    r2: Scalar
    """Share of the variance, beyond that of the context, that the model explains in cross-validation."""
    num_used: IntScalar
    """Number of samples that were fitted."""
    is_left_out: Bool[Array, " n"]
    """Whether a sample was left out, because it is far from the median or from the model."""


class _Ridge(NamedTuple):
    """A ridge regression."""

    coef: Float[Array, " m"]
    residual: Float[Array, " n"]
    r2: Scalar


def num_unknowns(theta_dim: int, num_features: int, num_context: int) -> int:
    """Return the number of coefficients of the whole model."""
    return theta_dim * (theta_dim + 1) // 2 + theta_dim * num_features + num_context


def fit_quadratic(
    z: Float[Array, "n d"],
    features: Float[Array, "n p"],
    context: Float[Array, "n q"],
    reward: Float[Array, " n"],
    is_used: Bool[Array, " n"],
    *,
    has_products: bool,
) -> Quadratic:
    """Fit a quadratic model of the reward.

    Falls, rewards more than 8 standard deviations below the median, are left out first; then samples more
    than 5 standard deviations from the model, in up to 3 rounds. Together at most 40 % are left out. Standard
    deviations are those of normal numbers with the same median absolute deviation.

    Args:
        z: Parameters in units of the policy's spread, around its mean.
        features: Features x of the slope, with a mean square of one, and uncorrelated.
        context: Columns b of the part that depends on the context only; a constant is among them.
        reward: Rewards.
        is_used: Samples to use; others may have any finite values.
        has_products: Whether A may have entries off its diagonal.

    Returns:
        The model.

    Source: Abdolmaleki et al. 2015, Model-based relative entropy stochastic search; Tangkaratt et al. 2017,
    Policy search with high-dimensional context variables; Golub et al. 1979, Generalized cross-validation.
    """
    num, dim = z.shape
    num_features = features.shape[1]
    columns, blocks = _design(z, features, has_products)
    count = jnp.sum(is_used, dtype=z.dtype)
    middle = _masked_median(reward, is_used)
    deviation = _NORMAL * _masked_median(jnp.abs(reward - middle), is_used)
    spread = jnp.sqrt(jnp.sum(jnp.where(is_used, reward - middle, 0.0) ** 2) / jnp.maximum(count, 1.0))
    deviation = jnp.where(deviation > 0, deviation, jnp.where(spread > 0, spread, 1.0))
    reward = jnp.where(is_used, (reward - middle) / deviation, 0.0)
    kept = _without_worst(jnp.maximum(-reward, 0.0), _FALL, is_used, is_used)

    def fit(kept: Array) -> _Ridge:
        return _ridge(columns, blocks, context, reward, kept)

    def next_kept(kept: Array, residual: Array) -> Array:
        limit = _OUTLIER * _NORMAL * _masked_median(jnp.abs(residual), kept)
        floor = 64.0 * jnp.finfo(z.dtype).eps * jnp.max(jnp.abs(reward), where=kept, initial=0.0)
        return _without_worst(jnp.abs(residual), jnp.maximum(limit, floor), kept, is_used)

    def refit(carry: tuple) -> tuple:
        kept, _, number, _ = carry
        found = fit(kept)
        following = next_kept(kept, found.residual)
        return following, found, number + 1, jnp.any(following != kept)

    start = (
        kept,
        _Ridge(jnp.zeros(columns.shape[1], z.dtype), jnp.zeros(num, z.dtype), jnp.zeros((), z.dtype)),
    )
    kept, found, _, _ = lax.while_loop(
        lambda carry: carry[3] & (carry[2] <= _MAX_ROUNDS), refit, (*start, 0, jnp.array(True))
    )
    first, second = dim * num_features, dim * num_features + dim
    curvature = jnp.diag(found.coef[first:second])
    if has_products:
        rows, cols = np.triu_indices(dim, 1)
        products = jnp.zeros_like(curvature).at[rows, cols].set(found.coef[second:])
        curvature = curvature + products + products.T
    return Quadratic(
        found.coef[:first].reshape(dim, num_features),
        curvature,
        found.r2,
        jnp.sum(kept, dtype=jnp.int32),
        is_used & ~kept,
    )


def whitener(columns: Float[Array, "n p"], is_used: Bool[Array, " n"]) -> Float[Array, "p p"]:
    """Return W for which `columns @ W` are uncorrelated with a mean square of one, over the samples used.

    Directions without a spread become zero.
    """
    columns = jnp.where(is_used[:, None], columns, 0.0)
    num = jnp.maximum(jnp.sum(is_used, dtype=columns.dtype), 1.0)
    size = safe_sqrt(jnp.sum(columns**2, axis=0) / num)
    unit = jnp.where(size > 0, 1.0 / jnp.where(size > 0, size, 1.0), 0.0)
    columns = columns * unit[None, :]
    squares, axes = jnp.linalg.eigh(exact_dot(columns.T, columns) / num)
    is_spread = squares > 32.0 * columns.shape[1] * jnp.finfo(columns.dtype).eps
    tiny = jnp.finfo(columns.dtype).tiny
    scale = jnp.where(is_spread, 1.0 / jnp.sqrt(jnp.maximum(squares, tiny)), 0.0)
    return unit[:, None] * axes * scale[None, :]


def _design(z: Array, features: Array, has_products: bool) -> tuple[Array, tuple[int, ...]]:
    """Return the columns of the coefficients, and how many of them each structure of A has."""
    num, dim = z.shape
    columns = [(z[:, :, None] * features[:, None, :]).reshape(num, -1), -0.5 * z**2]
    blocks = [columns[0].shape[1], columns[0].shape[1] + dim]
    if has_products and dim > 1:
        rows, cols = np.triu_indices(dim, 1)
        columns.append(-z[:, rows] * z[:, cols])
        blocks.append(blocks[-1] + len(rows))
    return jnp.concatenate(columns, axis=1), tuple(blocks)


def _ridge(columns: Array, blocks: tuple[int, ...], context: Array, reward: Array, kept: Array) -> _Ridge:
    """Regress rewards on the columns, with the penalty and the structure that predict best."""
    num = jnp.maximum(jnp.sum(kept, dtype=reward.dtype), 1.0)
    root = jnp.where(kept, 1.0, 0.0) / jnp.sqrt(num)
    # The part of the context is not penalised: it is removed from rewards and columns.
    context = exact_dot(root[:, None] * context, whitener(context, kept))
    num_context = jnp.sum(jnp.any(context != 0, axis=0), dtype=reward.dtype)

    def removed(values: Array) -> Array:
        return values - exact_dot(context, exact_dot(context.T, values))

    target = removed(removed(root * reward))
    rows = removed(root[:, None] * columns)
    size = safe_sqrt(jnp.sum(rows**2, axis=0))
    unit = jnp.where(size > 0, 1.0 / jnp.where(size > 0, size, 1.0), 0.0)
    rows = rows * unit[None, :]
    products, moments, total = exact_dot(rows.T, rows), exact_dot(rows.T, target), jnp.sum(target**2)
    free = 1.0 - num_context / num
    alone = total / jnp.maximum(free, 1e-3) ** 2
    fits = [_validated(products[:b, :b], moments[:b], total, num, free) for b in blocks]
    scores = jnp.stack([score for score, _ in fits])
    padded = [jnp.pad(coef, (0, columns.shape[1] - len(coef))) for _, coef in fits]
    best = jnp.argmin(scores)
    coef = jnp.stack(padded)[best]
    residual = target - exact_dot(rows, coef)
    r2 = 1.0 - scores[best] / jnp.where(alone > 0, alone, 1.0)
    r2 = jnp.where((alone > 0) & jnp.isfinite(r2), r2, 0.0)
    return _Ridge(coef * unit, residual * jnp.sqrt(num), r2)


def _validated(
    products: Array, moments: Array, total: Scalar, num: Scalar, free: Scalar
) -> tuple[Array, Array]:
    """Return the least error of generalised cross-validation over all penalties, and its coefficients."""
    eps = jnp.finfo(products.dtype).eps
    squares, axes = jnp.linalg.eigh(products)
    squares = jnp.maximum(squares, 0.0)
    moments = exact_dot(axes.T, moments)
    penalties = jnp.logspace(np.log10(16.0 * eps), 1.5, _NUM_PENALTIES, dtype=products.dtype)
    inverse = 1.0 / (squares[None, :] + penalties[:, None])
    freedom = jnp.sum(squares[None, :] * inverse, axis=1) / num
    explained = jnp.sum((moments**2)[None, :] * inverse * (1.0 + penalties[:, None] * inverse), axis=1)
    error = jnp.maximum(total - explained, eps * total)
    left = free - freedom
    scores = jnp.where(left > 1.0 - _MOST_FREEDOM, error / jnp.where(left > 0, left, 1.0) ** 2, jnp.inf)
    best = jnp.argmin(scores)
    return scores[best], exact_dot(axes, inverse[best] * moments)


def _masked_median(values: Array, mask: Array) -> Scalar:
    """Return the (lower) median of the values that the mask selects; zero if it selects none."""
    num = jnp.sum(mask, dtype=jnp.int32)
    ordered = jnp.sort(jnp.where(mask, values, jnp.inf))
    return jnp.where(num > 0, ordered[jnp.maximum(num - 1, 0) // 2], 0.0)


def _without_worst(distance: Array, limit: Array | float, kept: Array, is_used: Array) -> Array:
    """Leave out samples beyond a limit, the farthest first, at most 2 of 5 samples."""
    num = jnp.sum(is_used, dtype=jnp.int32)
    least = num - (2 * num) // 5
    ordered = jnp.sort(jnp.where(kept, distance, jnp.inf))
    limit = jnp.maximum(limit, ordered[jnp.maximum(least - 1, 0)])
    return kept & (distance <= limit)
