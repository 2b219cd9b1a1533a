"""Settings of contextual REPS, their checks, and the compiled programs that equal settings share."""

import dataclasses
import functools
import weakref
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from creps_jax import checks
from creps_jax.policies.base import MStep, Policy
from creps_jax.policies.features import FeatureMap
from creps_jax.policies.gaussian import linear_gaussian
from creps_jax.programs import KeepsPrograms
from creps_jax.search.fit import bounded_ml, weighted_ml
from creps_jax.search.importance import Importance
from creps_jax.typing import ScalarLike

__all__ = ["CrepsSettings", "Programs", "checked_kl_bound", "checked_settings", "policy_kind"]


class Programs(dict[Any, Callable]):
    """Compiled programs by their functions; unlike a plain dict it can be referred to weakly."""


_PROGRAMS: weakref.WeakValueDictionary[tuple, Programs] = weakref.WeakValueDictionary()
"""The programs of all algorithms that are alive, by their settings without the KL bound."""


@dataclasses.dataclass(frozen=True, eq=False)
class CrepsSettings(KeepsPrograms):
    """The settings of contextual REPS, see `creps`."""

    kind: Policy
    baseline_features: FeatureMap
    kl_bound: ScalarLike
    archive_size: int | None
    importance: Importance | None
    significance: float | int | None

    def compiled(self, function: Callable) -> Callable:
        """Return the compiled program of `function(settings, ...)`, which must not use the KL bound."""
        if function not in self.programs:
            # A copy: the program must not keep alive the settings that keep it.
            copy = dataclasses.replace(self, kl_bound=np.float32(0))
            self.programs[function] = jax.jit(functools.partial(function, copy))
        return self.programs[function]

    @functools.cached_property
    def programs(self) -> Programs:
        """Programs that were compiled with these settings, whatever the KL bound."""
        names = [field.name for field in dataclasses.fields(self) if field.name != "kl_bound"]
        identity = tuple(getattr(self, name) for name in names)
        try:
            found = _PROGRAMS.get(identity)
        except TypeError:  # features that cannot be hashed: nothing to share
            return Programs()
        if found is None:
            found = _PROGRAMS[identity] = Programs()
        return found


def checked_kl_bound(kl_bound: ScalarLike) -> ScalarLike:
    """Return a bound in float32, unless it is traced: jax would compile anew for another type."""
    checks.number("kl_bound", kl_bound, above=0.0)
    return kl_bound if isinstance(kl_bound, Tracer) else np.float32(kl_bound)


@checks.arguments
def checked_settings(
    *,
    kind: Policy,
    baseline_features: FeatureMap,
    kl_bound: ScalarLike,
    archive_size: int | None,
    importance: Importance | None,
    significance: float | int | None,
) -> CrepsSettings:
    """Return settings, after checking each of them and that they fit each other.

    Raises:
        ValueError: If a setting is out of its range, or the features are of different contexts.
    """
    kl_bound = checked_kl_bound(kl_bound)
    if significance is not None and not 0 < significance <= 1:
        raise ValueError(f"significance must be above 0 and at most 1, or None, got {significance}")
    for name in ("mean", "sample", "log_prob", "kl", "entropy", "fit"):
        checks.function(f"policy_features.{name}", getattr(kind, name), "see Policy")
    _check_features("policy_features", kind.features)
    _check_features("baseline_features", baseline_features)
    if kind.features.context_dim != baseline_features.context_dim:
        raise ValueError(
            "policy_features and baseline_features must be of the same context, got "
            f"{kind.features.context_dim} and {baseline_features.context_dim} variables"
        )
    if significance is not None and kind.blend is None:
        raise ValueError(
            f"significance must be None for a policy that has no function blend, got {significance}"
        )
    return CrepsSettings(kind, baseline_features, kl_bound, archive_size, importance, significance)


def _check_features(name: str, features: FeatureMap) -> None:
    """Check that the fields of features have the right types and fit each other."""
    checks.function(f"{name}.apply", features.apply, "(context) -> features")
    size = checks.count(f"{name}.size", features.size)
    checks.count(f"{name}.context_dim", features.context_dim)
    if features.scale is not None:
        scale = checks.vector(f"{name}.scale", features.scale)
        if scale.shape != (size,) or not np.all(scale > 0):
            raise ValueError(f"{name}.scale must be {size} numbers above 0, got {features.scale}")


def policy_kind(given: FeatureMap | Policy, ridge: float | int | None, m_step: MStep | None) -> Policy:
    """Return the kind of policy: the given one, or a Gaussian that is linear in the given features."""
    if isinstance(given, Policy):
        if ridge is not None or m_step is not None:
            raise ValueError(f"ridge and m_step must be None for a Policy, got {ridge} and {m_step}")
        checks.instance("policy_features.features", given.features, FeatureMap)
        return given
    if m_step is bounded_ml:
        raise ValueError(
            "m_step must be an M-step, such as bounded_ml(), got bounded_ml without its parentheses"
        )
    m_step = weighted_ml if m_step is None else m_step
    return linear_gaussian(given, m_step=m_step, ridge=1e-4 if ridge is None else ridge)
