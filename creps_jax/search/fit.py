"""Fit the next policy to weighted samples: as the paper does, or with bounds on how far it moves.

The bound of contextual REPS holds for the weights of the samples. The Gaussian that is fitted to them
moves farther: with 50 samples of 20 parameters by some 10 nats where 1 was allowed, mostly because too
few samples say too much about the covariance. The bounded fit keeps the promise.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax import checks
from creps_jax.numerics.linalg import divided, exact_dot, safe_sqrt
from creps_jax.policies.base import WeightedSamples
from creps_jax.policies.gaussian import LinearGaussian, fit_weighted_ml
from creps_jax.policies.regression import Regression, as_coefficients, coordinates, normaliser, regress
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["MStep", "bounded_ml", "fit_within", "weighted_ml"]

_LOG_MULTIPLIERS = (-12.0, 40.0)
"""Range of the logarithms of the multipliers: below, a bound changes nothing; above, nothing moves."""
_NUM_TRIALS, _NUM_REFINEMENTS = 32, 4


MStep = Callable[..., LinearGaussian]
"""`(old policy, samples, *, ridge, scale) -> new policy`; see `fit_weighted_ml` for the settings."""


@checks.arguments
def weighted_ml(
    policy: LinearGaussian,
    samples: WeightedSamples,
    *,
    ridge: ScalarLike,
    scale: Float[Array, " p"] | None = None,
) -> LinearGaussian:
    """Fit by weighted maximum likelihood, wherever that leads: `fit_weighted_ml` from the old policy on."""
    features, theta, weights, _, constant = samples
    return fit_weighted_ml(
        features, theta, weights, ridge=ridge, scale=scale, start=policy.coef, constant=constant
    )


@checks.arguments
def bounded_ml(
    *, mean_kl_bound: float = 1.0, cov_kl_bound: float = 0.05, entropy_loss_bound: float | None = None
) -> MStep:
    """Make the fit by weighted maximum likelihood with bounds on how far mean and covariance move.

    The relative entropy of the new policy to the old one, averaged over the contexts, is a sum of a part of
    the mean and a part of the covariance:
    `E_s KL = E_s |shift of the mean|^2 / 2 + (tr X - log det X - d) / 2`, both in units of the old
    covariance, of which X is the change. Each part has its own bound. One bound on the sum would be
    used up by the covariance, which few samples know least about, and end the search early; so does the
    joint optimum, measured on the contextual sphere.

    The mean that is likeliest within its bound, at the old covariance, is a share `g / (g + l c)` of the
    whole way, with a multiplier l, in features that are uncorrelated both over the contexts, with a mean
    square c, and over the weighted samples, with a mean square g that counts the ridge. The whole way is that
    of `weighted_ml`. The covariance that is likeliest within its bounds is, along the eigenvectors of the
    weighted covariance s (made unbiased, as in `fit_weighted_ml`), the root x of
    `l x^2 - (l + m - 1) x - s = 0`, where m is the multiplier of the bound on the loss of entropy. A spread
    does not fall below the rounding of theta; one that is already below it does not fall further.

    Args:
        mean_kl_bound: Largest part of the mean in the relative entropy, nats.
        cov_kl_bound: Largest part of the covariance, nats.
        entropy_loss_bound: Largest loss of differential entropy, nats; by default only `cov_kl_bound`
            limits it.

    Returns:
        The M-step. Where a bound is active, the policy meets it; the sum of the first two bounds the
        relative entropy.

    Raises:
        ValueError: If a bound is not a positive number.

    Source: The parts are bounded apart as in Abdolmaleki et al. 2018, Maximum a posteriori policy
    optimisation, Section 4.2.1; here in the other direction of the relative entropy, and exact.
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
            "mean_kl_bound and cov_kl_bound must be numbers both, or None both, "
            f"got {mean_kl_bound} and {cov_kl_bound}"
        )
    return bounded_ml(mean_kl_bound=mean_kl_bound, cov_kl_bound=cov_kl_bound)


