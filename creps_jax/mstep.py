"""Fit the next policy to weighted samples: as the paper does, or within bounds on how far it may move.

The bound of contextual REPS holds for the weights of the samples. The Gaussian that is fitted to them
moves farther: with 50 samples of 20 parameters by some 10 nats where 1 was allowed, mostly because too
few samples say too much about the covariance. The bounded fit keeps the promise.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax import checks
from creps_jax.linalg import exact_dot, unbiased_normaliser
from creps_jax.policy import LinearGaussian, fit_weighted_ml
from creps_jax.typing import Array, Bool, Float, Scalar, ScalarLike

__all__ = ["MStep", "WeightedSamples", "bounded_ml", "weighted_ml"]

_LEAST_EXCITATION = 3e-5
"""Size, for features of mean square one, below which a direction counts as that large in the bound."""
_LOG_MULTIPLIERS = (-12.0, 40.0)
"""Range of the logarithms of the multipliers: below, a bound changes nothing; above, nothing moves."""
_NUM_TRIALS, _NUM_REFINEMENTS = 32, 4


class WeightedSamples(NamedTuple):
    """What a policy is fitted to."""

    features: Float[Array, "n p"]
    """Policy features of the context of each sample."""
    theta: Float[Array, "n d"]
    weights: Float[Array, " n"]
    """Weights d, which sum to one; a sample of weight zero may hold anything."""
    is_valid: Bool[Array, " n"]
    """Which samples count: over their contexts relative entropies are averaged."""


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
    features, theta, weights, _ = samples
    return fit_weighted_ml(features, theta, weights, ridge=ridge, scale=scale, start=policy.coef)


@checks.arguments
def bounded_ml(
    *, mean_kl_bound: float = 1.0, cov_kl_bound: float = 0.05, entropy_loss_bound: float | None = None
) -> MStep:
    """Make the fit by weighted maximum likelihood within bounds on how far mean and covariance may move.

    The relative entropy of the new policy to the old one, averaged over the contexts, is a sum of a part of
    the mean and a part of the covariance:
    `E_s KL = E_s |shift of the mean|^2 / 2 + (tr X - log det X - d) / 2`, both in units of the old
    covariance, of which X is the change. Each part has its own bound. One bound on the sum would be
    used up by the covariance, which few samples know least about, and end the search early; so does the
    joint optimum, measured on the contextual sphere.

    The mean that is likeliest within its bound, at the old covariance, is, in features that are uncorrelated
    over the contexts and along the eigenvectors of their weighted mean square g, a share `g / (g + l)` of
    the whole way, with a multiplier l. The whole way is that of `weighted_ml`, with its ridge. The covariance
    that is likeliest within its bounds is, along the eigenvectors of the weighted covariance s (made unbiased
    as in Eq. 15), the root x of `l x^2 - (l + m - 1) x - s = 0`, where m is the multiplier of the bound on
    the loss of entropy. No spread falls below the rounding of theta.

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

    def m_step(
        policy: LinearGaussian,
        samples: WeightedSamples,
        *,
        ridge: ScalarLike,
        scale: Float[Array, " p"] | None = None,
    ) -> LinearGaussian:
        likeliest = weighted_ml(policy, samples, ridge=ridge, scale=scale)
        coef = _bounded_mean(policy, likeliest.coef, samples, mean_kl_bound)
        return LinearGaussian(
            coef, _bounded_cov_chol(policy, coef, samples, cov_kl_bound, entropy_loss_bound)
        )

    return m_step


def _bounded_mean(
    policy: LinearGaussian, likeliest: Array, samples: WeightedSamples, kl_bound: float
) -> Float[Array, "p d"]:
    """Go from the old coefficients towards the likeliest ones, as far as the bound allows."""
    rows, basis = _uncorrelated(samples)
    gram = exact_dot(rows.T, samples.weights[:, None] * rows)
    mean_square, axes = jnp.linalg.eigh(gram)
    mean_square = jnp.maximum(mean_square, 0.0)
    # The whole way: in units of the old covariance, for features along the axes.
    change = (likeliest - policy.coef).T
    change = jax.scipy.linalg.solve_triangular(policy.cov_chol, change, lower=True).T
    way = exact_dot(axes.T, exact_dot(basis, change))
    squares = 0.5 * jnp.sum(way**2, axis=1)

    def share(multiplier: Array) -> Array:
        return mean_square / (mean_square + multiplier)

    def kl(multiplier: Array) -> Array:
        return jnp.sum(share(multiplier) ** 2 * squares)

    moved = exact_dot(axes, share(_least_multiplier(kl, kl_bound, policy.coef.dtype))[:, None] * way)
    moved = jax.scipy.linalg.solve_triangular(basis, moved)
    return policy.coef + exact_dot(moved, policy.cov_chol.T)


def _uncorrelated(samples: WeightedSamples) -> tuple[Array, Array]:
    """Return features (n, p) whose mean square over the contexts that count is I, and their basis (p, p).

    The features are these rows times the basis, which is upper triangular.
    """
    counts = samples.is_valid & jnp.all(jnp.isfinite(samples.features), axis=1)
    features = jnp.where(counts[:, None], samples.features, 0.0)
    features = features / jnp.sqrt(jnp.maximum(jnp.sum(counts, dtype=features.dtype), 1.0))
    size = jnp.linalg.norm(features, axis=0)
    size = jnp.asarray(jnp.where(size > 0, size, 1.0))
    floor = _LEAST_EXCITATION * jnp.eye(features.shape[1], dtype=features.dtype)
    basis = jnp.linalg.qr(jnp.concatenate([features / size[None, :], floor]), mode="r") * size[None, :]
    rows = jnp.where(counts[:, None], samples.features, 0.0)
    return jax.scipy.linalg.solve_triangular(basis.T, rows.T, lower=True).T, basis


def _bounded_cov_chol(
    policy: LinearGaussian,
    coef: Array,
    samples: WeightedSamples,
    kl_bound: float,
    entropy_loss_bound: float | None,
) -> Float[Array, "d d"]:
    """Go from the old covariance towards the weighted one about the new mean, as far as the bounds allow."""
    features, theta, weights, _ = samples
    counts = (weights > 0)[:, None]
    features, theta = (jnp.where(counts, x, 0.0) for x in (features, theta))
    residual = theta - exact_dot(features, coef)
    residual = jax.scipy.linalg.solve_triangular(policy.cov_chol, residual.T, lower=True).T
    scatter = exact_dot(residual.T, weights[:, None] * residual) / unbiased_normaliser(weights)  # Eq. (15)
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
    root = exact_dot(policy.cov_chol, axes * jnp.sqrt(x)[None, :])
    upper = jnp.linalg.qr(root.T, mode="r")
    cov_chol = upper.T * jnp.where(jnp.diagonal(upper) < 0, -1.0, 1.0)[None, :]
    # Below the rounding of theta a spread means nothing, and would shrink to zero.
    least = 4.0 * jnp.finfo(theta.dtype).eps * jnp.max(jnp.abs(theta), axis=0)
    cov_chol = cov_chol * jnp.maximum(least / jnp.linalg.norm(cov_chol, axis=1), 1.0)[:, None]
    return jnp.where(jnp.any(counts), cov_chol, policy.cov_chol)


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
