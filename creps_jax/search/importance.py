"""Importance weights of archived samples: the density under the current policy over that when drawn.

A history holds the last K policies, each of which may have drawn archived samples.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp

from creps_jax import checks
from creps_jax.typing import Array, Bool, Float, Int, IntScalar

__all__ = ["Importance", "empty_history", "importance_weights", "remember"]

_LEAST_LOG_POWER, _NUM_HALVINGS = -30.0, 25
"""Lower end of the search for the power that leaves enough effective samples, and number of bisections."""


@dataclasses.dataclass(frozen=True)
class Importance:
    """Settings of the importance weights of archived samples.

    Meant for `bounded_ml`: importance weights reduce the effective number of samples, and with few of them
    the unbounded fit narrows the policy too soon.

    Attributes:
        num_policies: Number K of the last policies that are kept. Samples of older policies are left out. An
            archive of L samples, told N at a time, holds samples of L / N policies.
        least_effective: Least effective number of samples. If the weights leave fewer, all weights are raised
            to the power, from 0 to 1, that leaves this number, or as many as there are.
    """

    num_policies: int = 20
    least_effective: float = 50.0

    def __post_init__(self) -> None:
        """Check the settings."""
        checks.count("num_policies", self.num_policies)
        checks.number("least_effective", self.least_effective, least=1.0)


def empty_history(policy: Any, num_policies: int) -> Any:
    """Make a history: arrays with a first axis of places, all of which hold this policy.

    No sample is attributed to a place before `remember` has written it.
    """
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num_policies, *leaf.shape)), policy)


def remember(history: Any, policy: Any, iteration: IntScalar) -> Any:
    """Replace the oldest policy by the policy of this iteration t, at the place t mod K."""
    place = iteration % jax.tree.leaves(history)[0].shape[0]
    return jax.tree.map(lambda past, new: past.at[place].set(new), history, policy)


def importance_weights(
    log_prob: Callable[[Any, Array, Array], Array],
    policy: Any,
    history: Any,
    features: Float[Array, "n p"],
    theta: Float[Array, "n d"],
    age: Int[Array, " n"],
    is_valid: Bool[Array, " n"],
    iteration: IntScalar,
    *,
    least_effective: float,
) -> Float[Array, " n"]:
    """Weigh samples by the density of a policy over the density of the mixture they were drawn from.

    With the mixture as denominator (the balance heuristic) the ratio is at most the number of all samples
    over the number of samples of this policy: no sample of an old policy outweighs all others.

    Args:
        log_prob: (policy, features, theta) -> log densities (n,), see `Policy`.
        policy: The target of the weights, such as the policy that drew the last samples.
        history: The last K policies, including the policy of `iteration`.
        features: Policy features of the contexts.
        theta: Parameters.
        age: Number of iterations between the draw of a sample and `iteration`.
        is_valid: Which samples count; the values of the others must be finite, too.
        iteration: The number of the last iteration.
        least_effective: See `Importance`.

    Returns:
        Weights that sum to one, zero where a sample does not count or its policy is no longer kept; all
        zero if no sample counts.

    Source: Veach and Guibas 1995, the balance heuristic.
    """
    num_policies = jax.tree.leaves(history)[0].shape[0]
    is_counted = is_valid & (age < num_policies)
    place = (iteration - age) % num_policies
    drawn = jax.nn.one_hot(place, num_policies, dtype=theta.dtype) * is_counted[:, None].astype(theta.dtype)
    share = jnp.sum(drawn, axis=0) / jnp.maximum(jnp.sum(drawn), 1.0)
    past = jax.vmap(log_prob, (0, None, None))(history, features, theta)
    log_mixture = logsumexp(past, axis=0, b=share[:, None])
    log_ratio = log_prob(policy, features, theta) - log_mixture
    log_ratio = jnp.where(is_counted & jnp.isfinite(log_ratio), log_ratio, -jnp.inf)
    largest = jnp.max(log_ratio)
    log_ratio = log_ratio - jnp.where(jnp.isfinite(largest), largest, 0.0)
    return _flattened(log_ratio, least_effective)


def _flattened(log_weight: Array, least_effective: float) -> Array:
    """Return the weights raised to the largest power, at most 1, that leaves enough effective samples."""
    is_counted = jnp.isfinite(log_weight)

    def to_the(power: Array) -> Array:
        weights = jnp.where(is_counted, jnp.exp(power * jnp.where(is_counted, log_weight, 0.0)), 0.0)
        return weights / jnp.maximum(jnp.sum(weights), 1.0)  # the largest weight is one, if any sample counts

    def is_enough(power: Array) -> Array:
        return least_effective * jnp.sum(to_the(power) ** 2) <= 1.0

    def halve(ends: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        low, high = ends
        middle = 0.5 * (low + high)
        enough = is_enough(jnp.exp(middle))
        return (jnp.where(enough, middle, low), jnp.where(enough, high, middle)), None

    ends = jnp.full((), _LEAST_LOG_POWER, log_weight.dtype), jnp.zeros((), log_weight.dtype)
    (log_power, _), _ = lax.scan(halve, ends, length=_NUM_HALVINGS)
    return to_the(jnp.where(is_enough(jnp.exp(ends[1])), 1.0, jnp.exp(log_power)))
