"""Contextual relative entropy policy search: ask for parameters, try them, tell the rewards.

The algorithm knows nothing of tasks. Whoever measures the rewards, a simulator or a person with a
robot, calls `ask`, measures, and calls `tell`; `creps_jax.train` does so for a simulated task.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from creps_jax import checks
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

    def __post_init__(self) -> None:
        """Check the functions."""
        for name, arguments in (
            ("init", "(policy)"),
            ("ask", "(key, state, contexts)"),
            ("tell", "(state, batch)"),
            ("mean", "(policy, contexts)"),
        ):
            checks.function(name, getattr(self, name), arguments)


@checks.arguments
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
        got and what they expected, if shapes do not fit the features or the policy, if contexts to ask
        for or a policy are not finite, or if `cov_chol` is no Cholesky factor.

    Raises:
        ValueError: If a setting is out of its range, or the features are of different contexts.

    Source: Abdolmaleki et al. 2016, Section 3.1.
    """
    _check_settings(policy_features, baseline_features, kl_bound, ridge)
    checks.function("m_step", m_step, "(policy, samples, *, ridge, scale) -> policy")
    if m_step is bounded_ml:
        raise ValueError(
            "m_step must be an M-step, such as bounded_ml(), got bounded_ml without its parentheses"
        )
    context_dim = policy_features.context_dim
    scale = None if policy_features.scale is None else jnp.asarray(policy_features.scale, jnp.float32)

    def init(policy: LinearGaussian) -> CrepsState:
        policy = _checked_policy("policy", policy, policy_features)
        for field, values in policy._asdict().items():
            checks.finite(f"policy.{field}", values, largest=checks.LARGEST)
        theta_dim = policy.coef.shape[1]
        least = policy_features.size + theta_dim
        if archive_size < least:
            raise ValueError(
                f"archive_size must be at least {least}, features and parameters, got {archive_size}"
            )
        archive = empty_archive(archive_size, context_dim, theta_dim)
        history = None if importance is None else empty_history(policy, importance.num_policies)
        return CrepsState(policy, archive, jnp.zeros((), jnp.int32), history)

    # Compiled here, as ask and tell are called by hand where a robot is real.
    @jax.jit
    def compiled_ask(key: PRNGKey, state: CrepsState, contexts: Array) -> Float[Array, "n d"]:
        keys = jax.random.split(key, contexts.shape[0])
        features = _features_of("policy_features", policy_features, contexts)
        return jax.vmap(gaussian.sample, (0, None, 0))(keys, state.policy, features)

    @jax.jit
    def compiled_tell(state: CrepsState, batch: Batch) -> tuple[CrepsState, CrepsInfo]:
        archive = push(state.archive, batch)
        is_valid = valid(archive)
        # What is left out must not enter: 0 * nan is not 0.
        samples = jax.tree.map(lambda x: jnp.where(_along(is_valid, x), x, 0.0), archive.batch)

        features = _features_of("policy_features", policy_features, samples.context)
        if importance is not None:
            is_valid = is_valid & (archive.age < importance.num_policies)
        prior, history = _prior(state, importance, features, samples.theta, archive.age, is_valid)

        baseline = _features_of("baseline_features", baseline_features, samples.context)
        dual = solve_dual(samples.reward, baseline, prior, kl_bound=kl_bound)  # Eq. (13)
        weights = sample_weights(dual, samples.reward, baseline, prior)
        weighted = WeightedSamples(features, samples.theta, weights, is_valid)
        fitted = m_step(state.policy, weighted, ridge=ridge, scale=scale)  # Eq. (14), (15)
        _check_fitted(fitted, state.policy)

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

    @jax.jit
    def compiled_mean(policy: LinearGaussian, contexts: Array) -> Float[Array, "n d"]:
        features = _features_of("policy_features", policy_features, contexts)
        return jax.vmap(gaussian.mean, (None, 0))(policy, features)

    # Checked outside of what is compiled, where values can be seen.
    def checked_contexts(contexts: ArrayLike) -> Array:
        return checks.finite("contexts", _float32(checks.array("contexts", contexts, ("n", context_dim))))

    def ask(key: PRNGKey, state: CrepsState, contexts: ArrayLike) -> Array:
        key, state = checks.key("key", key), _checked_state(state, policy_features)
        return compiled_ask(key, state, checked_contexts(contexts))

    def tell(state: CrepsState, batch: Batch) -> tuple[CrepsState, CrepsInfo]:
        state = _checked_state(state, policy_features)
        return compiled_tell(state, _checked_batch(batch, state.archive))

    def mean(policy: LinearGaussian, contexts: ArrayLike) -> Array:
        policy = _checked_policy("policy", policy, policy_features)
        return compiled_mean(policy, checked_contexts(contexts))

    return Creps(init, ask, tell, mean)


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


