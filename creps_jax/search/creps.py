"""Contextual relative entropy policy search: ask for parameters, try them, tell the rewards.

The search does not know the task. A simulation or a person with a robot measures rewards between `ask` and
`tell`; `creps_jax.train` runs this loop for a simulated task.
"""

import dataclasses
import functools
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from creps_jax import checks
from creps_jax.keys import threefry
from creps_jax.policies.base import MStep, Policy
from creps_jax.policies.features import FeatureMap
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.search.archive import Batch, empty_archive, push
from creps_jax.search.base import Search
from creps_jax.search.importance import Importance, empty_history
from creps_jax.search.input_checks import (
    check_features_are_finite,
    checked_archive_size,
    checked_batch,
    checked_contexts,
    checked_policy,
    checked_state,
    precision_of,
    theta_dim_of,
)
from creps_jax.search.settings import CrepsSettings, checked_kl_bound, checked_settings, policy_kind
from creps_jax.search.update import CrepsInfo, CrepsState, mean_thetas, sample_thetas, update
from creps_jax.typing import Array, PRNGKey, ScalarLike

__all__ = [
    "Creps",
    "CrepsInfo",
    "CrepsSettings",
    "CrepsState",
    "ask",
    "creps",
    "init",
    "mean",
    "policy",
    "tell",
]

_push = jax.jit(push)

_LARGEST = {"coef": 1e36, "cov_chol": checks.LARGEST}
"""Largest numbers of a first policy: coefficients are multiplied by small features, the spread is squared."""


@dataclasses.dataclass(frozen=True)
class Creps(Search):
    """Contextual REPS as a record of pure functions, see `Search`.

    The functions are those of `creps_jax.search.creps`, with the settings already given. Algorithms of equal
    settings share compiled programs, whatever their KL bounds; the programs are freed with the last of these
    algorithms. An algorithm can be pickled if its features and M-step can, as those of this library.

    Attributes:
        mean: (policy or state, contexts (n, s)) -> mean thetas (n, d), without exploration.
    """

    mean: Callable[[Any, ArrayLike], Array]

    def __post_init__(self) -> None:
        """Check the functions."""
        super().__post_init__()
        checks.function("mean", self.mean, "(policy, contexts)")

    @functools.cached_property
    def settings(self) -> CrepsSettings | None:
        """The settings that the functions share; None if one of the functions was replaced."""
        functions = (self.init, self.ask, self.tell, self.policy, self.mean)
        owners = [self._settings_of(function) for function in functions]
        return owners[0] if all(owner is owners[0] for owner in owners) else None

    @functools.cached_property
    def programs(self) -> dict[Any, Any]:
        """Compiled programs that contain this algorithm, such as iterations."""
        return {} if self.settings is None else self.settings.programs

    @property
    def traced(self) -> Any:
        """The KL bound."""
        return np.float32(0) if self.settings is None else self.settings.kl_bound

    def with_traced(self, traced: Any) -> "Creps":
        """Return the algorithm with another KL bound, or unchanged if one of its functions was replaced.

        Compiled programs use it, which contain algorithms of any kind; see `with_kl_bound` for users.
        """
        if self.settings is None:
            return dataclasses.replace(self)
        return self.of_settings(dataclasses.replace(self.settings, kl_bound=checked_kl_bound(traced)))

    def with_settings(self, **changes: Any) -> "Creps":
        """Return the algorithm with other values of some of the fields of `settings`.

        Raises:
            ValueError: If one of its functions was replaced, so that it has no settings; or if a value is
                out of its range.
        """
        if self.settings is None:
            maker = type(self).__name__.lower()
            raise ValueError(
                f"the algorithm must be made by {maker}() to change its settings, got another one"
            )
        fields = {
            field.name: getattr(self.settings, field.name) for field in dataclasses.fields(self.settings)
        }
        return self.of_settings(self._checked(**(fields | changes)))

    def with_kl_bound(self, kl_bound: ScalarLike) -> "Creps":
        """Return the algorithm with another KL bound; nothing is compiled anew.

        Args:
            kl_bound: Largest relative entropy of one update, in nats.

        Raises:
            ValueError: If the bound is not a number above 0, or one of the functions was replaced.
        """
        return self.with_settings(kl_bound=kl_bound)

    @classmethod
    def of_settings(cls, settings: Any) -> Any:
        """Return the functions of this kind of search with these settings."""
        # Now, while an algorithm may be alive that shares the programs, such as the one that this replaces.
        _ = settings.programs
        return cls(*(_with_settings(settings, function) for function in cls._functions()))

    @classmethod
    def _settings_of(cls, function: Callable) -> Any:
        """Return the settings that `of_settings` has given to a function; None for any other function."""
        is_own = isinstance(function, partial) and function.func in cls._functions()
        return function.args[0] if is_own else None

    # What another search of the same settings replaces.
    @staticmethod
    def _functions() -> tuple[Callable, ...]:
        """Return the functions of the record, whose first argument are the settings."""
        return init, ask, tell, policy, mean

    @staticmethod
    def _checked(**fields: Any) -> CrepsSettings:
        """Return settings, after checking each of them."""
        return checked_settings(**fields)


