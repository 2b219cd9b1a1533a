"""Solve the small linear systems of the library: tridiagonal, Cholesky, whitening."""

import math
from typing import TypeAlias

import jax.numpy as jnp
from jax import lax

from creps_jax import checks
from creps_jax.typing import Array, Float, Int, ScalarLike

__all__ = [
    "as_bits",
    "centre_columns",
    "divided",
    "exact_dot",
    "normalised",
    "safe_cholesky",
    "safe_norm",
    "safe_sqrt",
    "thomas_solve",
    "times_power",
    "weighted_mean",
    "whitened_regression",
]

_Pair: TypeAlias = tuple[Array, Array]


def exact_dot(left: Float[Array, "..."], right: Float[Array, "..."]) -> Float[Array, "..."]:
    """Multiply vectors or matrices as `jnp.dot` does, in the full precision of their format.

    By default accelerators multiply float32 matrices with a mantissa of 10 bits.
    """
    return jnp.dot(left, right, precision=lax.Precision.HIGHEST)


@checks.arguments
def thomas_solve(
    lower: Float[Array, " n"],
    diag: Float[Array, " n"],
    upper: Float[Array, " n"],
    rhs: Float[Array, " n"],
) -> Float[Array, " n"]:
    """Solve a tridiagonal system by the Thomas algorithm.

    Row k is `lower[k] x[k-1] + diag[k] x[k] + upper[k] x[k+1] = rhs[k]`. Elimination does not pivot: the
    system must be diagonally dominant (as for the centre of mass) or positive definite. For several
    right-hand sides use `jax.vmap` over `rhs`.

    Args:
        lower: Entries below the diagonal; `lower[0]` is not used.
        diag: Entries on the diagonal.
        upper: Entries above the diagonal; `upper[-1]` is not used.
        rhs: Right-hand side.

    Returns:
        The solution x.

    Raises:
        ValueError: If the four are not vectors of one length n >= 1, a number is not finite, or a pivot is
            zero.

    Source: Abdolmaleki et al. 2016, Eq. 7 and 8 (with `a(k)` in the denominator, where the print is wrong).
    """
    # Entries that are not used may be anything: zero times a number that is not finite is not zero.
    lower = lower.at[0].set(0.0)
    upper = upper.at[-1].set(0.0)
    for name, entries in (("lower", lower), ("diag", diag), ("upper", upper), ("rhs", rhs)):
        checks.finite(name, entries)

    def eliminate(above: _Pair, row: tuple[Array, Array, Array, Array]) -> tuple[_Pair, _Pair]:
        upper_above, rhs_above = above
        low, pivot, up, value = row
        denominator = pivot - low * upper_above
        scaled_upper = up / denominator  # Eq. 7
        scaled_rhs = (value - low * rhs_above) / denominator  # Eq. 8
        return (scaled_upper, scaled_rhs), (scaled_upper, scaled_rhs)

    def substitute(x_below: Array, row: _Pair) -> _Pair:
        scaled_upper, scaled_rhs = row
        x = scaled_rhs - scaled_upper * x_below  # Eq. 9
        return x, x

    zero = jnp.zeros_like(rhs[0])
    _, reduced = lax.scan(eliminate, (zero, zero), (lower, diag, upper, rhs))
    _, solution = lax.scan(substitute, zero, reduced, reverse=True)
    return checks.finite("the solution, for which lower, diag and upper have to leave all pivots,", solution)


def normalised(weights: Float[Array, " n"]) -> Float[Array, " n"]:
    """Divide weights, not negative and of any size, by their sum; very small ones and zeros become zero.

    Plain code fails for extreme weights: compiled programs round denormal numbers to zero, and divide by
    multiplying with a reciprocal, which is denormal for large divisors; sums of large numbers overflow.
    """
    info, bits = jnp.finfo(weights.dtype), as_bits(weights)
    # The bits of a denormal number, as an integer, are the number in units of the smallest one.
    is_denormal = (bits > 0) & (bits < 1 << info.nmant)
    in_units = jnp.where(is_denormal, bits.astype(weights.dtype), 0.0)
    of_units = info.minexp - info.nmant
    largest = jnp.where(
        jnp.any(bits >= 1 << info.nmant),
        jnp.frexp(jnp.max(weights))[1],
        jnp.frexp(jnp.max(in_units))[1] + of_units,
    )
    # Powers of two make the largest weight about one. They cancel, and need no gradient.
    others = times_power(weights, -largest)
    weights = jnp.where(is_denormal, times_power(in_units, of_units - largest), others)
    weights = jnp.where(weights >= info.tiny, weights, 0.0)
    return weights / jnp.maximum(jnp.sum(weights), 0.5)


def as_bits(values: Float[Array, "..."]) -> Int[Array, "..."]:
    """Return numbers as integers of the same bits: an integer is above zero exactly if the number is."""
    values = lax.stop_gradient(values)
    return lax.bitcast_convert_type(values, jnp.dtype(f"int{jnp.finfo(values.dtype).bits}"))


def times_power(values: Float[Array, "..."], exponent: Int[Array, "..."] | int) -> Float[Array, "..."]:
    """Multiply values by two to a power, faster than `ldexp` for one power and many values."""
    half, one = exponent // 2, jnp.ones((), values.dtype)  # the power itself can be beyond the format
    return values * jnp.ldexp(one, half) * jnp.ldexp(one, exponent - half)


def weighted_mean(rows: Float[Array, "n m"], weights: Float[Array, " n"]) -> Float[Array, " m"]:
    """Return the mean of finite rows, for weights that sum to one, or zero if all weights are zero."""
    middle = exact_dot(weights, rows)
    # In the first sum each row adds a rounding error of the size of the offset of the rows.
    return middle + exact_dot(weights, rows - middle[None, :])


