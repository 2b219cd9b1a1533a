"""Change a covariance within bounds on its relative entropy and on its loss of entropy."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["as_cov_chol", "bounded_factor", "least_multiplier"]

_LOG_MULTIPLIERS = (-12.0, 40.0)
"""Range of the logarithm of a multiplier: at the lower end it has no effect, at the upper nothing moves."""
_NUM_TRIALS, _NUM_REFINEMENTS = 32, 4


def bounded_factor(
    scatter: Float[Array, "d d"], kl_bound: float, entropy_loss_bound: float | None
) -> Float[Array, "d d"]:
    """Move from the covariance I towards `scatter`, as far as the bounds allow; return a square root."""
    spread, axes = jnp.linalg.eigh(0.5 * (scatter + scatter.T))
    excess = jnp.maximum(spread, 0.0) - 1.0

    def change(kl_multiplier: Array, entropy_multiplier: Array) -> Array:
        """Return x - 1 without cancellation; s - 1 where both multipliers are zero."""
        middle = 1.0 + kl_multiplier - entropy_multiplier
        pull = excess + entropy_multiplier
        root = jnp.sqrt(jnp.maximum(middle**2 + 4.0 * kl_multiplier * pull, 0.0))
        outer = jnp.abs(middle) + root
        return jnp.where(middle > 0, 2.0 * pull / outer, outer / (2.0 * kl_multiplier))

    def change_within_kl(entropy_multiplier: Array) -> Array:
        def kl(kl_multiplier: Array) -> Array:
            y = change(kl_multiplier, entropy_multiplier)
            return 0.5 * jnp.sum(y - jnp.log1p(y))

        return change(least_multiplier(kl, kl_bound, excess.dtype), entropy_multiplier)

    def entropy_loss(entropy_multiplier: Array) -> Array:
        return -0.5 * jnp.sum(jnp.log1p(change_within_kl(entropy_multiplier)))

    entropy_multiplier = jnp.zeros((), excess.dtype)
    if entropy_loss_bound is not None:
        entropy_multiplier = least_multiplier(entropy_loss, entropy_loss_bound, excess.dtype)
    x = 1.0 + change_within_kl(entropy_multiplier)
    return axes * jnp.sqrt(x)[None, :]


def as_cov_chol(root: Float[Array, "d d"], old_chol: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """Return the Cholesky factor of a covariance with this square root, for parameters of size one."""
    upper = jnp.linalg.qr(root.T, mode="r")
    cov_chol = upper.T * jnp.where(jnp.diagonal(upper) < 0, -1.0, 1.0)[None, :]
    # A spread below the rounding error of theta has no effect, and would shrink to zero. A spread that is
    # already below stays: raising it would violate the bounds.
    least = jnp.minimum(4.0 * jnp.finfo(cov_chol.dtype).eps, jnp.linalg.norm(old_chol, axis=1))
    return cov_chol * jnp.maximum(least / jnp.linalg.norm(cov_chol, axis=1), 1.0)[:, None]


def least_multiplier(move: Callable[[Array], Scalar], bound: ScalarLike, dtype: jnp.dtype) -> Array:
    """Return the least multiplier for which `move`, which falls with it, is within the bound."""
    low, high = (jnp.asarray(end, dtype) for end in _LOG_MULTIPLIERS)
    shares = jnp.linspace(0.0, 1.0, _NUM_TRIALS + 1, dtype=dtype)

    # Many trials at once in few rounds: the number of operations costs more than their size.
    def refine(ends: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        low, high = ends
        trials = low + shares * (high - low)
        fits = jax.vmap(move)(jnp.exp(trials)) <= bound
        first = jnp.argmax(fits)
        first = jnp.where(jnp.any(fits), first, _NUM_TRIALS)
        return (trials[jnp.maximum(first - 1, 0)], trials[first]), None

    (_, multiplier), _ = lax.scan(refine, (low, high), length=_NUM_REFINEMENTS)
    return jnp.exp(multiplier)