@checks.arguments
def creps(
    policy_features: FeatureMap | Policy,
    baseline_features: FeatureMap | None = None,
    *,
    kl_bound: ScalarLike = 0.5,
    archive_size: int | None = None,
    ridge: float | int | None = None,
    m_step: MStep | None = None,
    importance: Importance | None = None,
    significance: float | int | None = 0.1,
) -> Creps:
    """Set up contextual relative entropy policy search.

    Args:
        policy_features: Features varphi(s) that the mean of a Gaussian policy is linear in; or another kind
            of policy, see `Policy`.
        baseline_features: Features phi(s) whose means over the contexts the weights keep; by default those of
            the policy.
        kl_bound: Largest relative entropy epsilon of one update, in nats. Another value compiles nothing
            anew. Inside `jit`, where it cannot be checked, a bound that is not above 0 keeps the policy.
        archive_size: Number L of the last samples that are learned from; by default five for each policy
            feature and parameter (for a network: ten for each unit of its last layer and parameter), or
            five for each baseline feature if that is more. Two are recommended: `init` warns of fewer. With
            more than 10 features of a linear policy, three for each coefficient (features times parameters)
            are the least default and recommended. It refuses an archive with less than one for each feature
            of the context and each parameter, and one that is not larger than the number of baseline
            features, which could then explain all rewards.
        ridge: Penalty on the policy's coefficients, relative to the square of each feature's scale; 1e-4 by
            default.
        m_step: Fit of the policy to the weighted samples. `weighted_ml`, the paper's fit and the default,
            does not bound the change of the policy; `bounded_ml()` bounds the change of mean and covariance.
        importance: Weigh each archived sample by its likelihood under the current policy over its likelihood
            when it was drawn (`Importance()`); by default all count equally, as in the paper. The weights
            assume that samples were drawn by `ask`.
        significance: Largest p-value, above 0 and at most 1, at which the covariance still moves. It moves
            the fraction `1 - p_value / significance` of the way to the fitted covariance. With None it moves
            all the way whatever the evidence, as in the paper, and noise alone reduces the exploration.

    Returns:
        The algorithm, with the functions `init`, `ask`, `tell`, `policy` and `mean`.

    Raises:
        ValueError: If a setting is out of its range, or the features are of different contexts.

    Source: Abdolmaleki et al. 2016, Section 3.1.
    """
    kind = policy_kind(policy_features, ridge, m_step)
    settings = checked_settings(
        kind=kind,
        baseline_features=kind.features if baseline_features is None else baseline_features,
        kl_bound=kl_bound,
        archive_size=archive_size,
        importance=importance,
        significance=significance,
    )
    return Creps.of_settings(settings)


