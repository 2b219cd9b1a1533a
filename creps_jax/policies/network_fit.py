"""Train a network on weighted samples within bounds on the change of the policy, for `network_policy`.

The change of the mean is trained in units of the old covariance, so that no unit of a parameter matters.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax

from creps_jax.numerics.linalg import divided, exact_dot, normalised
from creps_jax.policies.base import WeightedSamples
from creps_jax.policies.bounded_covariance import as_cov_chol, bounded_factor
from creps_jax.policies.network_mean import Layers, units
from creps_jax.policies.regression import regress
from creps_jax.typing import Array, Bool, Float, Scalar

__all__ = ["NetworkFit"]

_NUM_TRIALS, _NUM_REFINEMENTS = 32, 3
"""Number of steps that are tried at once, and how often, to find the largest one within the bound."""
_PENALTY = 10.0
"""Penalty in the loss on each nat by which the change of the mean exceeds its bound."""
_RIDGE = 1e-4
"""Ridge of the regression that counts how much of the scatter the mean has used."""


class _Weights(NamedTuple):
    """The weights of a network whose outputs are in units of the old covariance; or a change of them."""

    layers: Layers
    coef: Float[Array, "k d"]


@dataclasses.dataclass(frozen=True)
class NetworkFit:
    """Fit a network to weighted samples within the bounds of `network_policy`."""

    steps: int
    learning_rate: float | int
    mean_kl_bound: float | int
    cov_kl_bound: float | int
    entropy_loss_bound: float | int | None

    def __call__(self, old: Any, samples: WeightedSamples) -> Any:
        """Return the next policy; without any weight, the old one."""
        features, theta, weights, is_valid = samples
        is_weighted, is_valid = weights > 0, is_valid & jnp.all(jnp.isfinite(features), axis=1)
        features = jnp.where((is_weighted | is_valid)[:, None], features, 0.0)
        theta = jnp.where(is_weighted[:, None], theta, 0.0)
        weights = normalised(jnp.where(is_weighted, weights, 0.0))
        start = _Weights(old.layers, divided(old.coef, old.cov_chol.T))
        first = _outputs(start, features)
        target = divided(theta, old.cov_chol.T) - first

        def shift_by(change: _Weights) -> Array:
            return _outputs(jax.tree.map(jnp.add, start, change), features) - first

        def mean_kl(change: _Weights) -> Scalar:
            return _mean_square(shift_by(change), is_valid)

        def loss(change: _Weights) -> Scalar:
            shift = shift_by(change)
            excess = jnp.maximum(_mean_square(shift, is_valid) - self.mean_kl_bound, 0.0)
            squares = jnp.sum((target - shift) ** 2, axis=1)
            return 0.5 * exact_dot(weights, squares) + _PENALTY * excess

        change = self._trained(loss, start)
        share = _largest_share(lambda share: mean_kl(_scaled(change, share)), self.mean_kl_bound, theta.dtype)
        change = _scaled(change, share)
        new = jax.tree.map(jnp.add, start, change)
        residual = target - shift_by(change)
        used = share * (2.0 - share) * (1.0 - _normaliser(new, features, theta, weights))
        scatter = exact_dot(residual.T, weights[:, None] * residual) / (1.0 - used)  # Eq. 15
        factor = bounded_factor(scatter, self.cov_kl_bound, self.entropy_loss_bound)
        size = jnp.max(jnp.abs(theta), axis=0)
        size = jnp.where(size > 0, size, 1.0)[:, None]
        cov_chol = size * as_cov_chol(exact_dot(old.cov_chol / size, factor), old.cov_chol / size)
        coef = exact_dot(new.coef, old.cov_chol.T)
        fitted = old._replace(layers=new.layers, coef=coef, cov_chol=cov_chol)
        has_weight = jnp.any(is_weighted)
        return jax.tree.map(lambda new, old: jnp.where(has_weight, new, old), fitted, old)

    def _trained(self, loss: Callable[[_Weights], Scalar], start: _Weights) -> _Weights:
        """Return the change of the weights that training makes."""
        # As the search converges, the outputs grow in units of the covariance: hidden weights then have to
        # change less for a shift of one unit.
        spread = jnp.sum(start.coef[1:] ** 2) / start.coef.shape[1]
        rate = lax.rsqrt(1.0 + spread)

        def scaled(change: _Weights) -> _Weights:
            return _Weights(_scaled(change.layers, rate), change.coef)

        optimiser = optax.adam(optax.cosine_decay_schedule(self.learning_rate, self.steps))

        def step(carry: tuple[_Weights, Any], _: None) -> tuple[tuple[_Weights, Any], None]:
            change, state = carry
            gradient = jax.grad(lambda change: loss(scaled(change)))(change)
            # Optax needs the usual promotion of types, which users may have switched off.
            with jax.numpy_dtype_promotion("standard"):
                updates, state = optimiser.update(gradient, state)
                return (optax.apply_updates(change, updates), state), None

        change = jax.tree.map(jnp.zeros_like, start)
        (change, _), _ = lax.scan(step, (change, optimiser.init(change)), length=self.steps)
        return scaled(change)


def _outputs(weights: _Weights, features: Array) -> Array:
    return exact_dot(units(weights.layers, features), weights.coef)


def _normaliser(new: _Weights, features: Array, theta: Array, weights: Array) -> Scalar:
    """Return Z of Eq. 15 for a mean that is linear in the units of the last layer.

    Training the layers below uses more of the scatter, and early stopping less.
    """
    last = units(new.layers, features)
    constant = jnp.zeros_like(last[0]).at[0].set(1.0)
    return regress(last, theta, weights, ridge=_RIDGE, constant=constant).normaliser


def _scaled(change: Any, share: Array) -> Any:
    return jax.tree.map(lambda leaf: share * leaf, change)


def _mean_square(shift: Float[Array, "n d"], is_valid: Bool[Array, " n"]) -> Scalar:
    """Return the relative entropy of shifts in units of the covariance, averaged over the contexts."""
    num = jnp.maximum(jnp.sum(is_valid, dtype=shift.dtype), 1.0)
    return 0.5 * jnp.sum(jnp.where(is_valid[:, None], shift, 0.0) ** 2) / num


def _largest_share(kl: Callable[[Scalar], Scalar], bound: float | int, dtype: Any) -> Scalar:
    """Return the largest share of a change whose relative entropy is within the bound."""
    shares = jnp.linspace(0.0, 1.0, _NUM_TRIALS + 1, dtype=dtype)

    def refine(ends: tuple[Scalar, Scalar], _: None) -> tuple[tuple[Scalar, Scalar], None]:
        low, high = ends
        trials = low + shares * (high - low)
        last = jnp.max(jnp.where(jax.vmap(kl)(trials) <= bound, jnp.arange(_NUM_TRIALS + 1), 0))
        return (trials[last], trials[jnp.minimum(last + 1, _NUM_TRIALS)]), None

    ends = (jnp.zeros((), dtype), jnp.ones((), dtype))
    (share, _), _ = lax.scan(refine, ends, length=_NUM_REFINEMENTS)
    return share