@dataclasses.dataclass(frozen=True)
class BoundedML:
    """The M-step of `bounded_ml`: its bounds as data, which can be compared and pickled."""

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
    ) -> LinearGaussian:
        """Fit within the bounds; see `fit_weighted_ml` for the settings."""
        checks.instance("policy", policy, LinearGaussian)
        checks.instance("samples", samples, WeightedSamples)
        features, theta, weights, _, constant = samples
        fit = regress(
            features, theta, weights, ridge=ridge, scale=scale, start=policy.coef, constant=constant
        )
        old_chol = policy.cov_chol / fit.size[:, None]
        change, unbiased = _bounded_change(fit, old_chol, samples, self.mean_kl_bound)
        residual = fit.rest - exact_dot(fit.rows, change.at[0].add(-fit.centre))
        residual = divided(residual, old_chol.T)
        scatter = exact_dot(residual.T, residual) / unbiased  # Eq. 15
        factor = _bounded_factor(scatter, self.cov_kl_bound, self.entropy_loss_bound)
        cov_chol = fit.size[:, None] * _as_cov_chol(exact_dot(old_chol, factor), old_chol)
        cov_chol = jnp.where(jnp.any(fit.weights > 0), cov_chol, policy.cov_chol)
        return LinearGaussian(policy.coef + as_coefficients(fit.basis, change, fit.size), cov_chol)


def _bounded_change(
    fit: Regression, old_chol: Float[Array, "d d"], samples: WeightedSamples, kl_bound: float
) -> tuple[Float[Array, "q d"], Scalar]:
    """Go from the old mean towards the likeliest one, as far as the bound allows.

    Returns:
        The change in the coordinates of the regression, and the normaliser of its residuals.
    """
    contexts = _context_rows(fit, samples)
    # Both what holds the likeliest mean and what the bound is on can be tiny in a direction, as that of a
    # radial basis function beyond all contexts; with the ridge in the first, their sum is not.
    basis = jnp.linalg.qr(jnp.concatenate([fit.root, contexts]), mode="r")
    held, contexts, rows = (divided(columns, basis) for columns in (fit.root, contexts, fit.rows))
    _, axes = jnp.linalg.eigh(exact_dot(contexts.T, contexts))
    hold, use = (jnp.sum(exact_dot(columns, axes) ** 2, axis=0) for columns in (held, contexts))
    # The whole way: in units of the old covariance, for features along the axes.
    change = fit.solution.at[0].add(fit.centre)
    change = jax.scipy.linalg.solve_triangular(old_chol, change.T, lower=True).T
    way = exact_dot(axes.T, exact_dot(basis, change))
    squares = 0.5 * use * jnp.sum(way**2, axis=1)

    def share(multiplier: Array) -> Array:
        return hold / (hold + multiplier * use)

    def kl(multiplier: Array) -> Array:
        return jnp.sum(share(multiplier) ** 2 * squares)

    multiplier = _least_multiplier(kl, kl_bound, way.dtype)
    moved = exact_dot(axes, share(multiplier)[:, None] * way)
    moved = exact_dot(jax.scipy.linalg.solve_triangular(basis, moved), old_chol.T)
    # The mean is linear in theta, and so are the residuals: what they have lost of the scatter of theta.
    rows = exact_dot(rows, axes) / safe_sqrt(hold + multiplier * use)[None, :]
    counted = exact_dot(rows.T, fit.weights[:, None] * rows)
    used = 2.0 * jnp.trace(counted) - jnp.sum(counted * exact_dot(rows.T, rows))
    return moved, normaliser(used, rows.shape[1])