def init(settings: CrepsSettings, policy: Any) -> CrepsState:
    """Start from a policy and an empty archive, both in the precision of the policy.

    Args:
        settings: The settings; the functions of `creps` have them already.
        policy: The first policy, a `LinearGaussian` unless `creps` was given another kind.

    Returns:
        The state.

    Raises:
        ValueError: If the policy does not fit the features, is not finite, or `cov_chol` is not a Cholesky
            factor; or if the archive has fewer samples than the policy has features and parameters, or no
            more than there are baseline features.

    Warns:
        UserWarning: If the archive is too small for reliable fits.
    """
    policy = checked_policy(settings, "policy", policy)
    if isinstance(policy, LinearGaussian):
        for field, values in policy._asdict().items():
            checks.finite(f"policy.{field}", values, largest=_LARGEST[field])
    dim = theta_dim_of(settings, policy)
    archive_size = checked_archive_size(settings, policy, dim)
    archive = empty_archive(archive_size, settings.kind.features.context_dim, dim, precision_of(policy))
    importance = settings.importance
    history = None if importance is None else empty_history(policy, importance.num_policies)
    return CrepsState(policy, archive, jnp.zeros((), jnp.int32), history)


def ask(settings: CrepsSettings, key: PRNGKey, state: CrepsState, contexts: ArrayLike) -> Array:
    """Draw parameters from the policy.

    Args:
        settings: The settings; the functions of `creps` have them already.
        key: Random key, of any implementation.
        state: The state.
        contexts: Contexts (n, s).

    Returns:
        Parameters theta (n, d).

    Raises:
        ValueError: If the state is of other features or of another archive size, or contexts or their
            features are not finite.
    """
    key, state = threefry(checks.key("key", key)), checked_state(settings, state)
    contexts = checked_contexts(settings, contexts, state.policy)
    thetas, is_finite = settings.compiled(sample_thetas)(key, state.policy, contexts)
    check_features_are_finite(settings, contexts, is_finite)
    return thetas


def tell(settings: CrepsSettings, state: CrepsState, batch: Batch) -> tuple[CrepsState, CrepsInfo]:
    """Archive a batch, and fit a new policy to the archive.

    A sample that holds NaN or infinity (a failed measurement, for example), or whose features do, is
    archived but not used. The policy is kept until the archive holds as many valid samples as the policy has
    features and parameters, p + d: with fewer the covariance is singular. It is also kept where rewards do
    not differ after the baseline. For batches of another size only a small program is compiled anew, which
    puts the batch into the archive.

    Args:
        settings: The settings; the functions of `creps` have them already.
        state: The state.
        batch: Contexts (n, s), parameters (n, d) and rewards (n,). NumPy rewards in float64 keep their
            differences even with a large common offset.

    Returns:
        The new state, and diagnostics of the update.

    Raises:
        ValueError: If shapes do not fit the features or the policy.

    Warns:
        UserWarning: If rounding loses much of the differences of the rewards, or a batch has more samples
            than the archive.
    """
    state = checked_state(settings, state)
    archive = _push(state.archive, *checked_batch(batch, state.archive))
    return settings.compiled(update)(settings.kl_bound, state._replace(archive=archive))


def policy(settings: CrepsSettings, state: CrepsState) -> Any:
    """Return the policy of a state."""
    return checked_state(settings, state).policy


def mean(settings: CrepsSettings, policy: Any, contexts: ArrayLike) -> Array:
    """Return the mean parameters theta (n, d) of a policy for contexts (n, s), without exploration.

    Args:
        settings: The settings; the functions of `creps` have them already.
        policy: A policy, or a state with one.
        contexts: Contexts (n, s).

    Raises:
        ValueError: If the policy does not fit the features, or contexts or their features are not finite.
    """
    policy = policy.policy if isinstance(policy, CrepsState) else policy
    policy = checked_policy(settings, "policy", policy)
    contexts = checked_contexts(settings, contexts, policy)
    thetas, is_finite = settings.compiled(mean_thetas)(policy, contexts)
    check_features_are_finite(settings, contexts, is_finite)
    return thetas


def _with_settings(settings: CrepsSettings, function: Callable) -> Callable:
    """Return a function with its first argument, and with its docstring for `help`."""
    given = partial(function, settings)
    given.__doc__ = function.__doc__
    return given
