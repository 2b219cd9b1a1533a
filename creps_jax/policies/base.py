"""The interface of a policy to a search: functions of its parameters and of features of the context."""

from collections.abc import Callable
from typing import Any, NamedTuple

from creps_jax.policies.features import FeatureMap
from creps_jax.typing import Array, Bool, Float, PRNGKey, Scalar

__all__ = ["MStep", "Policy", "WeightedSamples"]

MStep = Callable[..., Any]
"""`(old policy, samples, *, ridge, scale, constant) -> new policy`: the fit of a Gaussian policy.

The samples are `WeightedSamples`, the settings those of `fit_weighted_ml`. A function without an argument
`constant` does not get it."""


class WeightedSamples(NamedTuple):
    """The samples that a policy is fitted to."""

    features: Float[Array, "n p"]
    """Policy features of the context of each sample."""
    theta: Float[Array, "n d"]
    weights: Float[Array, " n"]
    """Weights d, which sum to one; other values of a sample with weight zero are not used."""
    is_valid: Bool[Array, " n"]
    """Which samples are valid: relative entropies are averaged over their contexts."""


class Policy(NamedTuple):
    """A kind of policy, as a record of pure functions; `state` holds the parameters of one policy.

    The state is any pytree of arrays. Functions of contexts take their features x (n, p), one row for each.
    """

    features: FeatureMap
    """The features of the context that the policy depends on."""
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
    """(old state, fitted state, share) -> state whose exploration has moved by this share, from 0 to 1, from
    the old to the fitted one. Without it a search must move all the way: `significance=None`."""
    noise: Callable[[Any, Array, Array], Array] | None = None
    """(state, x, thetas) -> the exploration (n, d): thetas less the mean, in standard deviations; by default
    thetas less the mean."""
    checked: Callable[[str, Any, FeatureMap], Any] | None = None
    """(name, state, features) -> the state in one precision, or a ValueError that names what is wrong."""
    num_features: Callable[[Any], int] | None = None
    """(state) -> number of features that the mean is linear in, from which a search takes the size of its
    archive; by default that of `features`. A network has one for each unit of its last layer."""
