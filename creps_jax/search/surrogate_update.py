"""The update of the search by a quadratic model: fit, gate, step, or the update of contextual REPS."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from creps_jax.numerics.linalg import exact_dot
from creps_jax.policies.gaussian import LinearGaussian, whitened
from creps_jax.search.archive import Archive, centred_reward
from creps_jax.search.dual import DualSolution
from creps_jax.search.evidence import independence_p_value
from creps_jax.search.settings import CrepsSettings
from creps_jax.search.surrogate_fit import Quadratic, fit_quadratic, num_unknowns, whitener
from creps_jax.search.surrogate_step import Step, path_decay, step
from creps_jax.search.update import CrepsState, are_finite, features_of, is_usable, mean_over, update
from creps_jax.typing import Array, Bool, Float, IntScalar, Scalar, ScalarLike

__all__ = ["SurrogateInfo", "SurrogateSettings", "SurrogateState", "default_archive_size", "surrogate_update"]

_ENOUGH = 1.5
"""Number of samples for each coefficient of the model that are used whatever their age."""
_NEAR = 2.0
"""Older samples are used as well where their mean square, in units of the spread, is below this."""
_MOST_SAMPLES = 2000
"""Largest default archive, unless the model needs more."""
_MOST_COLUMNS = 600
"""Largest number of coefficients; beyond it the curvature is diagonal."""
_BOUNDED_SAMPLES = 20
"""Number of samples for each feature and parameter that the bounded fit uses."""
_MANY_LEFT_OUT = 0.05
"""Share of samples left out from which on they must not depend on the parameters."""
_BY_CHANCE = 0.01
"""Least p-value at which they count as independent."""
_TOO_MANY_LEFT_OUT = 0.2
"""Share of samples left out from which on the model is not used."""
_SAMPLES_OF_SLOPE = 2
"""Least number of samples for each coefficient of the slope, besides those of the context."""


@dataclasses.dataclass(frozen=True, eq=False)
class SurrogateSettings(CrepsSettings):
    """The settings of `surrogate`: those of contextual REPS, and the gate."""

    gate: float


class SurrogateState(NamedTuple):
    """All that the next step needs: a saved state resumes a run exactly."""

    policy: LinearGaussian
    archive: Archive
    iteration: IntScalar
    """Number of batches told so far."""
    path: Float[Array, "d p"]
    """Weighted sum of the last steps of the mean, in units of the policy's spread."""


class SurrogateInfo(NamedTuple):
    """Diagnostics of an update. The fields up to `reward_rounding` are those of `CrepsInfo`."""

    dual: DualSolution
    kl: Scalar
    policy_kl: Scalar
    effective_samples: Scalar
    prior_effective_samples: Scalar
    entropy: Scalar
    num_valid: IntScalar
    is_updated: Bool[Array, ""]
    p_value: Scalar
    unsupported_loss: Scalar
    reward_rounding: Scalar
    is_by_model: Bool[Array, ""]
    """Whether the policy moved by the model; otherwise by the bounded fit of contextual REPS."""
    model_r2: Scalar
    """Share of the variance of the rewards, beyond that by the context, which the model explains in
    cross-validation; at most 1, negative for a model that predicts worse than none."""
    num_fitted: IntScalar
    """Number of samples that the model was fitted to."""
    num_left_out: IntScalar
    """Number of samples that it left out, as falls or outliers."""


def default_archive_size(theta_dim: int, num_features: int, num_context: int) -> int:
    """Return the size of an archive with enough samples for the model, and more where noise needs them."""
    unknowns, _ = _coefficients(theta_dim, num_features, num_context)
    return max(_BOUNDED_SAMPLES * (num_features + theta_dim), 2 * unknowns, min(18 * unknowns, _MOST_SAMPLES))


def _coefficients(theta_dim: int, num_features: int, num_context: int) -> tuple[int, bool]:
    """Return the number of coefficients of the model, and whether it has products of parameters."""
    whole = num_unknowns(theta_dim, num_features, num_context)
    if whole <= _MOST_COLUMNS:
        return whole, True
    return theta_dim * (1 + num_features) + num_context, False


def least_samples(theta_dim: int, num_features: int, num_context: int) -> int:
    """Return the least number of samples with which the model is used."""
    return _SAMPLES_OF_SLOPE * theta_dim * num_features + num_context


