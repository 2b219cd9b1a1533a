"""Regress parameters on features, in any units and from any zero of both: the mean of the policy, Eq. 14.

Features such as `[1, s, s^2, s^3]` differ by powers of a unit, and far from the zero of s they are nearly
collinear. The regression therefore uses coordinates of its own: a constant, and the distance of each feature
from its mean, in the unit of the feature. Only the result is converted.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax import checks
from creps_jax.numerics.linalg import exact_dot, normalised, safe_norm, safe_sqrt, weighted_mean
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["Basis", "Regression", "as_coefficients", "coordinates", "normaliser", "regress"]

_ROUNDING = 2.0
"""Largest spread of a feature, in units of its rounding, that is taken for rounding."""
_SUM_IS_ONE = 1e-5
"""Largest distance from one of a sum of features that is taken to be one."""
_LARGEST_ERROR = 1e-3
"""Largest distance from one of the sum of features and `constant`."""
_LARGEST_FEATURE = 1e30
"""Features up to this size, and the reciprocals of their sizes, are normal numbers in float32."""


class Basis(NamedTuple):
    """Coordinates of p features x: a constant, and the slopes `z = (x - middle) / unit` about it.

    They are 1 + p coordinates of p features: z does not change along `constant`.
    """

    unit: Float[Array, " p"]
    """The scale of each feature."""
    middle: Float[Array, " p"]
    """Mean features; zero if the features cannot express a constant."""
    constant: Float[Array, " p"]
    """Coefficients of the constant, in units of the features; zero if they cannot express one."""
    level: Scalar
    """The constant: one, or zero if the features cannot express one."""


class Regression(NamedTuple):
    """A regression of the change of theta from the mean of a start, in units of `size`.

    Rows and rest are multiplied by the roots of the weights: sums of their squares are weighted sums.
    """

    basis: Basis
    rows: Float[Array, "n q"]
    """Coordinates of the features of each sample."""
    weights: Float[Array, " n"]
    """Weights d; they sum to one."""
    size: Float[Array, " d"]
    """The unit of each parameter."""
    centre: Float[Array, " d"]
    """The constant that has been subtracted in `rest`."""
    rest: Float[Array, "n d"]
    """Theta less the mean of the start and the centre."""
    solution: Float[Array, "q d"]
    """The regression of `rest`, in coordinates."""
    root: Float[Array, "q q"]
    """The root, upper triangular, of `X' D X` and the ridge."""
    normaliser: Scalar
    """Expected scatter of the residuals, for a variance of one."""


def regress(
    features: Float[Array, "n p"],
    theta: Float[Array, "n d"],
    weights: Float[Array, " n"],
    *,
    ridge: ScalarLike,
    scale: Float[Array, " p"] | None = None,
    start: Float[Array, "p d"] | None = None,
    constant: Float[Array, " p"] | None = None,
) -> Regression:
    """Regress theta on features; for the arguments and errors see `fit_weighted_ml`.

    The fits that call this function check types and shapes; the numbers are checked here.

    Source: Abdolmaleki et al. 2016, Eq. 14.
    """
    features, theta, weights = _checked(features, theta, weights, ridge, scale, start, constant)
    weights = normalised(weights)
    basis, size = _basis(features, weights, scale, constant), _size(theta)
    rows = coordinates(basis, features)

    # What the constant and the start leave of theta. The constant of the start only moves the centre.
    offset = basis.level * exact_dot(weights, theta)
    rest, centre = (theta - offset[None, :]) / size[None, :], offset / size
    if start is not None:
        start = start * _ratio(basis.unit[:, None], size[None, :])
        rest = rest - exact_dot(rows[:, 1:], start)
        centre = centre - exact_dot(basis.middle / basis.unit, start)

    # With the ridge, (Phi' D Phi + P' P) A = Phi' D U. By the factorisation Q R of D^1/2 Phi above P, the
    # matrix on the left is R' R, and A = R^-1 Q' D^1/2 U.
    root = safe_sqrt(weights)[:, None]
    rows, rest = root * rows, root * rest
    penalty = _penalty(basis, rows, jnp.sqrt(jnp.asarray(ridge, theta.dtype)))
    orthogonal, triangular = jnp.linalg.qr(jnp.concatenate([rows, penalty]))
    orthogonal, of_penalty = orthogonal[: len(rows)], orthogonal[len(rows) :]
    # In print: A = (Phi' D Phi)^-1 Phi' D U
    solution = jax.scipy.linalg.solve_triangular(triangular, exact_dot(orthogonal.T, rest))  # Eq. 14
    # The residuals are (I - Q Q') Y. Their expected scatter is 1 - sum d h with the leverages h = |Q_i|^2,
    # plus what the ridge adds: with it, Q' Q = I - T' T for the rows T of Q that belong to the penalty.
    counted = exact_dot(orthogonal.T, weights[:, None] * orthogonal)
    used = jnp.trace(counted) + jnp.sum(exact_dot(of_penalty, counted) * of_penalty)
    Z = normaliser(used, rows.shape[1])
    return Regression(basis, rows, weights, size, centre, rest, solution, triangular, Z)


def coordinates(basis: Basis, features: Float[Array, "n p"]) -> Float[Array, "n q"]:
    """Return the coordinates of features: the constant, and the slopes about it."""
    slopes = (features - basis.middle[None, :]) / basis.unit[None, :]
    return jnp.pad(slopes, ((0, 0), (1, 0)), constant_values=basis.level)


def as_coefficients(
    basis: Basis, solution: Float[Array, "q d"], size: Float[Array, " d"]
) -> Float[Array, "p d"]:
    """Return the coefficients of features for a solution in coordinates, of parameters in units of `size`."""
    intercept, slopes = solution[0], solution[1:]
    intercept = intercept - exact_dot(basis.middle / basis.unit, slopes)
    coef = slopes + basis.constant[:, None] * intercept[None, :]
    largest = jnp.finfo(coef.dtype).max
    return jnp.clip(coef * _ratio(size[None, :], basis.unit[:, None]), -largest, largest)


def normaliser(used: Scalar, num_coordinates: int) -> Scalar:
    """Return Z of Eq. 15 for fitted features that use up a share of the scatter.

    For residuals of weighted samples with the variance s, `E sum_i d_i r_i^2 = s Z`. A constant alone uses
    `sum d^2`, as in print; p features use more. As many samples as features leave no residuals: their Z is
    not zero, but the resolution of the format.
    """
    # In print: Z = ((sum d)^2 - sum d^2) / sum d
    return jnp.maximum(1.0 - used, 4.0 * num_coordinates * jnp.finfo(used.dtype).eps)  # Eq. 15


def _checked(
    features: Array,
    theta: Array,
    weights: Array,
    ridge: ScalarLike,
    scale: Array | None,
    start: Array | None,
    constant: Array | None,
) -> tuple[Array, Array, Array]:
    """Return the samples after checking all arguments; rows without weight are zero."""
    checks.finite("weights", weights, least=0.0)
    checks.number("ridge", ridge, least=0.0)
    if scale is not None:
        checks.finite("scale", scale, above=0.0)
    for name, given in (("start", start), ("constant", constant)):
        if given is not None:
            checks.finite(name, given)
    is_weighted = weights > 0
    if constant is not None:
        short = jnp.where(is_weighted, exact_dot(features, constant) - 1.0, 0.0)
        checks.finite("features @ constant - 1", short, largest=_LARGEST_ERROR)
    features = jnp.where(is_weighted[:, None], features, 0.0)
    theta = jnp.where(is_weighted[:, None], theta, 0.0)
    checks.finite("features", features, largest=_LARGEST_FEATURE)
    checks.finite("theta", theta, largest=checks.LARGEST)
    return features, theta, jnp.where(is_weighted, weights, 0.0)


def _size(columns: Float[Array, "n m"]) -> Float[Array, " m"]:
    """Return the size of the largest entry of each column, one for zeros; a unit cancels: no gradient."""
    size = lax.stop_gradient(jnp.max(jnp.abs(columns), axis=0))
    return jnp.where(size > 0, size, 1.0)


def _ratio(top: Array, bottom: Array) -> Array:
    """Divide positive units; a ratio beyond the format becomes its largest number."""
    return jnp.minimum(top / bottom, jnp.finfo(top.dtype).max)


def _steady(features: Array, weights: Array) -> tuple[Array, Array]:
    """Return the largest value of each feature over the weighted samples, and whether all have this value."""
    counts = (weights > 0)[:, None]
    top = jnp.max(jnp.where(counts, features, -jnp.inf), axis=0)
    bottom = jnp.min(jnp.where(counts, features, jnp.inf), axis=0)
    return lax.stop_gradient(top), top == bottom


def _basis(features: Array, weights: Array, scale: Array | None, constant: Array | None) -> Basis:
    size = _size(features)
    value, is_steady = _steady(features, weights)
    # The mean of a feature that does not vary is its value, without rounding.
    middle = jnp.where(is_steady, value, weighted_mean(features, weights))
    if scale is None:
        spread = safe_sqrt(exact_dot(weights, ((features - middle[None, :]) / size[None, :]) ** 2))
        unit = size * jnp.where(spread > _ROUNDING * jnp.finfo(features.dtype).eps, spread, 1.0)
    else:
        unit = jnp.clip(scale, jnp.maximum(1e-9 * size, 1e-37), jnp.minimum(1e9 * size, 1e37))
    if constant is None:
        total = jnp.sum(features, axis=1)
        is_sum = jnp.all((jnp.abs(total - 1.0) < _SUM_IS_ONE) | (weights == 0))
        is_single = is_steady & (value != 0)
        is_first = is_single & (jnp.cumsum(is_single) == 1)
        single = jnp.where(is_first, unit / jnp.where(is_first, value, 1.0), 0.0)
        constant = jnp.where(is_sum, unit, single)
    else:
        constant = constant * unit
    level = jnp.any(constant != 0).astype(features.dtype)
    return Basis(unit, level * middle, constant, level)


def _penalty(basis: Basis, rows: Float[Array, "n q"], damping: Scalar) -> Float[Array, "q q"]:
    """Return the root of the penalty on coordinates: on the slopes, except along the constant.

    Slopes along the constant change nothing: they are held at zero. A penalty of the resolution of the format
    is added for all.
    """
    num = rows.shape[1]
    identity = jnp.eye(num - 1, dtype=rows.dtype)
    norm = safe_norm(basis.constant)
    direction = basis.constant / jnp.where(norm > 0, norm, 1.0)
    along = direction[:, None] * direction[None, :]
    least = 4.0 * num**0.5 * jnp.finfo(rows.dtype).eps
    size = lax.stop_gradient(jnp.maximum(safe_sqrt(jnp.sum(rows**2, axis=0)), 1.0))
    slopes = jnp.pad(damping * (identity - along) + along, ((1, 0), (1, 0)))
    return slopes + least * jnp.diag(size)
