"""What a policy is to a search: a few functions of its parameters and of features of the context."""

from collections.abc import Callable
from typing import Any, NamedTuple

from creps_jax.policies.features import FeatureMap
from creps_jax.typing import Array, Bool, Float, PRNGKey, Scalar

__all__ = ["Policy", "WeightedSamples"]


class WeightedSamples(NamedTuple):
    """What a policy is fitted to."""

    features: Float[Array, "n p"]
    """Policy features of the context of each sample."""
    theta: Float[Array, "n d"]
    weights: Float[Array, " n"]
    """Weights d, which sum to one; a sample of weight zero may hold anything."""
    is_valid: Bool[Array, " n"]
    """Which samples count: over their contexts relative entropies are averaged."""
    constant: Float[Array, " p"] | None = None
    """Coefficients whose sum with the features is one, see `FeatureMap.constant`; None if not stated."""


class Policy(NamedTuple):
    """A kind of policy, as a record of pure functions; `state` is what one policy of this kind consists of.

    The state is any pytree of arrays. Functions of contexts take their features x (n, p), a row each.
    """

    features: FeatureMap
    """What the policy is told of a context."""
    mean: Callable[[Any, Array], Array]
    """(state, x) -> thetas (n, d) without exploration."""
    sample: Callable[[PRNGKey, Any, Array], Array]
    """(key, state, x) -> thetas (n, d)."""
    log_prob: Callable[[Any, Array, Array], Array]
    """(state, x, thetas) -> log densities (n,), in nats."""
    kl: Callable[[Any, Any, Array], Array]
    """(state, reference, x) -> relative entropies KL(state || reference) (n,), in nats."""
    entropy: Callable[[Any], Scalar]
    """(state) -> differential entropy, in nats."""
    fit: Callable[[Any, WeightedSamples], Any]
    """(old state, samples) -> state: the next policy."""
    blend: Callable[[Any, Any, Scalar], Any] | None = None
    """(old state, fitted state, share) -> state whose exploration has moved by this share, from 0 to 1, of
    its way. Without it a search has to move all the way, whatever the evidence (`significance=None`)."""
    noise: Callable[[Any, Array, Array], Array] | None = None
    """(state, x, thetas) -> what exploration has added to the mean (n, d), in units of its standard
    deviations; by default the difference of thetas and mean."""
    checked: Callable[[str, Any, FeatureMap], Any] | None = None
    """(name, state, features) -> the state in one precision, or a ValueError that names what is wrong."""
