"""Contextual relative entropy policy search: ask for parameters, try them, tell the rewards.

The algorithm knows nothing of tasks. Whoever measures the rewards, a simulator or a person with a
robot, calls `ask`, measures, and calls `tell`; `creps_jax.train` does so for a simulated task.
"""

import dataclasses
import functools
import warnings
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike

from creps_jax import checks
from creps_jax.keys import threefry
from creps_jax.policies.base import Policy, WeightedSamples
from creps_jax.policies.features import FeatureMap
from creps_jax.policies.gaussian import LinearGaussian, linear_gaussian
from creps_jax.programs import KeepsPrograms
from creps_jax.search.archive import Archive, Batch, centred_reward, empty_archive, push, split_reward
from creps_jax.search.base import Search
from creps_jax.search.dual import DualSolution, sample_kl, solve_and_weigh
from creps_jax.search.evidence import independence_p_value, share_of_evidence
from creps_jax.search.fit import MStep, bounded_ml, weighted_ml
from creps_jax.search.importance import Importance, empty_history, importance_weights, remember
from creps_jax.typing import Array, Bool, Float, IntScalar, PRNGKey, Scalar, ScalarLike

__all__ = ["Creps", "CrepsInfo", "CrepsSettings", "CrepsState", "creps"]

_ENOUGH_SAMPLES = 2
"""Samples that the archive should hold for each feature and parameter: with fewer, the test on evidence has
hardly any degree of freedom left, and the covariance never moves."""
_DEFAULT_SAMPLES = 5
"""The same that an archive has by default."""
_LARGEST = {"coef": 1e36, "cov_chol": checks.LARGEST}
"""The largest numbers of a first policy."""
_COARSE_REWARDS = 1e-3
"""Share of the rewards' spread from which on their rounding is worth a warning."""


class CrepsState(NamedTuple):
    """What the next step needs: all of it, so that a saved state resumes a run exactly."""

    policy: Any
    """A `LinearGaussian`, unless `creps` was given another kind of policy."""
    archive: Archive
    iteration: IntScalar
    """How many batches have been told."""
    history: Any = None
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
    """False where the policy was kept, to the bit: there were too few samples to fit one, or the rewards do
    not differ after the baseline."""
    p_value: Scalar
    """p-value of the test in `search.evidence`: the probability, from 0 to 1, of a dependence between
    weights and parameters at least this strong if there is none. The covariance moves only where it is
    below `significance`."""
    unsupported_loss: Scalar
    """Estimate of the entropy that this update took by chance, in nats: the loss of entropy times
    `3 p_value / significance` (twice the p-value without `significance`). Where rewards do not depend on the
    parameters its expectation is the whole loss; where the evidence is strong it is nearly zero. Its sum over
    a search warns of exploration that went without evidence: d parameters whose spread has fallen to exp(-x)
    by chance add up to about d x."""
    reward_rounding: Scalar
    """Rounding error of the rewards, in the precision in which they were told, as a share of their spread.
    From about 0.1 on little can be learned: tell rewards in float64, or without their common offset."""


@dataclasses.dataclass(frozen=True)
class Creps(Search):
    """Contextual REPS as a record of pure functions, see `Search`.

    They are the methods of `CrepsSettings`, which say more. Algorithms of equal settings share compiled
    programs, whatever their KL bounds, and the last one frees them. An algorithm whose features and M-step
    are data, as those of this library are, can be pickled.

    Attributes:
        mean: (policy or state, contexts (n, s)) -> thetas (n, d), the policy without its exploration.
    """

    mean: Callable[[Any, ArrayLike], Array]

    def __post_init__(self) -> None:
        """Check the functions."""
        super().__post_init__()
        checks.function("mean", self.mean, "(policy, contexts)")

    @functools.cached_property
    def settings(self) -> "CrepsSettings | None":
        """The settings that all functions are of; None where one of them is a user's own."""
        functions = (self.init, self.ask, self.tell, self.policy, self.mean)
        owners = [getattr(function, "__self__", None) for function in functions]
        is_one = all(owner is owners[0] for owner in owners)
        return owners[0] if is_one and isinstance(owners[0], CrepsSettings) else None

    @functools.cached_property
    def programs(self) -> dict[Any, Any]:
        """Compiled programs that are made of this algorithm, such as iterations."""
        return {} if self.settings is None else self.settings.programs.others

    @property
    def traced(self) -> Any:
        """The KL bound."""
        return np.float32(0) if self.settings is None else self.settings.kl_bound

    def with_traced(self, traced: Any) -> "Creps":
        """Return the algorithm with another KL bound; one with a function of a user's own has none."""
        if self.settings is None:
            return dataclasses.replace(self)
        return dataclasses.replace(self.settings, kl_bound=_checked_kl_bound(traced)).algorithm()

    def with_kl_bound(self, kl_bound: ScalarLike) -> "Creps":
        """Return the algorithm with another KL bound, for which nothing is compiled anew.

        An algorithm with a function of a user's own has no settings: it is returned as it is.

        Args:
            kl_bound: Largest relative entropy of one update, in nats.

        Raises:
            ValueError: If the bound is not a number above 0.
        """
        return self.with_traced(kl_bound)


