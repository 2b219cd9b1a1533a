"""Regress parameters on features, whatever the units and zeros of both: the mean of the policy, Eq. 14.

Features such as `[1, s, s^2, s^3]` differ by powers of a unit, and far from the zero of s they are nearly
collinear. The regression therefore has coordinates of its own: what is nearest to a constant, and the slopes
about it, each in the unit of its feature. Only the result is converted.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax import checks
from creps_jax.numerics.linalg import (
    exact_dot,
    normalised,
    safe_norm,
    safe_sqrt,
    weighted_mean,
    weighted_ridge,
)
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["Basis", "Regression", "as_coefficients", "coordinates", "normaliser", "regress"]

_ROUNDING = 2.0
"""Spread of a feature, in units of its rounding, that may be rounding."""
_SUM_IS_ONE = 1e-4
"""Largest distance of the sum of the features from one, at which they are taken to sum to one."""
_LARGEST_FEATURE = 1e30
"""Features up to this size, and the reciprocals of their sizes, are normal numbers in float32."""


class Basis(NamedTuple):
    """Coordinates of p features x: the constant u nearest to one, and the slopes z about it.

    With everything in the units of the features, `u = level + constant' (x - middle)` and
    `z = x - u middle`. They are 1 + p coordinates of p features: the slopes do not change along `constant`.
    """

    unit: Float[Array, " p"]
    """The scale of each feature."""
    middle: Float[Array, " p"]
    """Mean features; zero where the features cannot express a constant, which leaves them as they are."""
    constant: Float[Array, " p"]
    """Coefficients of u, in units of the features."""
    level: Scalar
    """Mean of u: one, or zero where the features cannot express a constant."""


class Regression(NamedTuple):
    """Hold a regression of the change of theta from the mean of a start, in units of `size`.

    Rows and rest bear the roots of the weights, so that sums of their squares are weighted.
    """

    basis: Basis
    rows: Float[Array, "n q"]
    """Coordinates of the features of each sample."""
    weights: Float[Array, " n"]
    """Weights d; they sum to one."""
    size: Float[Array, " d"]
    """The unit of each parameter."""
    centre: Float[Array, " d"]
    """The multiple of u that has been subtracted in `rest`."""
    rest: Float[Array, "n d"]
    """What is left of theta without the start and the centre."""
    solution: Float[Array, "q d"]
    """The regression of `rest`, in coordinates."""
    root: Float[Array, "q q"]
    """The root, upper triangular, of what holds the solution: of `X' D X` and the ridge."""
    normaliser: Scalar
    """Expected scatter of the residuals, for a variance of one."""


@checks.arguments
def regress(
    features: Float[Array, "n p"],
    theta: Float[Array, "n d"],
    weights: Float[Array, " n"],
    *,
    ridge: ScalarLike,
    scale: Float[Array, " p"] | None = None,
    start: Float[Array, "p d"] | None = None,
) -> Regression:
    """Regress theta on features; for the arguments and errors see `fit_weighted_ml`.

    Source: Abdolmaleki et al. 2016, Eq. 14.
    """
    features, theta, weights = _checked(features, theta, weights, ridge, scale, start)
    weights = normalised(weights)
    basis, size = _basis(features, weights, scale), _size(theta)
    rows = coordinates(basis, features)
    root = safe_sqrt(weights)[:, None]

    # What the constant and the start leave of theta. The constant of the start only moves the centre.
    offset = basis.level * exact_dot(weights, theta)
    wobble = rows[:, :1] - basis.level
    rest = ((theta - offset[None, :]) - wobble * offset[None, :]) / size[None, :]
    centre = offset / size
    if start is not None:
        start = start * _ratio(basis.unit[:, None], size[None, :])
        rest = rest - exact_dot(rows, jnp.pad(start, ((1, 0), (0, 0))))
        centre = centre - exact_dot(basis.middle / basis.unit, start)
    rows, rest = root * rows, root * rest

    # (X' D X + ridge P' P) B = X' D Y, by an orthogonal factorisation Q R of the root of the left side.
    penalty = _penalty(basis, rows, jnp.sqrt(jnp.asarray(ridge, theta.dtype)))
    orthogonal, triangular = jnp.linalg.qr(jnp.concatenate([rows, penalty]))
    orthogonal, of_penalty = orthogonal[: len(rows)], orthogonal[len(rows) :]
    # In print: A = (Phi' D Phi)^-1 Phi' D U
    solution = jax.scipy.linalg.solve_triangular(triangular, exact_dot(orthogonal.T, rest))  # Eq. 14
    # The residuals are (I - Q Q') Y. Their expected scatter is 1 - sum d h with the leverages h = |Q_i|^2,
    # but for what the ridge adds: with it, Q' Q = I - T' T for the rows T of Q that belong to the penalty.
    counted = exact_dot(orthogonal.T, weights[:, None] * orthogonal)
    used = jnp.trace(counted) + jnp.sum(exact_dot(of_penalty, counted) * of_penalty)
    Z = normaliser(used, rows.shape[1])
    return Regression(basis, rows, weights, size, centre, rest, solution, triangular, Z)


def coordinates(basis: Basis, features: Float[Array, "n p"]) -> Float[Array, "n q"]:
    """Return the coordinates of features: the constant, and the slopes about it."""
    centred = (features - basis.middle[None, :]) / basis.unit[None, :]
    wobble = exact_dot(centred, basis.constant)[:, None]
    slopes = centred - wobble * (basis.middle / basis.unit)[None, :]
    return jnp.concatenate([basis.level + wobble, slopes], axis=1)


def as_coefficients(
    basis: Basis, solution: Float[Array, "q d"], size: Float[Array, " d"]
) -> Float[Array, "p d"]:
    """Return the coefficients of features for a solution in coordinates, of parameters in units of `size`."""
    intercept, slopes = solution[0], solution[1:]
    intercept = intercept - exact_dot(basis.middle / basis.unit, slopes)
    coef = slopes + basis.constant[:, None] * intercept[None, :]
    largest = jnp.finfo(coef.dtype).max
    return jnp.clip(coef * _ratio(size[None, :], basis.unit[:, None]), -largest, largest)


def _gauge(basis: Basis) -> Float[Array, "p p"]:
    """Return the projection of slopes on the constant, along which they change nothing."""
    size = safe_norm(basis.constant)
    direction = basis.constant / jnp.where(size > 0, size, 1.0)
    return direction[:, None] * direction[None, :]


def normaliser(used: Scalar, num_coordinates: int) -> Scalar:
    """Return Z of Eq. 15 for fitted features that use up a share of the scatter.

    For residuals of weighted samples with the variance s, `E sum_i d_i r_i^2 = s Z`. A constant alone uses
    `sum d^2`, as in print; p features use more. As many samples as features leave no residuals: their Z is
    not zero, but the resolution of the format.
    """
    # In print: Z = ((sum d)^2 - sum d^2) / sum d
    return jnp.maximum(1.0 - used, 4.0 * num_coordinates * jnp.finfo(used.dtype).eps)  # Eq. 15


def _checked(
    features: Array, theta: Array, weights: Array, ridge: ScalarLike, scale: Array | None, start: Array | None
) -> tuple[Array, Array, Array]:
    """Return the samples after checking all arguments; what has no weight is zero."""
    checks.finite("weights", weights, least=0.0)
    checks.number("ridge", ridge, least=0.0)
    if scale is not None:
        checks.finite("scale", scale, above=0.0)
    if start is not None:
        checks.finite("start", start)
    is_weighted = weights > 0
    features = jnp.where(is_weighted[:, None], features, 0.0)
    theta = jnp.where(is_weighted[:, None], theta, 0.0)
    checks.finite("features", features, largest=_LARGEST_FEATURE)
    checks.finite("theta", theta, largest=checks.LARGEST)
    return features, theta, jnp.where(is_weighted, weights, 0.0)


def _size(columns: Float[Array, "n m"]) -> Float[Array, " m"]:
    """Return the largest entry of each column, one for zeros. As a unit it cancels: it needs no gradient."""
    size = lax.stop_gradient(jnp.max(jnp.abs(columns), axis=0))
    return jnp.where(size > 0, size, 1.0)


def _ratio(top: Array, bottom: Array) -> Array:
    """Divide positive units; what is too large for the format stays finite."""
    return jnp.minimum(top / bottom, jnp.finfo(top.dtype).max)


def _middle(features: Array, weights: Array) -> Array:
    """Return the mean of each feature, which of one that is constant is that constant, without rounding."""
    counts = (weights > 0)[:, None]
    top = jnp.max(jnp.where(counts, features, -jnp.inf), axis=0)
    bottom = jnp.min(jnp.where(counts, features, jnp.inf), axis=0)
    return jnp.where(top == bottom, lax.stop_gradient(top), weighted_mean(features, weights))


def _basis(features: Array, weights: Array, scale: Array | None) -> Basis:
    size = _size(features)
    middle = _middle(features, weights)
    centred = (features - middle[None, :]) / size[None, :]
    spread = safe_sqrt(exact_dot(weights, centred**2))
    rounding = jnp.asarray(_ROUNDING * jnp.finfo(features.dtype).eps, features.dtype)
    if scale is None:
        unit = size * jnp.where(spread > rounding, spread, 1.0)
    else:
        unit = jnp.clip(scale, jnp.maximum(1e-9 * size, 1e-37), jnp.minimum(1e9 * size, 1e37))
    # Of features that sum to one the constant is that sum, wherever the samples are.
    each = jnp.ones_like(unit) if scale is None else scale
    short = jnp.where(weights > 0, 1.0 - jnp.sum(features / each[None, :], axis=1), 0.0)

    def nearest_constant() -> Array:
        # Made of the steadiest features.
        steadiness = lax.stop_gradient(jnp.maximum(spread, rounding))
        ones = jnp.ones((features.shape[0], 1), features.dtype)
        constant = weighted_ridge(features / size[None, :], ones, weights, ridge=0.0, scale=steadiness)
        return constant[:, 0] * unit / size

    is_sum = jnp.all(jnp.abs(short) < _SUM_IS_ONE)
    constant = lax.cond(is_sum, lambda: unit / each, nearest_constant)

    share = exact_dot(middle / unit, constant)
    has_constant = share > 0.5
    constant = constant / jnp.where(has_constant, share, jnp.maximum(safe_norm(constant), 1e-30))
    middle = jnp.where(has_constant, middle, 0.0)
    return Basis(unit, middle, constant, has_constant.astype(features.dtype))


def _penalty(basis: Basis, rows: Float[Array, "n q"], damping: Scalar) -> Float[Array, "q q"]:
    """Return the root of the penalty on coordinates: of the slopes, except along the constant.

    What is added to it is the resolution of the format, and what the slopes have along the constant: it
    changes nothing, and is held at zero.
    """
    num = rows.shape[1]
    along, identity = _gauge(basis), jnp.eye(num - 1, dtype=rows.dtype)
    least = 4.0 * num**0.5 * jnp.finfo(rows.dtype).eps
    size = lax.stop_gradient(jnp.maximum(safe_sqrt(jnp.sum(rows**2, axis=0)), 1.0))
    slopes = jnp.pad(damping * (identity - along) + along, ((1, 0), (1, 0)))
    return slopes + least * jnp.diag(size)
