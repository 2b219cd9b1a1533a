"""Solvers agree with dense float64 references, and stay finite where those would fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.numerics.linalg import (
    centre_columns,
    normalised,
    safe_cholesky,
    safe_norm,
    safe_sqrt,
    thomas_solve,
    weighted_mean,
    whitened_regression,
)


def tridiagonal(rng, size):
    lower, upper = rng.normal(size=(2, size))
    diag = 0.1 + np.abs(lower) + np.abs(upper)
    return np.float32(lower), np.float32(diag), np.float32(upper), np.float32(rng.normal(size=size))


def as_dense(lower, diag, upper):
    return np.diag(lower[1:].astype(float), -1) + np.diag(diag.astype(float)) + np.diag(upper[:-1], 1)


# Tridiagonal systems.


@pytest.mark.parametrize("size", [1, 2, 3, 100])
def test_thomas_agrees_with_dense_and_lax(size):
    lower, diag, upper, rhs = tridiagonal(np.random.default_rng(size), size)
    found = thomas_solve(*map(jnp.asarray, (lower, diag, upper, rhs)))
    expected = np.linalg.solve(as_dense(lower, diag, upper), rhs)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
    if size > 2:
        by_lax = jax.lax.linalg.tridiagonal_solve(
            jnp.asarray(lower).at[0].set(0.0),
            jnp.asarray(diag),
            jnp.asarray(upper).at[-1].set(0.0),
            jnp.asarray(rhs)[:, None],
        )
        np.testing.assert_allclose(found, by_lax[:, 0], rtol=1e-4, atol=1e-5)


def test_thomas_does_not_use_the_corners():
    lower, diag, upper, rhs = map(jnp.asarray, tridiagonal(np.random.default_rng(0), 5))
    expected = thomas_solve(lower, diag, upper, rhs)
    found = thomas_solve(lower.at[0].set(jnp.nan), diag, upper.at[-1].set(jnp.inf), rhs)
    np.testing.assert_array_equal(found, expected)


def test_thomas_takes_several_right_hand_sides_by_vmap():
    lower, diag, upper, _ = map(jnp.asarray, tridiagonal(np.random.default_rng(1), 20))
    rhs = jax.random.normal(jax.random.key(0), (3, 20))
    found = jax.jit(jax.vmap(thomas_solve, (None, None, None, 0)))(lower, diag, upper, rhs)
    dense = as_dense(*map(np.asarray, (lower, diag, upper)))
    np.testing.assert_allclose(found @ np.float32(dense).T, rhs, atol=1e-4)


def test_thomas_has_gradients():
    lower, diag, upper, rhs = map(jnp.asarray, tridiagonal(np.random.default_rng(2), 6))
    gradient = jax.grad(lambda rhs: thomas_solve(lower, diag, upper, rhs)[2])(rhs)
    inverse = np.linalg.inv(as_dense(*map(np.asarray, (lower, diag, upper))))
    np.testing.assert_allclose(gradient, inverse[2], rtol=1e-4, atol=1e-5)


def test_thomas_names_bad_shapes():
    with pytest.raises(ValueError, match=r"rhs must have shape \(4,\) beside lower \(4,\) .*, got \(3,\)"):
        thomas_solve(jnp.ones(4), jnp.ones(4), jnp.ones(4), jnp.ones(3))


# Weights, means and roots.


@pytest.mark.parametrize("function", [normalised, jax.jit(normalised)], ids=["eager", "compiled"])
@pytest.mark.parametrize("largest", [1.2e-37, 1e-30, 1.0, 1e30, 1e38, 3.4e38])
def test_weights_of_any_size_are_normalised(function, largest):
    weights = np.array([0.0, 1.0, 0.3, 0.5])
    found = function(jnp.float32(largest * weights))
    np.testing.assert_allclose(found, weights / weights.sum(), rtol=1e-6)


def test_weights_of_zero_stay_zero():
    np.testing.assert_array_equal(normalised(jnp.zeros(3)), np.zeros(3))
    gradient = jax.jacobian(normalised)(jnp.zeros(3))
    assert np.all(np.isfinite(gradient))


def test_a_weighted_mean_is_one_rounding_off():
    rng = np.random.default_rng(13)
    rows = np.float32(1e6 + rng.normal(size=(20_000, 2)))
    weights = normalised(jnp.float32(rng.exponential(size=20_000)))
    expected = np.average(np.float64(rows), axis=0, weights=np.float64(weights))
    assert np.all(np.abs(weighted_mean(jnp.asarray(rows), weights) - expected) <= np.spacing(np.float32(1e6)))


def test_roots_and_norms_have_a_gradient_at_zero():
    np.testing.assert_array_equal(safe_sqrt(jnp.array([4.0, 0.0, -1.0])), [2.0, 0.0, 0.0])
    np.testing.assert_array_equal(jax.grad(lambda x: safe_sqrt(x).sum())(jnp.array([4.0, 0.0])), [0.25, 0.0])
    np.testing.assert_array_equal(jax.grad(safe_norm)(jnp.zeros(3)), np.zeros(3))
    assert safe_norm(jnp.array([3.0, 4.0])) == pytest.approx(5.0)


# Cholesky.


def test_safe_cholesky_leaves_definite_matrices_alone():
    rng = np.random.default_rng(7)
    root = rng.normal(size=(6, 6))
    matrix = jnp.float32(root @ root.T + 0.1 * np.eye(6))
    found = safe_cholesky(matrix)
    np.testing.assert_allclose(found @ found.T, matrix, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(found, jnp.tril(found))


@pytest.mark.parametrize("scale", [1e-30, 1e-8, 1.0, 1e20])
@pytest.mark.parametrize("rank", [0, 1, 5, 18])
def test_safe_cholesky_adds_little_to_singular_matrices(rank, scale):
    rng = np.random.default_rng(8)
    rows = rng.normal(size=(18, rank))
    matrix = np.float32(scale * rows @ rows.T)
    found = np.float64(jax.jit(safe_cholesky)(jnp.asarray(matrix)))
    assert np.all(np.isfinite(found))
    assert np.all(np.diag(found) > 0)
    size = np.abs(matrix).max() if rank else 1.0
    assert np.abs(found @ found.T - matrix).max() < 3e-5 * size


def test_safe_cholesky_bears_anything():
    rng = np.random.default_rng(9)
    indefinite = rng.normal(size=(200, 5, 5))
    broken = np.where(rng.uniform(size=(200, 5, 5)) < 0.1, np.nan, indefinite)
    broken[0] = np.inf
    found = jax.jit(jax.vmap(safe_cholesky))(jnp.float32(np.concatenate([indefinite, broken])))
    assert np.all(np.isfinite(found))
    assert np.all(jnp.diagonal(found, axis1=1, axis2=2) > 0)


def test_safe_cholesky_adds_the_least_that_makes_an_indefinite_matrix_definite():
    matrix = jnp.array([[1.0, 2.0], [2.0, 1.0]])  # eigenvalues 3 and -1
    found = safe_cholesky(matrix)
    np.testing.assert_allclose(found @ found.T, matrix + jnp.eye(2), atol=1e-4)


# Whitening.


def test_whitening_makes_columns_uncorrelated():
    rng = np.random.default_rng(10)
    rows = rng.normal(size=(60, 3)) @ rng.normal(size=(3, 3)) * [1e-5, 1.0, 1e5] + [0.0, 30.0, 1e6]
    weights = jnp.where(jnp.arange(60) < 40, 1 / 40, 0.0)
    centred = centre_columns(jnp.float32(rows), weights)
    assert np.all(centred[40:] == 0)
    white = centred @ whitened_regression(centred, centred[:, 0], weights, least_spread=1e-4)[0]
    np.testing.assert_allclose(white.T @ white / 40, np.eye(3), atol=1e-3)
    np.testing.assert_allclose(white.sum(0) / 40, 0.0, atol=1e-4)


def test_whitening_drops_what_is_constant_or_collinear():
    rng = np.random.default_rng(11)
    column = rng.normal(size=30)
    rows = jnp.float32(np.column_stack([column, 2 * column, np.full(30, 7.1), np.zeros(30), 1e5 + column]))
    weights = jnp.full(30, 1 / 30)
    centred = centre_columns(rows, weights)
    assert np.all(centred[:, 2:4] == 0)
    matrix, _ = whitened_regression(centred, jnp.float32(column), weights, least_spread=0.1)
    white = centred @ matrix
    assert np.all(np.isfinite(matrix))
    assert np.sum(np.sum(np.asarray(white) ** 2, axis=0) > 1) == 1


def test_whitening_of_fewer_rows_than_columns():
    rows = jnp.float32(np.random.default_rng(12).normal(size=(4, 6)))
    weights = jnp.full(4, 0.25)
    centred = centre_columns(rows, weights)
    white = centred @ whitened_regression(centred, centred[:, 0], weights, least_spread=1e-4)[0]
    assert white.shape == (4, 4)
    # Four points about their mean span three directions.
    np.testing.assert_allclose(np.sort(np.linalg.eigvalsh(white.T @ white / 4)), [0, 1, 1, 1], atol=1e-4)


@pytest.mark.parametrize(("num", "gap"), [(60, 1.0), (60, 1e-3), (60, 1e-5), (4, 1.0)])
def test_the_regression_beside_whitening_sees_directions_that_whitening_leaves_out(num, gap):
    rng = np.random.default_rng(13)
    column, other = rng.normal(size=(2, num))
    weights = jnp.full(num, 1 / num)
    centred = centre_columns(jnp.float32(np.stack([column, column + gap * other], axis=1)), weights)
    target = centred[:, 1] - centred[:, 0]
    matrix, coef = whitened_regression(centred, target, weights, least_spread=0.1)
    assert np.sum(np.any(np.asarray(matrix) != 0, axis=0)) == (2 if gap == 1.0 else 1)
    np.testing.assert_allclose(centred @ coef, target, atol=1e-6 + 0.02 * np.abs(target).max())
