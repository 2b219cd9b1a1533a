"""The compiled programs of contextual REPS: the update of the policy, its samples and its mean.

The update: archive -> prior -> weights of the dual -> fit -> evidence -> new policy and diagnostics.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from creps_jax import checks
from creps_jax.policies.base import Policy, WeightedSamples
from creps_jax.policies.features import FeatureMap
from creps_jax.search.archive import Archive, centred_reward
from creps_jax.search.dual import DualSolution, solve_and_weigh
from creps_jax.search.evidence import independence_p_value, share_of_evidence
from creps_jax.search.importance import importance_weights, remember
from creps_jax.search.settings import CrepsSettings
from creps_jax.search.weights import effective_samples, relative_entropy
from creps_jax.typing import Array, Bool, Float, IntScalar, PRNGKey, Scalar, ScalarLike

__all__ = [
    "CrepsInfo",
    "CrepsState",
    "are_finite",
    "features_of",
    "is_usable",
    "mean_over",
    "mean_thetas",
    "sample_thetas",
    "update",
]


class CrepsState(NamedTuple):
    """All that the next step needs: a saved state resumes a run exactly."""

    policy: Any
    """A `LinearGaussian`, unless `creps` was given another kind of policy."""
    archive: Archive
    iteration: IntScalar
    """Number of batches told so far."""
    history: Any = None
    """The last policies, for importance weights; None where all samples count equally."""


class CrepsInfo(NamedTuple):
    """Diagnostics of an update; the search itself does not use them."""

    dual: DualSolution
    kl: Scalar
    """Relative entropy between the weights and the prior weights, which do not depend on the rewards, in
    nats; at most the KL bound."""
    policy_kl: Scalar
    """KL(new policy || old policy) in nats, the mean over the archived contexts. The KL bound limits `kl`,
    not this: with few samples the fitted Gaussian moves farther, with many old ones less."""
    effective_samples: Scalar
    """1 / sum of squared weights: the number of equally weighted samples that carry as much information."""
    prior_effective_samples: Scalar
    """The same for the prior weights: the number of valid samples, or fewer with importance weights."""
    entropy: Scalar
    """Differential entropy of the new policy, in nats."""
    num_valid: IntScalar
    """Number of archived samples that the update used; samples that are not finite are left out, and samples
    of policies that the history no longer holds."""
    is_updated: Bool[Array, ""]
    """False where the policy was kept unchanged: there were too few samples to fit one, or the rewards do
    not differ after the baseline."""
    p_value: Scalar
    """p-value of the test in `search.evidence`, from 0 to 1: the probability of a dependence between weights
    and parameters at least this strong if there is none. The covariance moves only if it is below
    `significance`."""
    unsupported_loss: Scalar
    """Estimate of the entropy that this update lost by chance, in nats: the loss of entropy times
    `3 p_value / significance` (twice the p-value without `significance`). Where rewards do not depend on the
    parameters its expectation is the whole loss; where the evidence is strong it is nearly zero. A large sum
    over a search means that exploration was lost without evidence: if chance reduces the spread of d
    parameters to exp(-x), the sum is about d x."""
    reward_rounding: Scalar
    """Rounding error of the rewards, in the precision in which they were told, as a share of their spread.
    From about 0.1 on little can be learned: tell rewards in float64, or without their common offset."""


class _Samples(NamedTuple):
    """The archive in the form that an update needs; values of samples that do not count are zero."""

    features: Array
    baseline: Array
    theta: Array
    reward: Array
    reward_resolution: Array
    prior: Array
    is_valid: Array


def update(settings: CrepsSettings, kl_bound: ScalarLike, state: CrepsState) -> tuple[CrepsState, CrepsInfo]:
    """Fit a new policy to the archive.

    Source: Abdolmaleki et al. 2016, Algorithm 1.
    """
    samples, history = _samples(settings, state)
    features, baseline, theta, reward, resolution, prior, is_valid = samples
    dual, weights = solve_and_weigh(reward, baseline, prior, kl_bound, resolution=resolution)
    kind, old = settings.kind, state.policy
    fitted = kind.fit(old, WeightedSamples(features, theta, weights, is_valid))

    noise = theta - kind.mean(old, features) if kind.noise is None else kind.noise(old, features, theta)
    p_value = independence_p_value(weights, prior, features, noise)
    if settings.significance is not None and kind.blend is not None:
        fitted = kind.blend(old, fitted, share_of_evidence(p_value, settings.significance))

    num_valid = jnp.sum(is_valid, dtype=jnp.int32)
    num_fitted = features.shape[1] + theta.shape[1]
    is_updated = is_usable(kind, fitted) & (num_valid >= num_fitted) & dual.is_informative
    policy = jax.tree.map(lambda new, old: jnp.where(is_updated, new, old), fitted, old)
    entropy = kind.entropy(policy)
    loss = jnp.maximum(kind.entropy(old) - entropy, 0.0)
    spread = jnp.max(jnp.abs(reward))
    info = CrepsInfo(
        dual=dual,
        kl=relative_entropy(weights, prior),
        policy_kl=jnp.where(is_updated, mean_over(kind.kl(policy, old, features), is_valid), 0.0),
        effective_samples=effective_samples(weights),
        prior_effective_samples=effective_samples(prior),
        entropy=entropy,
        num_valid=num_valid,
        is_updated=is_updated,
        p_value=p_value,
        unsupported_loss=_share_by_chance(p_value, settings.significance) * loss,
        reward_rounding=jnp.minimum(resolution / jnp.where(spread > 0, spread, 1.0), 1.0),
    )
    return CrepsState(policy, state.archive, state.iteration + 1, history), info


def _samples(settings: CrepsSettings, state: CrepsState) -> tuple[_Samples, Any]:
    """Return the samples of an update, and the history with the policy of this iteration."""
    archive = state.archive
    context, theta, _ = archive.batch
    features = features_of("policy_features", settings.kind.features, context)
    baseline = features_of("baseline_features", settings.baseline_features, context)
    is_valid = archive.is_valid & are_finite(features) & are_finite(baseline)
    if settings.importance is not None:
        is_valid = is_valid & (archive.age < settings.importance.num_policies)
    archive = archive._replace(is_valid=is_valid)
    # A weight of zero does not remove a value that is not finite: 0 * nan is nan.
    features, theta, baseline = (jnp.where(is_valid[:, None], x, 0.0) for x in (features, theta, baseline))
    prior, history = _prior(settings, state, archive, features)
    reward, resolution = centred_reward(archive)
    return _Samples(features, baseline, theta, reward, resolution, prior, is_valid), history


def _prior(
    settings: CrepsSettings, state: CrepsState, archive: Archive, features: Array
) -> tuple[Array, Any]:
    """Return the weight of each sample before its reward is seen, and the history with this policy."""
    is_valid, theta = archive.is_valid, archive.batch.theta
    if settings.importance is None or state.history is None:
        return is_valid.astype(theta.dtype), None
    policy, iteration = state.policy, state.iteration
    history = remember(state.history, policy, iteration)
    weights = importance_weights(
        settings.kind.log_prob,
        policy,
        history,
        features,
        theta,
        archive.age,
        is_valid,
        iteration,
        least_effective=settings.importance.least_effective,
    )
    return weights, history


def _share_by_chance(p_value: Scalar, significance: float | int | None) -> Scalar:
    """Return the factor that turns the loss of an update into an unbiased estimate of the loss by chance.

    By chance p-values are uniform. Without a significance E[2 p] = 1; with one the covariance moves in
    proportion to 1 - u, where u = p / significance, and E[3 u (1 - u)] = E[1 - u].
    """
    return 2.0 * p_value if significance is None else 3.0 * jnp.minimum(p_value / significance, 1.0)


def is_usable(kind: Policy, policy: Any) -> Bool[Array, ""]:
    """Return whether all numbers of a policy are finite, and its spread is positive."""
    # The entropy of a Gaussian is not finite unless its spread is positive.
    leaves = [*jax.tree.leaves(policy), kind.entropy(policy)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))


def mean_over(values: Array, is_valid: Array) -> Scalar:
    """Return the mean of the valid values; zero if there are none."""
    count = jnp.maximum(jnp.sum(is_valid, dtype=values.dtype), 1.0)
    return jnp.sum(values, where=is_valid) / count


def sample_thetas(
    settings: CrepsSettings, key: PRNGKey, policy: Any, contexts: Array
) -> tuple[Float[Array, "n d"], Bool[Array, " n"]]:
    """Draw parameters for contexts (n, s), and return for which of them the features are finite."""
    features = features_of("policy_features", settings.kind.features, contexts)
    return settings.kind.sample(key, policy, features), are_finite(features)


def mean_thetas(
    settings: CrepsSettings, policy: Any, contexts: Array
) -> tuple[Float[Array, "n d"], Bool[Array, " n"]]:
    """Return the mean parameters for contexts (n, s), and for which of them the features are finite."""
    features = features_of("policy_features", settings.kind.features, contexts)
    return settings.kind.mean(policy, features), are_finite(features)


def features_of(name: str, features: FeatureMap, contexts: Array) -> Array:
    """Return the features of contexts (n, s), a row each, in the precision of the contexts."""

    def apply(context: Array) -> Array:
        values = checks.array(f"{name}.apply(context)", features.apply(context), (features.size,))
        return checks.converted(values, contexts.dtype)

    return jax.vmap(apply)(contexts)


def are_finite(rows: Array) -> Bool[Array, " n"]:
    """Return which rows are finite."""
    return jnp.all(jnp.isfinite(rows), axis=1)
