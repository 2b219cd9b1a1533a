"""Fit the next policy to weighted samples: Eq. 14 and 15 of the paper, or with bounds on its change.

The bound of contextual REPS limits the weights of the samples. The Gaussian that is fitted to them moves
farther, for 50 samples of 20 parameters about 10 nats with a bound of 1, mostly because few samples determine
the covariance badly. `bounded_ml` bounds the change of the Gaussian itself.

Both fits get the mean by `policies.regression.regress` (Eq. 14). The covariance (Eq. 15) is computed in
`policies.gaussian` for `weighted_ml`, and in `BoundedML` for `bounded_ml`.
"""

import dataclasses

import jax
import jax.numpy as jnp

from creps_jax import checks
from creps_jax.numerics.linalg import divided, exact_dot, safe_sqrt
from creps_jax.policies.base import MStep, WeightedSamples
from creps_jax.policies.bounded_covariance import as_cov_chol, bounded_factor, least_multiplier
from creps_jax.policies.gaussian import LinearGaussian, fit_weighted_ml
from creps_jax.policies.regression import Regression, as_coefficients, coordinates, normaliser, regress
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["bounded_ml", "fit_within", "weighted_ml"]

_checked_regress = checks.arguments(regress)


def weighted_ml(
    policy: LinearGaussian,
    samples: WeightedSamples,
    *,
    ridge: ScalarLike,
    scale: Float[Array, " p"] | None = None,
    constant: Float[Array, " p"] | None = None,
) -> LinearGaussian:
    """Fit by weighted maximum likelihood without bounds: `fit_weighted_ml`, starting from the old policy.

    Source: Abdolmaleki et al. 2016, Eq. 14 and 15.
    """
    checks.instance("policy", policy, LinearGaussian)
    checks.instance("samples", samples, WeightedSamples)
    features, theta, weights, _ = samples
    return fit_weighted_ml(
        features, theta, weights, ridge=ridge, scale=scale, start=policy.coef, constant=constant
    )


@checks.arguments
def bounded_ml(
    *, mean_kl_bound: float = 1.0, cov_kl_bound: float = 0.05, entropy_loss_bound: float | None = None
) -> MStep:
    """Make the fit by weighted maximum likelihood with bounds on the change of mean and covariance.

    The relative entropy of the new policy to the old one, averaged over the contexts, is the sum of a mean
    part and a covariance part: `E_s KL = E_s |shift of the mean|^2 / 2 + (tr X - log det X - d) / 2`, where
    the shift and the new covariance X are in units of the old covariance. Each part has its own bound.
    The covariance part, which few samples determine badly, would use up one bound on the sum and end the
    search early; the joint optimum did the same in measurements on the contextual sphere.

    The maximum-likelihood mean within its bound, at the old covariance, moves the share `g / (g + l c)` of
    the way to the mean of `weighted_ml`. Here l is the multiplier of the bound, and features are uncorrelated
    both over the contexts, with mean square c, and over the weighted samples, with mean square g, which
    includes the ridge. The maximum-likelihood covariance within its bounds has the eigenvectors of the
    weighted covariance (unbiased, as in `fit_weighted_ml`). To its eigenvalue s belongs the root x of
    `l x^2 - (l + m - 1) x - s = 0`, where m is the multiplier of the bound on the loss of entropy. A spread
    does not fall below the rounding error of theta; a spread that is already below it does not fall further.

    Args:
        mean_kl_bound: Largest mean part of the relative entropy, in nats.
        cov_kl_bound: Largest covariance part, in nats.
        entropy_loss_bound: Largest loss of differential entropy, in nats; by default only `cov_kl_bound`
            limits it.

    Returns:
        The M-step. An active bound is met with equality; the sum of the first two bounds limits the relative
        entropy.

    Raises:
        ValueError: If a bound is not a positive number.

    Source: Separate bounds as in Abdolmaleki et al. 2018, Maximum a posteriori policy optimisation,
    Section 4.2.1; here for the other direction of the relative entropy, and exact.
    """
    bounds = {"mean_kl_bound": mean_kl_bound, "cov_kl_bound": cov_kl_bound}
    if entropy_loss_bound is not None:
        bounds["entropy_loss_bound"] = entropy_loss_bound
    for name, bound in bounds.items():
        checks.number(name, bound, above=0.0)

    return BoundedML(mean_kl_bound, cov_kl_bound, entropy_loss_bound)


def fit_within(mean_kl_bound: float | None, cov_kl_bound: float | None) -> MStep:
    """Choose the fit by its bounds: `weighted_ml` if both are None, else `bounded_ml`.

    Raises:
        ValueError: If only one of the two is None.
    """
    if mean_kl_bound is None and cov_kl_bound is None:
        return weighted_ml
    if mean_kl_bound is None or cov_kl_bound is None:
        raise ValueError(
            "mean_kl_bound and cov_kl_bound must both be numbers or both be None, "
            f"got {mean_kl_bound} and {cov_kl_bound}"
        )
    return bounded_ml(mean_kl_bound=mean_kl_bound, cov_kl_bound=cov_kl_bound)