@dataclasses.dataclass(frozen=True, eq=False)
class CrepsSettings(KeepsPrograms):
    """The settings of the algorithm as data, see `creps`, and the functions of `Creps` as methods."""

    kind: Policy
    baseline_features: FeatureMap
    kl_bound: ScalarLike
    archive_size: int | None
    importance: Importance | None
    significance: float | int | None

    def algorithm(self) -> Creps:
        """Return the functions."""
        # Now, while an algorithm that they may be shared with is alive: one that this one takes the place of.
        _ = self.programs
        return Creps(self.init, self.ask, self.tell, self.policy, self.mean)

    def init(self, policy: Any) -> CrepsState:
        """Begin with a policy and an empty archive, both in the precision of the policy.

        Args:
            policy: The first policy, a `LinearGaussian` unless `creps` was given another kind.

        Returns:
            The state.

        Raises:
            ValueError: If the policy does not fit the features, is not finite, or `cov_chol` is no Cholesky
                factor; or if the archive has fewer samples than the policy has features and parameters, or no
                more than there are baseline features.

        Warns:
            UserWarning: If the archive is too small for fits that can be trusted.
        """
        policy = self._checked_policy("policy", policy)
        if isinstance(policy, LinearGaussian):
            for field, values in policy._asdict().items():
                # Coefficients are multiplied by small features; squares are taken of the spread.
                checks.finite(f"policy.{field}", values, largest=_LARGEST[field])
        theta_dim = self._theta_dim(policy)
        archive_size = self._archive_size(theta_dim)
        archive = empty_archive(archive_size, self.kind.features.context_dim, theta_dim, _precision(policy))
        importance = self.importance
        history = None if importance is None else empty_history(policy, importance.num_policies)
        return CrepsState(policy, archive, jnp.zeros((), jnp.int32), history)

    def ask(self, key: PRNGKey, state: CrepsState, contexts: ArrayLike) -> Array:
        """Draw parameters from the policy.

        Args:
            key: Random key, of any implementation.
            state: The state.
            contexts: Contexts (n, s).

        Returns:
            Parameters theta (n, d).

        Raises:
            ValueError: If the state is of other features or of another archive size, or contexts or their
                features are not finite.
        """
        key, state = threefry(checks.key("key", key)), self._checked_state(state)
        contexts = self._checked_contexts(contexts, state.policy)
        return self._checked_thetas(contexts, *self.programs.ask(key, state.policy, contexts))

    def tell(self, state: CrepsState, batch: Batch) -> tuple[CrepsState, CrepsInfo]:
        """Archive a batch, and fit a new policy to the archive.

        A sample that holds NaN or infinity, such as a measurement that failed, or whose features do, takes
        its place in the archive and is then ignored. The policy is kept until the archive holds as many valid
        samples as the policy has features and parameters, p + d: fewer leave the covariance singular. It is
        also kept where rewards do not differ after the baseline. Only a small program, which puts the batch
        into the archive, is compiled anew for batches of another size.

        Args:
            state: The state.
            batch: Contexts (n, s), parameters (n, d) and rewards (n,). Rewards of NumPy in float64 keep their
                differences beside a large offset.

        Returns:
            The new state, and how the update went.

        Raises:
            ValueError: If shapes do not fit the features or the policy.

        Warns:
            UserWarning: If much of the difference of the rewards is lost in their rounding, or a batch has
                more samples than the archive.
        """
        state = self._checked_state(state)
        checked = _checked_batch(batch, state.archive)
        num, size = len(checked[0].reward), len(state.archive.batch.reward)
        if num > size:
            warnings.warn(
                f"archive_size should be at least {num}, the samples of a batch, got {size}: "
                "only the last of them are learned from",
                stacklevel=2,
            )
        archive = self.programs.push(state.archive, *checked)
        state = state._replace(archive=archive)
        return self.programs.update(self.kl_bound, state)

    def policy(self, state: CrepsState) -> Any:
        """Return the policy of a state."""
        return self._checked_state(state).policy

    def mean(self, policy: Any, contexts: ArrayLike) -> Array:
        """Return the parameters theta (n, d) of contexts (n, s) under a policy without its exploration.

        Args:
            policy: A policy, or a state: its policy.
            contexts: Contexts (n, s).

        Raises:
            ValueError: As `ask` does.
        """
        policy = policy.policy if isinstance(policy, CrepsState) else policy
        policy = self._checked_policy("policy", policy)
        contexts = self._checked_contexts(contexts, policy)
        return self._checked_thetas(contexts, *self.programs.mean(policy, contexts))

    @functools.cached_property
    def programs(self) -> "Programs":
        """The compiled programs of these settings."""
        settings = dataclasses.replace(self, kl_bound=np.float32(0))
        identity = tuple(getattr(settings, field.name) for field in dataclasses.fields(settings))
        try:
            found = _PROGRAMS.get(identity)
        except TypeError:  # a user's features that cannot be hashed: nothing to share
            return Programs(settings)
        if found is None:
            found = _PROGRAMS[identity] = Programs(settings)
        return found

    def _archive_size(self, theta_dim: int) -> int:
        """Return the size of the archive, after checking that it is not too small."""
        num_fitted, num_baseline = self.kind.features.size + theta_dim, self.baseline_features.size
        if self.archive_size is None:
            return _DEFAULT_SAMPLES * max(num_fitted, num_baseline)
        if self.archive_size < num_fitted:
            raise ValueError(
                f"archive_size must be at least {num_fitted}, features and parameters, "
                f"got {self.archive_size}"
            )
        if self.archive_size <= num_baseline:
            raise ValueError(
                f"archive_size must be at least {num_baseline + 1}, one more than baseline features, which "
                f"would explain all rewards, got {self.archive_size}"
            )
        enough = _ENOUGH_SAMPLES * max(num_fitted, num_baseline)
        if self.archive_size < enough:
            warnings.warn(
                f"archive_size should be at least {enough}, {_ENOUGH_SAMPLES} samples for each of "
                f"{self.kind.features.size} features and {theta_dim} parameters, or of {num_baseline} "
                f"baseline features, got {self.archive_size}: the policy will hardly move, or move by chance",
                stacklevel=3,
            )
        return self.archive_size

    def _checked_policy(self, name: str, policy: Any) -> Any:
        """Return a policy in one precision, after checking that it is one of this kind."""
        if self.kind.checked is not None:
            return self.kind.checked(name, policy, self.kind.features)
        leaves = jax.tree.leaves(policy)
        if not any(jnp.issubdtype(jnp.result_type(leaf), jnp.floating) for leaf in leaves):
            raise ValueError(f"{name} must be a pytree of arrays with floats, got {checks.shown(policy)}")
        for leaf in leaves:
            if jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
                checks.finite(name, checks.array(name, leaf))
        return jax.tree.map(jnp.asarray, policy)

    def _theta_dim(self, policy: Any) -> int:
        features = jnp.zeros((1, self.kind.features.size), _precision(policy))
        return jax.eval_shape(self.kind.mean, policy, features).shape[1]

    def _checked_contexts(self, contexts: ArrayLike, policy: Any) -> Array:
        shape = ("n", self.kind.features.context_dim)
        note = f" for features of {shape[1]} context variables"
        contexts = checks.array("contexts", contexts, shape, note=note)
        return checks.finite("contexts", checks.converted(contexts, _precision(policy)))

    def _checked_thetas(self, contexts: Array, thetas: Array, is_finite: Array) -> Array:
        if not isinstance(is_finite, Tracer) and not np.all(is_finite):
            context = np.asarray(contexts)[~np.asarray(is_finite)][0]
            features = np.asarray(self.kind.features.apply(jnp.asarray(context)))
            raise ValueError(
                f"policy_features.apply(context) must be finite, got {features} for context {context}"
            )
        return thetas

    def _checked_state(self, state: CrepsState) -> CrepsState:
        """Return a state after checking that it is one of this algorithm."""
        checks.instance("state", state, CrepsState)
        policy = self._checked_policy("state.policy", state.policy)
        checks.instance("state.archive", state.archive, Archive)
        context, theta, reward = state.archive.batch
        if self.archive_size is not None and jnp.shape(reward) != (self.archive_size,):
            raise ValueError(
                f"state.archive must have the {self.archive_size} slots of archive_size, "
                f"got {jnp.shape(reward)}"
            )
        checks.array("state.archive.batch.context", context, ("L", self.kind.features.context_dim))
        checks.array("state.archive.batch.theta", theta, ("L", self._theta_dim(policy)))
        expected = 0 if self.importance is None else self.importance.num_policies
        got = 0 if state.history is None else jnp.shape(jax.tree.leaves(state.history)[0])[0]
        if got != expected:
            raise ValueError(
                f"the state must hold the last {expected} policies, as `init` makes it, got {got}"
            )
        return state._replace(policy=policy)