def safe_sqrt(values: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return the square root of positive values; for others zero, with a gradient of zero."""
    is_positive = values > 0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, values, 1.0)), 0.0)


def safe_norm(vector: Float[Array, " n"]) -> Float[Array, ""]:
    """Return the length of a vector, with a gradient of zero for the zero vector."""
    return safe_sqrt(jnp.sum(vector**2))


def divided(rows: Float[Array, "n q"], upper: Float[Array, "q q"]) -> Float[Array, "n q"]:
    """Return rows times the inverse of an upper triangular matrix."""
    return lax.linalg.triangular_solve(upper, rows, left_side=False, lower=False)


def safe_cholesky(matrix: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Factor a symmetric matrix after adding the least multiple of the identity that makes it definite.

    Args:
        matrix: Symmetric matrix, about positive definite; only its symmetric part is used. The entries of its
            diagonal should be of one size (as in a correlation matrix), because the multiple is relative to
            the largest entry. Entries that are not finite are replaced by zero.

    Returns:
        Lower triangular L, finite and with a positive diagonal, `L L' = matrix + jitter I`. The jitter is
        zero if the smallest eigenvalue is above the rounding error of the largest. A matrix of zeros gets the
        jitter of the identity.

    Raises:
        ValueError: If the matrix is not square.
    """
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1]:
        raise ValueError(f"matrix must be square, got shape {matrix.shape}")
    matrix = jnp.where(jnp.isfinite(matrix), matrix, 0.0)
    scale = jnp.max(jnp.abs(matrix))
    scale = jnp.where(scale > 0, scale, 1.0)
    unit = matrix / scale
    unit = 0.5 * (unit + unit.T)
    size = matrix.shape[0]
    # Eigenvalues have an error of about d eps; the factor exists if the smallest one is above it.
    least = 4.0 * size * jnp.finfo(matrix.dtype).eps
    # Equal eigenvalues have no gradient, and the jitter is of the size of rounding.
    jitter = lax.stop_gradient(jnp.maximum(least - jnp.linalg.eigvalsh(unit)[0], 0.0))
    return jnp.linalg.cholesky(unit + jitter * jnp.eye(size, dtype=matrix.dtype)) * jnp.sqrt(scale)


def centre_columns(rows: Float[Array, "n m"], weights: Float[Array, " n"]) -> Float[Array, "n m"]:
    """Subtract the weighted mean of the rows.

    Args:
        rows: Rows, all of them finite.
        weights: Weights of the rows, not negative, that sum to one.

    Returns:
        The centred rows. Rows of weight zero, and columns that are constant up to rounding, are zero.
    """
    counts = (weights > 0)[:, None]
    centred = jnp.where(counts, rows, 0.0)
    rounding = 4.0 * jnp.finfo(rows.dtype).eps * jnp.max(jnp.abs(centred), axis=0)
    for _ in range(2):  # the first mean has a rounding error of the size of the offset
        centred = jnp.where(counts, centred - exact_dot(weights, centred)[None, :], 0.0)
    is_constant = jnp.max(jnp.abs(centred), axis=0) <= rounding
    return jnp.where(is_constant[None, :], 0.0, centred)


def whitened_regression(
    centred: Float[Array, "n m"],
    target: Float[Array, " n"],
    weights: Float[Array, " n"],
    *,
    least_spread: ScalarLike,
) -> tuple[Float[Array, "m k"], Float[Array, " m"]]:
    """Return the matrix W for which the columns of `centred @ W` are uncorrelated with mean square one.

    Args:
        centred: Rows with a mean of zero, from `centre_columns`.
        target: The target of a least-squares fit, with a mean of zero as well.
        weights: Weights of the rows in these means, not negative; they sum to one.
        least_spread: Directions with less spread than this, in columns scaled to spread one, are treated as
            rounding: their columns of W are zero.

    Returns:
        W, with k = min(n, m) columns, and the coefficients of the least-squares fit of the target. For any
        `least_spread`, the fit leaves out only directions that the format cannot distinguish from rounding.
    """
    root = jnp.sqrt(weights)
    rows = root[:, None] * centred
    unscale = _invert_above(jnp.linalg.norm(rows, axis=0), 0.0)
    both = jnp.concatenate([rows * unscale[None, :], (root * target)[:, None]], axis=1)
    # Singular values of the columns: eigenvalues of their products would square the rounding.
    triangular = jnp.linalg.qr(both, mode="r")[: centred.shape[1]]
    columns, values = triangular[:, :-1], triangular[:, -1]
    left, singular_values, axes = jnp.linalg.svd(columns, full_matrices=False)
    inverse = axes.T * _invert_above(singular_values, least_spread)[None, :]
    # First the directions above rounding: in the others the target itself would have huge coefficients.
    coef = exact_dot(inverse, exact_dot(values, left))
    least = 4.0 * math.sqrt(centred.shape[1]) * jnp.finfo(centred.dtype).eps
    rest = exact_dot(values - exact_dot(columns, coef), left)
    coef = coef + exact_dot(singular_values / (singular_values**2 + least**2) * rest, axes)
    return unscale[:, None] * inverse, unscale * coef


def _invert_above(values: Array, threshold: ScalarLike) -> Array:
    """Return the reciprocal of each value above a threshold, zero of the others."""
    is_above = values > threshold
    return jnp.where(is_above, 1.0 / jnp.where(is_above, values, 1.0), 0.0)
