"""Check what users hand over to the functions of contextual REPS: policies, states, contexts and batches."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from creps_jax import checks
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.search.archive import Archive, Batch, split_reward
from creps_jax.search.settings import CrepsSettings
from creps_jax.search.update import CrepsState
from creps_jax.typing import Array

__all__ = [
    "check_features_are_finite",
    "checked_archive_size",
    "checked_batch",
    "checked_contexts",
    "checked_policy",
    "checked_state",
    "precision_of",
    "samples_for_many_features",
    "theta_dim_of",
]

_ENOUGH_SAMPLES = 2
"""Least number of samples for each feature and parameter without a warning: with fewer, the test on evidence
has hardly any degrees of freedom left, and the covariance never moves."""
_DEFAULT_SAMPLES = 5
"""Default number of samples for each feature and parameter."""
_DEFAULT_SAMPLES_OF_NETWORKS = 10
"""The same for a network: with 5, small batches can end worse than they begin."""
_FEW_FEATURES, _SAMPLES_OF_MANY = 10, 3
"""With more features, the number of samples for each coefficient (features times parameters): policies of 32,
64 and 81 RBFs, 5 parameters and 400 samples end worse than they begin, one of 21 features does not."""
_COARSE_REWARDS = 1e-3
"""Rounding error of the rewards, as a share of their spread, above which there is a warning."""


def checked_policy(settings: CrepsSettings, name: str, policy: Any) -> Any:
    """Return a policy in one precision, after checking that it is of the kind of the settings."""
    kind = settings.kind
    if kind.checked is not None:
        return kind.checked(name, policy, kind.features)
    floats = [leaf for leaf in jax.tree.leaves(policy) if _is_float(jnp.result_type(leaf))]
    if not floats:
        raise ValueError(f"{name} must be a pytree of arrays with floats, got {checks.shown(policy)}")
    for leaf in floats:
        checks.finite(name, checks.array(name, leaf))
    return jax.tree.map(jnp.asarray, policy)


def checked_state(settings: CrepsSettings, state: CrepsState) -> CrepsState:
    """Return a state, after checking that it is of an algorithm with these settings."""
    checks.instance("state", state, CrepsState)
    policy = checked_policy(settings, "state.policy", state.policy)
    checks.instance("state.archive", state.archive, Archive)
    context, theta, reward = state.archive.batch
    if settings.archive_size is not None and jnp.shape(reward) != (settings.archive_size,):
        raise ValueError(
            f"state.archive must have the {settings.archive_size} slots of archive_size, "
            f"got {jnp.shape(reward)}"
        )
    checks.array("state.archive.batch.context", context, ("L", settings.kind.features.context_dim))
    checks.array("state.archive.batch.theta", theta, ("L", theta_dim_of(settings, policy)))
    expected = 0 if settings.importance is None else settings.importance.num_policies
    got = 0 if state.history is None else jnp.shape(jax.tree.leaves(state.history)[0])[0]
    if got != expected:
        raise ValueError(f"the state must hold the last {expected} policies, as `init` makes it, got {got}")
    return state._replace(policy=policy)


def checked_archive_size(settings: CrepsSettings, policy: Any, theta_dim: int) -> int:
    """Return the size of the archive for the first policy, after checking that it is not too small.

    Many features need more samples only if a fit finds all their coefficients anew. A network is trained from
    its last weights: with 110 to 400 samples, 8 or 32 units and 5 or 15 parameters it reaches similar
    rewards, with 60 samples worse ones, and with 800 or more the old ones slow it down for 15 parameters.
    """
    kind, num_baseline, size = settings.kind, settings.baseline_features.size, settings.archive_size
    num_features = kind.features.size if kind.num_features is None else kind.num_features(policy)
    num_fitted, least = num_features + theta_dim, kind.features.size + theta_dim
    is_linear = isinstance(policy, LinearGaussian)
    for_many = samples_for_many_features(num_features, theta_dim) if is_linear else 0
    if size is None:
        num_samples = _DEFAULT_SAMPLES if kind.num_features is None else _DEFAULT_SAMPLES_OF_NETWORKS
        return max(num_samples * num_fitted, _DEFAULT_SAMPLES * num_baseline, for_many)
    if size < least:
        raise ValueError(
            f"archive_size must be at least {least}, the number of features and parameters, got {size}"
        )
    if size <= num_baseline:
        raise ValueError(
            f"archive_size must be at least {num_baseline + 1}, one more than baseline features, which could "
            f"otherwise explain all rewards, got {size}"
        )
    enough = _ENOUGH_SAMPLES * max(num_fitted, num_baseline)
    if enough <= size < for_many:
        warnings.warn(
            f"archive_size should be at least {for_many}, {_SAMPLES_OF_MANY} samples for each of the "
            f"{num_features * theta_dim} coefficients of {num_features} features and {theta_dim} parameters, "
            f"got {size}: use fewer features, or a larger archive",
            stacklevel=3,
        )
    if size < enough:
        warnings.warn(
            f"archive_size should be at least {enough}, {_ENOUGH_SAMPLES} samples for each of "
            f"{num_features} features and {theta_dim} parameters, or for each of {num_baseline} "
            f"baseline features, got {size}: the policy will hardly move, or move by chance",
            stacklevel=3,
        )
    return size


def samples_for_many_features(num_features: int, theta_dim: int) -> int:
    """Return the least number of samples for many features, 0 for few."""
    return _SAMPLES_OF_MANY * num_features * theta_dim if num_features > _FEW_FEATURES else 0


def checked_contexts(settings: CrepsSettings, contexts: ArrayLike, policy: Any) -> Array:
    """Return contexts (n, s) in the precision of the policy, after checking them."""
    shape = ("n", settings.kind.features.context_dim)
    note = f" for features of {shape[1]} context variables"
    contexts = checks.array("contexts", contexts, shape, note=note)
    return checks.finite("contexts", checks.converted(contexts, precision_of(policy)))


def check_features_are_finite(settings: CrepsSettings, contexts: Array, is_finite: Array) -> None:
    """Refuse contexts whose policy features are not finite, where this is known."""
    if not isinstance(is_finite, Tracer) and not np.all(is_finite):
        context = np.asarray(contexts)[~np.asarray(is_finite)][0]
        features = np.asarray(settings.kind.features.apply(jnp.asarray(context)))
        raise ValueError(
            f"policy_features.apply(context) must be finite, got {features} for context {context}"
        )


def checked_batch(batch: Batch, archive: Archive) -> tuple[Batch, Array | np.ndarray, np.float32]:
    """Check a batch, and bring it into the precision of the archive.

    Returns:
        The batch; the difference between the given and the converted rewards; the machine epsilon of the
        format in which the rewards were given.
    """
    checks.instance("batch", batch, Batch)
    reward = checks.host_array("batch.reward", batch.reward, ("n",))
    dtype = archive.batch.theta.dtype
    num, context_dim = reward.shape[0], archive.batch.context.shape[1]
    theta_dim, note = archive.batch.theta.shape[1], f" beside batch.reward {reward.shape}"
    context = checks.host_array("batch.context", batch.context, (num, context_dim), note=note)
    theta = checks.host_array("batch.theta", batch.theta, (num, theta_dim), note=note)
    # The checks widen float16: the format in which the rewards were given is the coarser one.
    given = getattr(batch.reward, "dtype", reward.dtype)
    given = given if _is_float(given) else reward.dtype
    told = max(reward.dtype, given, key=lambda kind: jnp.finfo(kind).eps)
    _warn_of_coarse_rewards(reward, told)
    reward, rest = split_reward(reward, dtype)
    size = len(archive.batch.reward)
    if num > size:
        warnings.warn(
            f"archive_size should be at least {num}, the number of samples in a batch, got {size}: "
            f"only the last {size} samples are used",
            stacklevel=3,
        )
    # Arrays of NumPy stay as they are: with `jax_debug_nans` jax would refuse NaN in a conversion.
    converted = Batch(*(checks.converted(each, dtype) for each in (context, theta, reward)))
    return converted, rest, np.float32(jnp.finfo(told).eps)


def _warn_of_coarse_rewards(reward: Array | np.ndarray, told: Any) -> None:
    """Warn if the format in which rewards were told loses much of their differences, where this is known."""
    if isinstance(reward, Tracer):
        return
    values = np.asarray(reward)
    values = values[np.isfinite(values)]
    if values.size == 0:
        return
    with np.errstate(over="ignore"):
        step, spread = float(jnp.finfo(told).eps) * np.abs(values).max(), values.max() - values.min()
    if spread > 0 and _COARSE_REWARDS * spread < step:
        warnings.warn(
            f"batch.reward has a spread of {spread:.3g} around {values[0]:.6g}, where {np.dtype(told)} "
            f"has steps of {step:.3g}: tell rewards in float64, or without their common offset",
            stacklevel=4,
        )


def precision_of(policy: Any) -> Any:
    """Return the precision of the arrays of a policy."""
    leaves = [jnp.result_type(leaf) for leaf in jax.tree.leaves(policy)]
    return jnp.result_type(*(dtype for dtype in leaves if _is_float(dtype)))


def theta_dim_of(settings: CrepsSettings, policy: Any) -> int:
    """Return the number of parameters that a policy gives."""
    features = jnp.zeros((1, settings.kind.features.size), precision_of(policy))
    return jax.eval_shape(settings.kind.mean, policy, features).shape[1]


def _is_float(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jnp.floating)