class Programs:
    """Compiled programs of one algorithm; `others` holds those that are made of it, such as iterations."""

    def __init__(self, settings: CrepsSettings):
        """Compile nothing yet."""
        self.ask = jax.jit(partial(_ask, settings))
        self.push = jax.jit(push)
        self.update = jax.jit(partial(_update, settings))
        self.mean = jax.jit(partial(_mean, settings))
        self.others: dict[Any, Any] = {}


_PROGRAMS: weakref.WeakValueDictionary[tuple, Programs] = weakref.WeakValueDictionary()
"""The programs of all algorithms that are alive, by their settings."""


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
        baseline_features: Features phi(s) whose expectations over the contexts are kept; by default those of
            the policy.
        kl_bound: Largest relative entropy epsilon of one update, in nats. Another value compiles nothing
            anew. Inside `jit`, where it cannot be checked, a bound that is not above 0 keeps the policy.
        archive_size: Number L of the last samples that are learned from; by default five for each policy
            feature and parameter, or for each baseline feature if there are more of them. There should be
            two: `init` warns of fewer, and refuses less than one, or as few as could all be explained by the
            baseline.
        ridge: Penalty on the policy's coefficients, relative to the square of each feature's scale; 1e-4 by
            default.
        m_step: How the policy is fitted to the weighted samples: `weighted_ml`, the paper's and the default,
            goes wherever they lead; `bounded_ml()` bounds how far mean and covariance move in an update.
        importance: Weigh archived samples by how likely they are today over how likely they were when drawn
            (`Importance()`); by default all count equally, as in the paper. The weights are those of samples
            that were drawn by `ask`.
        significance: Largest p-value, above 0 and at most 1, at which the covariance still moves. It moves
            the fraction `1 - p_value / significance` of the way to the fitted one. None moves it all the way
            whatever the evidence, as in the paper, and loses the exploration to noise.

    Returns:
        The algorithm, with the functions `init`, `ask`, `tell`, `policy` and `mean`.

    Raises:
        ValueError: If a setting is out of its range, or the features are of different contexts.

    Source: Abdolmaleki et al. 2016, Section 3.1.
    """
    kl_bound = _checked_kl_bound(kl_bound)
    if significance is not None and not 0 < checks.number("significance", significance) <= 1:
        raise ValueError(f"significance must be above 0 and at most 1, or None, got {significance}")
    kind = _kind(policy_features, ridge, m_step)
    baseline_features = kind.features if baseline_features is None else baseline_features
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
    settings = CrepsSettings(
        kind=kind,
        baseline_features=baseline_features,
        kl_bound=kl_bound,
        archive_size=archive_size,
        importance=importance,
        significance=significance,
    )
    return settings.algorithm()


def _kind(given: FeatureMap | Policy, ridge: float | int | None, m_step: MStep | None) -> Policy:
    """Return the kind of policy, by default a Gaussian one with these settings of its fit."""
    if isinstance(given, Policy):
        if ridge is not None or m_step is not None:
            raise ValueError(f"ridge and m_step must be None for a Policy, got {ridge} and {m_step}")
        checks.instance("policy_features.features", given.features, FeatureMap)
        for name in ("mean", "sample", "log_prob", "kl", "entropy", "fit"):
            checks.function(f"policy_features.{name}", getattr(given, name), "see Policy")
        return given
    m_step = weighted_ml if m_step is None else m_step
    if m_step is bounded_ml:
        raise ValueError(
            "m_step must be an M-step, such as bounded_ml(), got bounded_ml without its parentheses"
        )
    return linear_gaussian(given, m_step=m_step, ridge=1e-4 if ridge is None else ridge)


def _ask(
    settings: CrepsSettings, key: PRNGKey, policy: Any, contexts: Array
) -> tuple[Float[Array, "n d"], Bool[Array, " n"]]:
    """Draw parameters, and tell where features are finite."""
    features = _features_of("policy_features", settings.kind.features, contexts)
    return settings.kind.sample(key, policy, features), _are_finite(features)


def _mean(
    settings: CrepsSettings, policy: Any, contexts: Array
) -> tuple[Float[Array, "n d"], Bool[Array, " n"]]:
    features = _features_of("policy_features", settings.kind.features, contexts)
    return settings.kind.mean(policy, features), _are_finite(features)


class _Samples(NamedTuple):
    """The archive as an update sees it; what does not count is zero."""

    features: Array
    baseline: Array
    theta: Array
    reward: Array
    reward_resolution: Array
    prior: Array
    is_valid: Array


def _update(settings: CrepsSettings, kl_bound: ScalarLike, state: CrepsState) -> tuple[CrepsState, CrepsInfo]:
    """Fit a new policy to the archive."""
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
    is_updated = _is_usable(kind, fitted) & (num_valid >= num_fitted) & dual.is_informative
    policy = jax.tree.map(lambda new, old: jnp.where(is_updated, new, old), fitted, old)
    entropy = kind.entropy(policy)
    loss = jnp.maximum(kind.entropy(old) - entropy, 0.0)
    spread = jnp.max(jnp.abs(reward))
    info = CrepsInfo(
        dual=dual,
        kl=sample_kl(weights, prior),
        policy_kl=jnp.where(is_updated, _mean_over(kind.kl(policy, old, features), is_valid), 0.0),
        effective_samples=_effective_samples(weights),
        prior_effective_samples=_effective_samples(prior),
        entropy=entropy,
        num_valid=num_valid,
        is_updated=is_updated,
        p_value=p_value,
        unsupported_loss=_share_by_chance(p_value, settings.significance) * loss,
        reward_rounding=jnp.minimum(resolution / jnp.where(spread > 0, spread, 1.0), 1.0),
    )
    return CrepsState(policy, state.archive, state.iteration + 1, history), info


def _share_by_chance(p_value: Scalar, significance: float | int | None) -> Scalar:
    """Return the factor that makes the loss of an update an unbiased estimate of what went by chance.

    By chance p-values are uniform. Without a significance E[2 p] = 1; with one the covariance moves in
    proportion to 1 - u, where u = p / significance, and E[3 u (1 - u)] = E[1 - u].
    """
    return 2.0 * p_value if significance is None else 3.0 * jnp.minimum(p_value / significance, 1.0)


def _samples(settings: CrepsSettings, state: CrepsState) -> tuple[_Samples, Any]:
    """Return what an update is made from, and the history with the policy of this iteration."""
    archive = state.archive
    context, theta, _ = archive.batch
    features = _features_of("policy_features", settings.kind.features, context)
    baseline = _features_of("baseline_features", settings.baseline_features, context)
    is_valid = archive.is_valid & _are_finite(features) & _are_finite(baseline)
    if settings.importance is not None:
        is_valid = is_valid & (archive.age < settings.importance.num_policies)
    archive = archive._replace(is_valid=is_valid)
    # What is left out must not enter: 0 * nan is not 0.
    features, theta, baseline = (jnp.where(is_valid[:, None], x, 0.0) for x in (features, theta, baseline))
    prior, history = _prior(settings, state, archive, features)
    reward, resolution = centred_reward(archive)
    return _Samples(features, baseline, theta, reward, resolution, prior, is_valid), history


def _prior(
    settings: CrepsSettings, state: CrepsState, archive: Archive, features: Array
) -> tuple[Array, Any]:
    """Return how much each sample counts before rewards are looked at, and the history with this policy."""
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


def _is_usable(kind: Policy, policy: Any) -> Bool[Array, ""]:
    # The entropy of a Gaussian whose spread is not positive is none.
    leaves = [*jax.tree.leaves(policy), kind.entropy(policy)]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))


def _mean_over(values: Array, is_valid: Array) -> Scalar:
    count = jnp.maximum(jnp.sum(is_valid, dtype=values.dtype), 1.0)
    return jnp.sum(values, where=is_valid) / count


def _precision(policy: Any) -> Any:
    """Return the precision of a policy's arrays."""
    leaves = [jnp.result_type(leaf) for leaf in jax.tree.leaves(policy)]
    return jnp.result_type(*(dtype for dtype in leaves if jnp.issubdtype(dtype, jnp.floating)))


