"""Contextual relative entropy policy search: ask for parameters, try them, tell the rewards.

The algorithm knows nothing of tasks. Whoever measures the rewards, a simulator or a person with a
robot, calls `ask`, measures, and calls `tell`; `creps_jax.train` does so for a simulated task.
"""

import dataclasses
import math
import numbers
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from creps_jax import policy as gaussian
from creps_jax.archive import Archive, Batch, empty_archive, push, valid
from creps_jax.dual import DualSolution, sample_kl, sample_weights, solve_dual
from creps_jax.features import FeatureMap
from creps_jax.importance import Importance, PolicyHistory, empty_history, importance_weights, remember
from creps_jax.linalg import exact_dot
from creps_jax.mstep import MStep, WeightedSamples, bounded_ml, weighted_ml
from creps_jax.policy import LinearGaussian
from creps_jax.typing import Array, Bool, Float, IntScalar, PRNGKey, Scalar

__all__ = ["Creps", "CrepsInfo", "CrepsState", "creps"]


class CrepsState(NamedTuple):
    """What the next step needs: all of it, so that a saved state resumes a run exactly."""

    policy: LinearGaussian
    archive: Archive
    iteration: IntScalar
    """How many batches have been told."""
    history: PolicyHistory | None = None
    """The policies that archived samples were drawn from; None where all samples count equally."""


class CrepsInfo(NamedTuple):
    """How an update went; only a reader needs it."""

    dual: DualSolution
    kl: Scalar
    """Relative entropy between the weights and those before rewards are looked at, in nats; the KL bound
    limits it."""
    policy_kl: Scalar
    """KL(new policy || old policy) in nats, the mean over the archived contexts. The bound is on
    the weighted samples: with few of them the fitted Gaussian moves farther, with many old ones less."""
    effective_samples: Scalar
    """1 / sum of squared weights: how many equally weighted samples carry as much information."""
    prior_effective_samples: Scalar
    """The same of the weights that samples have before rewards are looked at: the number of valid ones,
    or what their importance weights leave of it."""
    entropy: Scalar
    """Differential entropy of the new policy, in nats."""
    num_valid: IntScalar
    """How many archived samples the update was made from; those that are not finite are left out, and those
    of policies that the history no longer holds."""
    is_updated: Bool[Array, ""]
    """False where the policy was kept, because there were too few samples to fit one."""


@dataclasses.dataclass(frozen=True)
class Creps:
    """The algorithm as a record of pure functions, closed over and never traced.

    All of them may be jitted and vmapped; shapes are n samples, s context variables, d parameters.

    Attributes:
        init: (policy) -> state, with an empty archive.
        ask: (key, state, contexts (n, s)) -> thetas (n, d), drawn from the policy.
        tell: (state, batch) -> (state, info): archive the batch, fit a new policy to the archive. A
            sample that holds NaN or infinity, such as a measurement that failed, takes its place in the
            archive and is then ignored. The policy is kept until the archive holds as many valid
            samples as the policy has features and parameters, p + d: fewer leave the covariance singular.
        mean: (policy, contexts (n, s)) -> thetas (n, d), the policy without its exploration.
    """

    init: Callable[[LinearGaussian], CrepsState]
    ask: Callable[[PRNGKey, CrepsState, ArrayLike], Array]
    tell: Callable[[CrepsState, Batch], tuple[CrepsState, CrepsInfo]]
    mean: Callable[[LinearGaussian, ArrayLike], Array]