def surrogate_update(
    settings: SurrogateSettings, kl_bound: ScalarLike, state: SurrogateState
) -> tuple[SurrogateState, SurrogateInfo]:
    """Move the policy by a quadratic model, or by the bounded fit where the model explains too little."""
    policy, archive, _, path = state
    num_baseline = settings.baseline_features.size
    fallback, info = lax.optimization_barrier(_bounded_update(settings, kl_bound, state))
    model, moved, features, is_valid, is_smooth = _modelled(settings, kl_bound, state)
    theta_dim, num_features = path.shape
    least = least_samples(theta_dim, num_features, num_context_columns(num_baseline))
    is_good = (
        (model.r2 >= settings.gate)
        & is_smooth
        & is_usable(settings.kind, moved.policy)
        & jnp.all(jnp.isfinite(moved.path))
        & info.dual.is_informative
        & (model.num_used >= least)
    )
    chosen = jax.tree.map(lambda new, other: jnp.where(is_good, new, other), moved.policy, fallback)
    rest = (1.0 - path_decay(path.shape[0])) * path
    kind = settings.kind
    entropy = kind.entropy(chosen)
    policy_kl = mean_over(kind.kl(chosen, policy, features), is_valid)
    common = info._replace(
        entropy=entropy,
        is_updated=info.is_updated | is_good,
        policy_kl=jnp.where(is_good, policy_kl, info.policy_kl),
        unsupported_loss=jnp.where(is_good, 0.0, info.unsupported_loss),
    )
    info = SurrogateInfo(
        **common._asdict(),
        is_by_model=is_good,
        model_r2=model.r2,
        num_fitted=model.num_used,
        num_left_out=jnp.sum(model.is_left_out, dtype=jnp.int32),
    )
    path = jnp.where(is_good, moved.path, rest)
    return SurrogateState(chosen, archive, state.iteration + 1, path), info


def _bounded_update(
    settings: SurrogateSettings, kl_bound: ScalarLike, state: SurrogateState
) -> tuple[Any, Any]:
    """Return the policy and the diagnostics of contextual REPS, on as many of the last samples as suit it."""
    size, dim = state.archive.batch.theta.shape
    num_fitted = max(settings.kind.features.size + dim, settings.baseline_features.size)
    num = min(_BOUNDED_SAMPLES * num_fitted, size)
    archive = state.archive._replace(is_valid=state.archive.is_valid & (_recency(state.archive) < num))
    creps_state = CrepsState(state.policy, archive, state.iteration)
    following, info = update(settings, kl_bound, creps_state)
    return following.policy, info


def _modelled(
    settings: SurrogateSettings, kl_bound: ScalarLike, state: SurrogateState
) -> tuple[Quadratic, Step, Array, Array, Array]:
    """Fit the model and move by it.

    Returns:
        The model, the step, the policy features, which samples are valid, and whether rewards are smooth.
    """
    policy, archive, _, path = state
    context, theta, _ = archive.batch
    features = features_of("policy_features", settings.kind.features, context)
    baseline = features_of("baseline_features", settings.baseline_features, context)
    is_valid = archive.is_valid & are_finite(features) & are_finite(baseline)
    features, theta, baseline = (jnp.where(is_valid[:, None], x, 0.0) for x in (features, theta, baseline))
    columns = context_columns(baseline)
    z = jnp.where(is_valid[:, None], whitened(policy, features, theta), 0.0)
    size, dim = theta.shape
    unknowns, has_products = _coefficients(dim, features.shape[1], columns.shape[1])
    recent = _recency(archive) < int(_ENOUGH * unknowns)
    is_near = jnp.mean(z**2, axis=1) <= _NEAR
    is_used = is_valid & (recent | is_near)
    whitening = whitener(features, is_used)
    white = exact_dot(features, whitening)
    reward, _ = centred_reward(archive._replace(is_valid=is_valid))
    model = fit_quadratic(
        z,
        white,
        columns,
        reward,
        is_used,
        has_products=has_products and unknowns <= size,
    )
    theta_size = jnp.max(jnp.abs(theta), axis=0)
    theta_size = jnp.where(theta_size > 0, theta_size, 1.0)
    shown = jnp.where(is_used[:, None], features, 0.0)
    moved = step(policy, model, path, shown, whitening, theta_size, kl_bound=kl_bound)
    return model, moved, features, is_valid, _is_smooth(model, is_used, white, z)


def context_columns(baseline: Float[Array, "n m"]) -> Float[Array, "n q"]:
    """Return a constant, the baseline features, and their products if there are not many."""
    num = baseline.shape[1]
    columns = [jnp.ones_like(baseline[:, :1]), baseline]
    if has_context_products(num):
        rows, cols = np.triu_indices(num)
        columns.append(baseline[:, rows] * baseline[:, cols])
    return jnp.concatenate(columns, axis=1)


def has_context_products(num_baseline: int) -> bool:
    """Return whether the model has products of baseline features."""
    return num_baseline <= 12


def num_context_columns(num_baseline: int) -> int:
    """Return the number of columns of `context_columns`."""
    products = num_baseline * (num_baseline + 1) // 2 if has_context_products(num_baseline) else 0
    return 1 + num_baseline + products


def _recency(archive: Archive) -> Array:
    """Return the number of samples that are newer than each sample."""
    size = archive.batch.reward.shape[0]
    return (archive.next_index - 1 - jnp.arange(size, dtype=jnp.int32)) % size


def _is_smooth(model: Quadratic, is_used: Array, features: Array, z: Array) -> Array:
    """Return whether samples are left out by chance, as falls are: rewards that jump depend on parameters."""
    used, left_out = is_used.astype(z.dtype), model.is_left_out.astype(z.dtype)
    num, num_left_out = jnp.sum(used), jnp.sum(left_out)
    p_value = independence_p_value(left_out / jnp.maximum(num_left_out, 1.0), used, features, z)
    is_by_chance = (num_left_out <= _MANY_LEFT_OUT * num) | (p_value >= _BY_CHANCE)
    return is_by_chance & (num_left_out <= _TOO_MANY_LEFT_OUT * num)