def _effective_samples(weights: Array) -> Scalar:
    squares = jnp.sum(weights**2)
    return jnp.sum(weights) ** 2 / jnp.where(squares > 0, squares, 1.0)


def _features_of(name: str, features: FeatureMap, contexts: Array) -> Array:
    def apply(context: Array) -> Array:
        values = checks.array(f"{name}.apply(context)", features.apply(context), (features.size,))
        return checks.converted(values, contexts.dtype)

    return jax.vmap(apply)(contexts)


def _are_finite(rows: Array) -> Bool[Array, " n"]:
    return jnp.all(jnp.isfinite(rows), axis=1)


def _checked_batch(batch: Batch, archive: Archive) -> tuple[Batch, Array | np.ndarray, np.float32]:
    """Return a batch in the precision of the archive, the rest of more precise rewards, and how precise."""
    checks.instance("batch", batch, Batch)
    reward = checks.host_array("batch.reward", batch.reward, ("n",))
    dtype = archive.batch.theta.dtype
    num, context_dim = reward.shape[0], archive.batch.context.shape[1]
    theta_dim, note = archive.batch.theta.shape[1], f" beside batch.reward {reward.shape}"
    context = checks.host_array("batch.context", batch.context, (num, context_dim), note=note)
    theta = checks.host_array("batch.theta", batch.theta, (num, theta_dim), note=note)
    told = max(reward.dtype, _float_dtype(batch.reward, reward.dtype), key=lambda kind: jnp.finfo(kind).eps)
    eps = jnp.finfo(told).eps
    _warn_of_coarse_rewards(reward, told)
    reward, rest = split_reward(reward, dtype)
    # NumPy goes to the compiled program as it is: jax would not let NaN pass where it looks out for it.
    return Batch(*(checks.converted(each, dtype) for each in (context, theta, reward))), rest, np.float32(eps)