def creps(
    policy_features: FeatureMap,
    baseline_features: FeatureMap,
    *,
    kl_bound: float | int = 0.5,
    archive_size: int,
    ridge: float | int = 1e-4,
    m_step: MStep = weighted_ml,
    importance: Importance | None = None,
) -> Creps:
    """Set up contextual relative entropy policy search.

    Args:
        policy_features: Features varphi(s) that the policy's mean is linear in.
        baseline_features: Features phi(s) whose expectations over the contexts are kept.
        kl_bound: Largest relative entropy epsilon of one update, in nats.
        archive_size: Number L of the last samples that are learned from.
        ridge: Penalty on the policy's coefficients, relative to the square of each feature's scale.
        m_step: How the policy is fitted to the weighted samples: `weighted_ml`, the paper's, goes wherever
            they lead; `bounded_ml()` keeps mean and covariance from moving too far at once.
        importance: Weigh archived samples by how likely they are today over how likely they were when drawn
            (`Importance()`); by default all count equally, as in the paper. The weights are those of samples
            that were drawn by `ask`.

    Returns:
        The functions `init`, `ask`, `tell` and `mean`. These raise ValueError, showing what they
        got and what they expected, if shapes do not fit the features or the policy, or if contexts to ask
        for are not finite.

    Raises:
        ValueError: If a setting is out of its range, or the features are of different contexts.

    Source: Abdolmaleki et al. 2016, Section 3.1.
    """
    _check_settings(policy_features, baseline_features, kl_bound, archive_size, ridge)
    if importance is not None and not isinstance(importance, Importance):
        raise ValueError(f"importance must be an Importance or None, got {importance!r}")
    if m_step is bounded_ml:
        raise ValueError(
            "m_step must be an M-step, such as bounded_ml(), got bounded_ml without its parentheses"
        )
    context_dim = policy_features.context_dim
    scale = None if policy_features.scale is None else jnp.asarray(policy_features.scale, jnp.float32)

    def init(policy: LinearGaussian) -> CrepsState:
        theta_dim = _checked_theta_dim(policy, policy_features)
        least = policy_features.size + theta_dim
        if archive_size < least:
            raise ValueError(
                f"archive_size must be at least {least}, features and parameters, got {archive_size}"
            )
        archive = empty_archive(archive_size, context_dim, theta_dim)
        policy = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), policy)
        history = None if importance is None else empty_history(policy, importance.num_policies)
        return CrepsState(policy, archive, jnp.zeros((), jnp.int32), history)

    def ask(key: PRNGKey, state: CrepsState, contexts: ArrayLike) -> Float[Array, "n d"]:
        contexts = _checked("contexts", contexts, ("n", context_dim))
        keys = jax.random.split(key, contexts.shape[0])
        features = jax.vmap(policy_features.apply)(contexts)
        return jax.vmap(gaussian.sample, (0, None, 0))(keys, state.policy, features)

    def tell(state: CrepsState, batch: Batch) -> tuple[CrepsState, CrepsInfo]:
        archive = push(state.archive, _checked_batch(batch, state.archive))
        is_valid = valid(archive)
        # What is left out must not enter: 0 * nan is not 0.
        samples = jax.tree.map(lambda x: jnp.where(_along(is_valid, x), x, 0.0), archive.batch)

        features = jax.vmap(policy_features.apply)(samples.context)
        if importance is not None:
            is_valid = is_valid & (archive.age < importance.num_policies)
        prior, history = _prior(state, importance, features, samples.theta, archive.age, is_valid)

        baseline = jax.vmap(baseline_features.apply)(samples.context)
        dual = solve_dual(samples.reward, baseline, prior, kl_bound=kl_bound)  # Eq. (13)
        weights = sample_weights(dual, samples.reward, baseline, prior)
        weighted = WeightedSamples(features, samples.theta, weights, is_valid)
        fitted = m_step(state.policy, weighted, ridge=ridge, scale=scale)  # Eq. (14), (15)

        num_valid = jnp.sum(is_valid, dtype=jnp.int32)
        is_finite = jnp.all(jnp.isfinite(fitted.coef)) & jnp.all(jnp.isfinite(fitted.cov_chol))
        is_usable = is_finite & jnp.all(jnp.diagonal(fitted.cov_chol) > 0)
        is_updated = is_usable & (num_valid >= sum(state.policy.coef.shape))
        policy = jax.tree.map(lambda new, old: jnp.where(is_updated, new, old), fitted, state.policy)

        info = CrepsInfo(
            dual=dual,
            kl=sample_kl(weights, prior),
            policy_kl=_mean_kl(policy, state.policy, features, is_valid),
            effective_samples=_effective_samples(weights),
            prior_effective_samples=_effective_samples(prior),
            entropy=gaussian.entropy(policy),
            num_valid=num_valid,
            is_updated=is_updated,
        )
        return CrepsState(policy, archive, state.iteration + 1, history), info

    def mean(policy: LinearGaussian, contexts: ArrayLike) -> Float[Array, "n d"]:
        contexts = _checked("contexts", contexts, ("n", context_dim))
        features = jax.vmap(policy_features.apply)(contexts)
        return jax.vmap(gaussian.mean, (None, 0))(policy, features)

    # Compiled here, as ask and tell are called by hand where a robot is real.
    compiled_ask, compiled_mean = jax.jit(ask), jax.jit(mean)
    return Creps(
        init=init,
        ask=lambda key, state, contexts: compiled_ask(key, state, _checked_finite(contexts)),
        tell=jax.jit(tell),
        mean=lambda policy, contexts: compiled_mean(policy, _checked_finite(contexts)),
    )