@dataclasses.dataclass(frozen=True)
class BoundedML:
    """The M-step of `bounded_ml` as a record of its bounds, which can be compared and pickled."""

    mean_kl_bound: float
    cov_kl_bound: float
    entropy_loss_bound: float | None

    def __call__(
        self,
        policy: LinearGaussian,
        samples: WeightedSamples,
        *,
        ridge: ScalarLike,
        scale: Float[Array, " p"] | None = None,
        constant: Float[Array, " p"] | None = None,
    ) -> LinearGaussian:
        """Fit within the bounds; see `fit_weighted_ml` for the settings."""
        checks.instance("policy", policy, LinearGaussian)
        checks.instance("samples", samples, WeightedSamples)
        features, theta, weights, _ = samples
        fit = _checked_regress(
            features, theta, weights, ridge=ridge, scale=scale, start=policy.coef, constant=constant
        )
        old_chol = policy.cov_chol / fit.size[:, None]
        change, unbiased = _bounded_change(fit, old_chol, samples, self.mean_kl_bound)
        residual = fit.rest - exact_dot(fit.rows, change.at[0].add(-fit.centre))
        residual = divided(residual, old_chol.T)
        scatter = exact_dot(residual.T, residual) / unbiased  # Eq. 15
        factor = bounded_factor(scatter, self.cov_kl_bound, self.entropy_loss_bound)
        cov_chol = fit.size[:, None] * as_cov_chol(exact_dot(old_chol, factor), old_chol)
        cov_chol = jnp.where(jnp.any(fit.weights > 0), cov_chol, policy.cov_chol)
        return LinearGaussian(policy.coef + as_coefficients(fit.basis, change, fit.size), cov_chol)


def _bounded_change(
    fit: Regression, old_chol: Float[Array, "d d"], samples: WeightedSamples, kl_bound: float
) -> tuple[Float[Array, "q d"], Scalar]:
    """Move from the old mean towards the maximum-likelihood mean, as far as the bound allows.

    Returns:
        The change in the coordinates of the regression, and the normaliser of its residuals.
    """
    contexts = _context_rows(fit, samples)
    # Both matrices can be tiny in a direction, such as a radial basis function far from all contexts; their
    # sum is not, as the first includes the ridge.
    basis = jnp.linalg.qr(jnp.concatenate([fit.root, contexts]), mode="r")
    held, contexts, rows = (divided(columns, basis) for columns in (fit.root, contexts, fit.rows))
    _, axes = jnp.linalg.eigh(exact_dot(contexts.T, contexts))
    hold, use = (jnp.sum(exact_dot(columns, axes) ** 2, axis=0) for columns in (held, contexts))
    # The whole way to the maximum-likelihood mean, in units of the old covariance, along the axes.
    change = fit.solution.at[0].add(fit.centre)
    change = jax.scipy.linalg.solve_triangular(old_chol, change.T, lower=True).T
    way = exact_dot(axes.T, exact_dot(basis, change))
    squares = 0.5 * use * jnp.sum(way**2, axis=1)

    def share(multiplier: Array) -> Array:
        return hold / (hold + multiplier * use)

    def kl(multiplier: Array) -> Array:
        return jnp.sum(share(multiplier) ** 2 * squares)

    multiplier = least_multiplier(kl, kl_bound, way.dtype)
    moved = exact_dot(axes, share(multiplier)[:, None] * way)
    moved = exact_dot(jax.scipy.linalg.solve_triangular(basis, moved), old_chol.T)
    # Mean and residuals are linear in theta: the part of the scatter of theta that the mean has used.
    rows = exact_dot(rows, axes) / safe_sqrt(hold + multiplier * use)[None, :]
    counted = exact_dot(rows.T, fit.weights[:, None] * rows)
    used = 2.0 * jnp.trace(counted) - jnp.sum(counted * exact_dot(rows.T, rows))
    return moved, normaliser(used, rows.shape[1])


def _context_rows(fit: Regression, samples: WeightedSamples) -> Float[Array, "n q"]:
    """Return coordinates whose sums of squares are mean squares over the contexts that count."""
    counts = samples.is_valid & jnp.all(jnp.isfinite(samples.features), axis=1)
    rows = coordinates(fit.basis, jnp.where(counts[:, None], samples.features, 0.0))
    num = jnp.maximum(jnp.sum(counts, dtype=rows.dtype), 1.0)
    return jnp.where(counts[:, None], rows, 0.0) / jnp.sqrt(num)