def _float_dtype(values: Any, otherwise: Any) -> Any:
    """Return the format of an array of floats, or another one for what is no such array."""
    dtype = getattr(values, "dtype", otherwise)
    return dtype if jnp.issubdtype(dtype, jnp.floating) else otherwise


def _warn_of_coarse_rewards(reward: Array | np.ndarray, told: Any) -> None:
    """Warn where rounding to the format they were told in takes much of the differences of rewards.

    It is not known where they are traced.
    """
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


def _checked_kl_bound(kl_bound: ScalarLike) -> ScalarLike:
    """Return a bound of one type, whatever kind of number it was: for another type jax compiles anew."""
    checks.number("kl_bound", kl_bound, above=0.0)
    return kl_bound if isinstance(kl_bound, Tracer) else np.float32(kl_bound)


def _check_features(name: str, features: FeatureMap) -> None:
    checks.function(f"{name}.apply", features.apply, "(context) -> features")
    size = checks.count(f"{name}.size", features.size)
    checks.count(f"{name}.context_dim", features.context_dim)
    if features.scale is not None:
        scale = checks.vector(f"{name}.scale", features.scale)
        if scale.shape != (size,) or not np.all(scale > 0):
            raise ValueError(f"{name}.scale must be {size} numbers above 0, got {features.scale}")