def _mean_kl(policy: LinearGaussian, reference: LinearGaussian, features: Array, is_valid: Array) -> Scalar:
    """Average `policy.kl` over contexts; only the shift of the mean depends on the context."""
    without_shift = gaussian.kl(policy, reference, jnp.zeros_like(features[0]))
    change = (policy.coef - reference.coef).T
    whitened = jax.scipy.linalg.solve_triangular(reference.cov_chol, change, lower=True)
    shifts = exact_dot(features, whitened.T)
    count = jnp.maximum(jnp.sum(is_valid, dtype=jnp.float32), 1.0)
    return without_shift + 0.5 * jnp.sum(shifts**2, where=is_valid[:, None]) / count


def _effective_samples(weights: Array) -> Scalar:
    squares = jnp.sum(weights**2)
    return jnp.sum(weights) ** 2 / jnp.where(squares > 0, squares, 1.0)


def _along(mask: Array, array: Array) -> Array:
    """Give a mask of samples the number of axes of an array of samples."""
    return mask.reshape(mask.shape + (1,) * (array.ndim - 1))


def _checked(name: str, value: ArrayLike, shape: tuple[int | str, ...]) -> Array:
    """Return an array of float32 after comparing its shape; a letter stands for any number above zero."""
    array = jnp.asarray(value, jnp.float32)
    fits = len(array.shape) == len(shape) and all(
        got == expected or (isinstance(expected, str) and got > 0)
        for got, expected in zip(array.shape, shape, strict=True)
    )
    if not fits:
        expected = f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
        raise ValueError(f"{name} must have shape {expected}, got {array.shape}")
    return array


def _checked_finite(contexts: ArrayLike) -> ArrayLike:
    """Refuse contexts that are not finite; within a trace nobody can tell."""
    if not isinstance(contexts, Tracer):
        values = np.asarray(contexts, float)
        if not np.isfinite(values).all():
            raise ValueError(f"contexts must be finite, got {values[~np.isfinite(values)][0]}")
    return contexts


def _checked_batch(batch: Batch, archive: Archive) -> Batch:
    reward = _checked("batch.reward", batch.reward, ("n",))
    num, context_dim = reward.shape[0], archive.batch.context.shape[1]
    context = _checked("batch.context", batch.context, (num, context_dim))
    theta = _checked("batch.theta", batch.theta, (num, archive.batch.theta.shape[1]))
    return Batch(context, theta, reward)


def _prior(
    state: CrepsState,
    importance: Importance | None,
    features: Array,
    theta: Array,
    age: Array,
    is_valid: Array,
) -> tuple[Array, PolicyHistory | None]:
    """Return how much each sample counts before rewards are looked at, and the history with this policy."""
    expected = 0 if importance is None else importance.num_policies
    got = 0 if state.history is None else state.history.coef.shape[0]
    if got != expected:
        raise ValueError(f"the state must hold the last {expected} policies, as `init` makes it, got {got}")
    if importance is None or state.history is None:
        return is_valid.astype(jnp.float32), None
    policy, iteration = state.policy, state.iteration
    history = remember(state.history, policy, iteration)
    weights = importance_weights(
        policy, history, features, theta, age, is_valid, iteration, least_effective=importance.least_effective
    )
    return weights, history


def _checked_theta_dim(policy: LinearGaussian, policy_features: FeatureMap) -> int:
    coef_shape, cov_shape = jnp.shape(policy.coef), jnp.shape(policy.cov_chol)
    if len(coef_shape) != 2 or coef_shape[0] != policy_features.size or cov_shape != (coef_shape[1],) * 2:
        raise ValueError(
            f"the policy must have coef ({policy_features.size}, d), a row for each of the policy features, "
            f"and cov_chol (d, d), got {coef_shape} and {cov_shape}"
        )
    return coef_shape[1]


def _check_settings(
    policy_features: FeatureMap,
    baseline_features: FeatureMap,
    kl_bound: float | int,
    archive_size: int,
    ridge: float | int,
) -> None:
    if policy_features.context_dim != baseline_features.context_dim:
        raise ValueError(
            "policy and baseline features must be of the same context, got "
            f"{policy_features.context_dim} and {baseline_features.context_dim} variables"
        )
    if not (kl_bound > 0 and math.isfinite(kl_bound)):
        raise ValueError(f"kl_bound must be positive and finite, got {kl_bound}")
    if not isinstance(archive_size, numbers.Integral) or archive_size < 1:
        raise ValueError(f"archive_size must be an integer of at least 1, got {archive_size!r}")
    if not (ridge >= 0 and math.isfinite(ridge)):
        raise ValueError(f"ridge must be finite and not negative, got {ridge}")
