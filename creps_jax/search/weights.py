"""Weights of samples: which samples count, the weights that an advantage gives, and their relative entropy.

The prior of a sample is its weight before its reward is seen: 1 or 0, or its importance weight.
"""

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax.numerics.linalg import as_bits, normalised
from creps_jax.typing import Array, Scalar

__all__ = [
    "effective_samples",
    "is_counted",
    "log_prior",
    "mask",
    "relative_entropy",
    "shift",
    "softmax_weights",
]


def softmax_weights(advantage: Array, prior: Array) -> Array:
    """Return `prior * exp(advantage)`, scaled to a sum of one; zero where the prior is zero."""
    return jax.nn.softmax(jnp.where(prior > 0, advantage + log_prior(prior), -jnp.inf))


def log_prior(prior: Array) -> Array:
    """Return the logarithm of the prior, zero where the prior is zero.

    The logarithm is added to the advantage, instead of the prior multiplying its exponential: a small prior
    with a large advantage would make all other terms underflow.
    """
    return jnp.log(jnp.where(prior > 0, prior, 1.0))


def relative_entropy(weights: Array, prior: Array) -> Scalar:
    """Return sum d log(d / p) in nats for weights d that sum to one, where p is the prior scaled likewise."""
    prior = normalised(prior).astype(weights.dtype)
    # The terms d log(d / p) - d + p are at least 0, up to rounding; terms d log(d / p) would cancel.
    change = weights / jnp.where(prior > 0, prior, 1.0) - 1.0
    log_ratio = jnp.log1p(jnp.where(change > -1.0, change, 0.0))
    return jnp.maximum(jnp.sum(weights * log_ratio - prior * change, where=prior > 0), 0.0)


def effective_samples(weights: Array) -> Scalar:
    """Return the number of equally weighted samples that carry as much information, 1 / sum of squares."""
    squares = jnp.sum(weights**2)
    return jnp.sum(weights) ** 2 / jnp.where(squares > 0, squares, 1.0)


def is_counted(reward: Array, features: Array, prior: Array) -> Array:
    """Return which samples count: reward, features and prior are finite, and the prior is above zero."""
    is_known = jnp.isfinite(reward) & jnp.all(jnp.isfinite(features), axis=1)
    return (as_bits(prior) > 0) & jnp.isfinite(prior) & is_known


def mask(reward: Array, features: Array, prior: Array) -> tuple[Array, Array, Array]:
    """Replace the values of samples that do not count by zeros, and scale the prior to a sum of one.

    If no sample counts, all count equally, as zeros. Masking precedes all arithmetic, so that neither values
    nor gradients depend on samples that do not count.
    """
    counts = is_counted(reward, features, prior)
    prior = jnp.where(counts, prior, 0.0)
    reward = jnp.where(counts, reward, 0.0)
    features = jnp.where(counts[:, None], features, 0.0)
    # Scaled in its own format first, then converted.
    prior = normalised(jnp.where(jnp.any(counts), prior, 1.0))
    return reward, features, prior.astype(reward.dtype)


def shift(values: Array, prior: Array) -> Array:
    """Subtract the largest value of a sample that counts, which changes no weight; other values become 0."""
    largest = lax.stop_gradient(jnp.max(jnp.where(prior > 0, values, -jnp.inf)))
    return jnp.where(prior > 0, values - largest, 0.0)
