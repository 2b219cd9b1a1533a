"""Policy search by a quadratic model of the reward, which falls back to contextual REPS: ask and tell."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from creps_jax import checks
from creps_jax.policies.base import MStep
from creps_jax.policies.features import FeatureMap
from creps_jax.search import creps as contextual_reps
from creps_jax.search.archive import Batch, empty_archive, push
from creps_jax.search.creps import Creps
from creps_jax.search.fit import bounded_ml
from creps_jax.search.input_checks import (
    checked_batch,
    checked_state,
)
from creps_jax.search.settings import checked_settings, policy_kind
from creps_jax.search.surrogate_update import (
    SurrogateInfo,
    SurrogateSettings,
    SurrogateState,
    default_archive_size,
    least_samples,
    num_context_columns,
    surrogate_update,
)
from creps_jax.search.update import CrepsState
from creps_jax.typing import Array, PRNGKey, ScalarLike

__all__ = ["Surrogate", "SurrogateInfo", "SurrogateState", "surrogate"]

_push = jax.jit(push)


@dataclasses.dataclass(frozen=True)
class Surrogate(Creps):
    """The search of `surrogate` as a record of pure functions, see `Search` and `Creps`."""

    @staticmethod
    def _functions() -> tuple[Callable, ...]:
        return init, ask, tell, policy, mean

    @staticmethod
    def _checked(**fields: Any) -> SurrogateSettings:
        return _checked(**fields)


@checks.arguments
def surrogate(
    policy_features: FeatureMap,
    baseline_features: FeatureMap | None = None,
    *,
    kl_bound: ScalarLike = 0.5,
    archive_size: int | None = None,
    ridge: float | int | None = None,
    m_step: MStep | None = None,
    significance: float | int | None = 0.1,
    gate: float | int = 0.6,
) -> Surrogate:
    """Set up policy search by a quadratic model of the reward, with contextual REPS where the model is bad.

    The model of the reward is quadratic in the parameters, around the mean of the policy. It is fitted to the
    last samples, and to older ones that the policy could still have drawn. Rewards far below the others
    (falls) and samples far from the model are left out. The mean moves to the maximum of the model within
    `kl_bound`, the covariance towards the inverse of its curvature within a smaller bound. Then, outside of
    both bounds, the spread grows while steps go in one direction, and shrinks otherwise. On quadratics the
    search needs 6 to 23 % of the episodes of contextual REPS with `bounded_ml()`, on their roots half of
    them. If the model explains less than `gate`, the update is that of contextual REPS.

    Args:
        policy_features: Features varphi(s) that the mean of the Gaussian policy is linear in.
        baseline_features: The model takes the reward at the mean of the policy to be quadratic in these
            features, or linear if there are more than 12. They are also the baseline features of contextual
            REPS. By default those of the policy.
        kl_bound: Largest relative entropy of one update by the change of the mean, in nats; also the bound of
            contextual REPS, see `creps`. Another value compiles nothing anew.
        archive_size: Number L of the last samples that are kept; by default at least twice the number of
            coefficients of the model, and up to 18 times that number or 2000, which reduces the effect of
            noise. With fewer samples than coefficients, the curvature has no products of different
            parameters. With less than two for each policy feature and parameter, the model is never used:
            `init` warns.
        ridge: As in `creps`; the model has a penalty of its own, chosen by cross-validation.
        m_step: Fit of the policy where the model is not used, `bounded_ml()` by default.
        significance: As in `creps`.
        gate: Least share of the variance of the rewards, beyond that by the context, that the model must
            explain in cross-validation. Nor is the model used if it leaves out more than 20 % of the samples,
            or more than 5 % and these depend on the parameters: rewards that jump, not falls by chance.

    Returns:
        The search, with the functions `init`, `ask`, `tell`, `policy` and `mean`. `tell` returns
        `SurrogateInfo`.

    Raises:
        ValueError: If a setting is out of its range, or the features are of different contexts.

    Source: Abdolmaleki et al. 2015, Model-based relative entropy stochastic search; Tangkaratt et al. 2017,
    Policy search with high-dimensional context variables; Huettenrauch and Neumann 2024, Robust black-box
    optimization for stochastic search and episodic reinforcement learning.
    """
    kind = policy_kind(policy_features, ridge, bounded_ml() if m_step is None else m_step)
    return Surrogate.of_settings(
        _checked(
            kind=kind,
            baseline_features=kind.features if baseline_features is None else baseline_features,
            kl_bound=kl_bound,
            archive_size=archive_size,
            importance=None,
            significance=significance,
            gate=gate,
        )
    )


def init(settings: SurrogateSettings, policy: Any) -> SurrogateState:
    """Start from a policy and an empty archive; see `creps_jax.search.creps.init`."""
    num_features, num_baseline = settings.kind.features.size, settings.baseline_features.size
    state = contextual_reps.init(settings, policy)
    dim = state.policy.coef.shape[1]
    archive = state.archive
    num_context = num_context_columns(num_baseline)
    least = least_samples(dim, num_features, num_context)
    if settings.archive_size is not None and settings.archive_size < least:
        warnings.warn(
            f"archive_size should be at least {least}, with which the model of the reward can be used, got "
            f"{settings.archive_size}: all updates will be those of contextual REPS",
            stacklevel=2,
        )
    if settings.archive_size is None:
        size = default_archive_size(dim, num_features, num_context)
        archive = empty_archive(size, settings.kind.features.context_dim, dim, state.policy.coef.dtype)
    return SurrogateState(
        state.policy, archive, state.iteration, jnp.zeros((dim, num_features), state.policy.coef.dtype)
    )


def ask(settings: SurrogateSettings, key: PRNGKey, state: SurrogateState, contexts: ArrayLike) -> Array:
    """Draw parameters from the policy; see `creps_jax.search.creps.ask`."""
    return contextual_reps.ask(settings, key, _as_creps_state(settings, state), contexts)


def tell(
    settings: SurrogateSettings, state: SurrogateState, batch: Batch
) -> tuple[SurrogateState, SurrogateInfo]:
    """Archive a batch, and move the policy; see `creps_jax.search.creps.tell`."""
    policy, archive, _, _ = _as_creps_state(settings, state)
    archive = _push(archive, *checked_batch(batch, archive))
    state = state._replace(policy=policy, archive=archive)
    return settings.compiled(surrogate_update)(settings.kl_bound, state)


def policy(settings: SurrogateSettings, state: Any) -> Any:
    """Return the policy of a state."""
    return _as_creps_state(settings, state).policy


def mean(settings: SurrogateSettings, policy: Any, contexts: ArrayLike) -> Array:
    """Return the mean parameters (n, d) of a policy or a state; see `creps_jax.search.creps.mean`."""
    policy = policy.policy if isinstance(policy, SurrogateState) else policy
    return contextual_reps.mean(settings, policy, contexts)


def _as_creps_state(settings: SurrogateSettings, state: Any) -> CrepsState:
    """Check a state, and return the part that contextual REPS has as well."""
    checks.instance("state", state, SurrogateState)
    found = checked_state(settings, CrepsState(state.policy, state.archive, state.iteration))
    checks.array("state.path", state.path, found.policy.coef.shape[::-1])
    return found


def _checked(*, gate: float | int, **settings: Any) -> SurrogateSettings:
    """Return settings, after checking each of them."""
    found = checked_settings(**settings)
    checks.number("gate", gate)
    if not 0 < gate <= 1:
        raise ValueError(f"gate must be above 0 and at most 1, got {gate}")
    if found.importance is not None:
        raise ValueError(f"importance must be None for a surrogate, got {checks.shown(found.importance)}")
    fields = {field.name: getattr(found, field.name) for field in dataclasses.fields(found)}
    return SurrogateSettings(**fields, gate=gate)