def _features_of(name: str, features: FeatureMap, contexts: Array) -> Array:
    def apply(context: Array) -> Array:
        return checks.array(f"{name}.apply(context)", features.apply(context), (features.size,))

    return jax.vmap(apply)(contexts)


def _float32(values: Array) -> Array:
    """Convert to float32; what has that type is returned as it is, as even an idle conversion takes time."""
    is_float32 = values.dtype == jnp.float32 and not values.weak_type
    return values if is_float32 else values.astype(jnp.float32)


def _checked_policy(name: str, policy: LinearGaussian, features: FeatureMap) -> LinearGaussian:
    """Return a policy in float32 after checking that it fits the features, and what is not traced of it."""
    checks.instance(name, policy, LinearGaussian)
    coef, cov_chol = (
        checks.array(f"{name}.coef", policy.coef),
        checks.array(f"{name}.cov_chol", policy.cov_chol),
    )
    if (
        coef.ndim != 2
        or coef.shape[0] != features.size
        or 0 in coef.shape
        or cov_chol.shape != (coef.shape[1],) * 2
    ):
        raise ValueError(
            f"the {name} must have coef ({features.size}, d), a row for each of the policy features, "
            f"and cov_chol (d, d), got {coef.shape} and {cov_chol.shape}"
        )
    policy = LinearGaussian(_float32(coef), _float32(cov_chol))
    for field, values in policy._asdict().items():
        checks.finite(f"{name}.{field}", values)
    if not isinstance(policy.cov_chol, Tracer):
        upper, diagonal = np.triu(policy.cov_chol, 1), np.diagonal(policy.cov_chol)
        if upper.any():
            entry = upper[upper != 0][0]
            raise ValueError(f"{name}.cov_chol must be lower triangular, got {entry} above its diagonal")
        checks.finite(f"the diagonal of {name}.cov_chol", diagonal, above=0.0)
    return policy


def _checked_state(state: CrepsState, features: FeatureMap) -> CrepsState:
    """Return a state, its policy in float32, after checking that it is one of these features."""
    checks.instance("state", state, CrepsState)
    policy = _checked_policy("state.policy", state.policy, features)
    checks.instance("state.archive", state.archive, Archive)
    context, theta, _ = state.archive.batch
    checks.array("state.archive.batch.context", context, ("L", features.context_dim))
    checks.array("state.archive.batch.theta", theta, ("L", policy.coef.shape[1]))
    return state._replace(policy=policy)


def _checked_batch(batch: Batch, archive: Archive) -> Batch:
    checks.instance("batch", batch, Batch)
    reward = checks.array("batch.reward", batch.reward, ("n",))
    num, context_dim = reward.shape[0], archive.batch.context.shape[1]
    theta_dim, note = archive.batch.theta.shape[1], f" beside batch.reward {reward.shape}"
    context = checks.array("batch.context", batch.context, (num, context_dim), note=note)
    theta = checks.array("batch.theta", batch.theta, (num, theta_dim), note=note)
    return Batch(*map(_float32, (context, theta, reward)))


def _check_fitted(fitted: LinearGaussian, policy: LinearGaussian) -> None:
    checks.instance("what m_step returns", fitted, LinearGaussian)
    for field, values in policy._asdict().items():
        checks.array(f"{field} of what m_step returns", getattr(fitted, field), values.shape)


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


def _check_settings(
    policy_features: FeatureMap,
    baseline_features: FeatureMap,
    kl_bound: float | int,
    ridge: float | int,
) -> None:
    _check_features("policy_features", policy_features)
    _check_features("baseline_features", baseline_features)
    if policy_features.context_dim != baseline_features.context_dim:
        raise ValueError(
            "policy_features and baseline_features must be of the same context, got "
            f"{policy_features.context_dim} and {baseline_features.context_dim} variables"
        )
    checks.number("kl_bound", kl_bound, above=0.0)
    checks.number("ridge", ridge, least=0.0)


def _check_features(name: str, features: FeatureMap) -> None:
    checks.function(f"{name}.apply", features.apply, "(context) -> features")
    size = checks.count(f"{name}.size", features.size)
    checks.count(f"{name}.context_dim", features.context_dim)
    if features.scale is not None:
        scale = checks.vector(f"{name}.scale", features.scale)
        if scale.shape != (size,) or not np.all(scale > 0):
            raise ValueError(f"{name}.scale must be {size} numbers above 0, got {features.scale}")