def _context_rows(fit: Regression, samples: WeightedSamples) -> Float[Array, "n q"]:
    """Return coordinates whose sums of squares are means over the contexts that count."""
    counts = samples.is_valid & jnp.all(jnp.isfinite(samples.features), axis=1)
    rows = coordinates(fit.basis, jnp.where(counts[:, None], samples.features, 0.0))
    num = jnp.maximum(jnp.sum(counts, dtype=rows.dtype), 1.0)
    return jnp.where(counts[:, None], rows, 0.0) / jnp.sqrt(num)


def _bounded_factor(
    scatter: Float[Array, "d d"], kl_bound: float, entropy_loss_bound: float | None
) -> Float[Array, "d d"]:
    """Go from a covariance I towards a weighted one, as far as the bounds allow; return a root of it."""
    spread, axes = jnp.linalg.eigh(0.5 * (scatter + scatter.T))
    excess = jnp.maximum(spread, 0.0) - 1.0

    def change(kl_multiplier: Array, entropy_multiplier: Array) -> Array:
        """Return x - 1, without its cancellation; where both multipliers are zero it is s - 1."""
        middle = 1.0 + kl_multiplier - entropy_multiplier
        pull = excess + entropy_multiplier
        root = jnp.sqrt(jnp.maximum(middle**2 + 4.0 * kl_multiplier * pull, 0.0))
        outer = jnp.abs(middle) + root
        return jnp.where(middle > 0, 2.0 * pull / outer, outer / (2.0 * kl_multiplier))

    def change_within_kl(entropy_multiplier: Array) -> Array:
        def kl(kl_multiplier: Array) -> Array:
            y = change(kl_multiplier, entropy_multiplier)
            return 0.5 * jnp.sum(y - jnp.log1p(y))

        return change(_least_multiplier(kl, kl_bound, excess.dtype), entropy_multiplier)

    def entropy_loss(entropy_multiplier: Array) -> Array:
        return -0.5 * jnp.sum(jnp.log1p(change_within_kl(entropy_multiplier)))

    entropy_multiplier = jnp.zeros((), excess.dtype)
    if entropy_loss_bound is not None:
        entropy_multiplier = _least_multiplier(entropy_loss, entropy_loss_bound, excess.dtype)
    x = 1.0 + change_within_kl(entropy_multiplier)
    return axes * jnp.sqrt(x)[None, :]


def _as_cov_chol(root: Float[Array, "d d"], old_chol: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Return the Cholesky factor of a covariance whose root is given, for parameters of size one."""
    upper = jnp.linalg.qr(root.T, mode="r")
    cov_chol = upper.T * jnp.where(jnp.diagonal(upper) < 0, -1.0, 1.0)[None, :]
    # Below the rounding of theta a spread means nothing, and would shrink to zero. One that is already
    # there may stay: to raise it would break the bounds.
    least = jnp.minimum(4.0 * jnp.finfo(cov_chol.dtype).eps, jnp.linalg.norm(old_chol, axis=1))
    return cov_chol * jnp.maximum(least / jnp.linalg.norm(cov_chol, axis=1), 1.0)[:, None]


def _least_multiplier(move: Callable[[Array], Scalar], bound: float, dtype: jnp.dtype) -> Array:
    """Return the least multiplier at which what is bounded, and falls with it, is within its bound."""
    low, high = (jnp.asarray(end, dtype) for end in _LOG_MULTIPLIERS)
    shares = jnp.linspace(0.0, 1.0, _NUM_TRIALS + 1, dtype=dtype)

    # Many values at once and few rounds of them: small operations cost more than large ones.
    def refine(ends: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        low, high = ends
        trials = low + shares * (high - low)
        fits = jax.vmap(move)(jnp.exp(trials)) <= bound
        first = jnp.argmax(fits)
        first = jnp.where(jnp.any(fits), first, _NUM_TRIALS)
        return (trials[jnp.maximum(first - 1, 0)], trials[first]), None

    (_, multiplier), _ = lax.scan(refine, (low, high), length=_NUM_REFINEMENTS)
    return jnp.exp(multiplier)
