"""Learn from the trials of a session: equal settings and results give the same policy.

With the same software and set-up they are equal to the bit, otherwise up to rounding.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax.contexts import context_grid
from creps_jax.errors import UserError
from creps_jax.policies import gaussian
from creps_jax.policies.bounds import SIGMOID
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.policies.learned import Learned
from creps_jax.search.archive import Batch
from creps_jax.search.creps import Creps, CrepsState, creps
from creps_jax.search.fit import fit_within
from creps_jax.tools.session.plain import shortest
from creps_jax.tools.session.settings import Context, Settings, ends
from creps_jax.tools.session.start import complete, feature_map, first_policy, space_of
from creps_jax.tools.session.trials import Trial

_GRID = 1000
"""Approximate number of contexts at which policies are compared."""


class Update(NamedTuple):
    """The change of the policy by a batch."""

    policy: LinearGaussian
    kl: float
    """KL(policy || the one before) in nats, the mean over the contexts in the archive."""
    kl_from_first: float
    """KL(policy || first policy) in nats, the mean over a grid of contexts."""
    entropy: float
    """Of the distribution of free parameters, in nats."""
    effective_samples: float
    num_valid: int
    """Number of valid trials that it learned from."""
    is_updated: bool
    """False if the policy was kept: there were too few valid trials, or rewards did not differ."""
    is_informative: bool
    """Whether rewards differ by more than the context explains."""
    p_value: float
    """Probability that chance alone relates rewards to parameters as strongly, see `CrepsInfo`."""
    unsupported_loss: float
    """Entropy that this update lost by chance, in nats."""


class Learner:
    """The search of a session and its updates, a pure function of settings and trials.

    Raises:
        UserError: if the search refuses the settings.
    """

    def __init__(self, settings: Settings):
        self.settings = complete(settings)
        self.first = first_policy(self.settings)
        self._programs = _programs(self.settings)
        self._restart()

    @property
    def policy(self) -> LinearGaussian:
        """The current policy."""
        return self._state.policy

    def learn(self, batches: Sequence[Sequence[Trial]]) -> None:
        """Learn from these batches; only those that are new since the last call take time."""
        if self._batches != list(batches[: len(self._batches)]):
            self._restart()
        for batch in batches[len(self._batches) :]:
            self._state, info = self._programs.tell(self._state, _as_batch(batch))
            policy = jax.tree.map(np.asarray, self._state.policy)
            self.updates.append(
                Update(
                    policy=policy,
                    kl=float(info.policy_kl),
                    kl_from_first=float(self._programs.distance(policy, self.first)),
                    entropy=float(info.entropy),
                    effective_samples=float(info.effective_samples),
                    num_valid=int(info.num_valid),
                    is_updated=bool(info.is_updated),
                    is_informative=bool(info.dual.is_informative),
                    p_value=float(info.p_value),
                    unsupported_loss=float(info.unsupported_loss),
                )
            )
            self._batches.append(list(batch))

    def propose(self, trial_id: int, context: Sequence[float] | None = None) -> Trial:
        """Draw the parameters of a trial, and its context unless one is given."""
        settings = self.settings
        if context is None:
            rng = np.random.default_rng([settings.seed, trial_id])
            context = _within(shortest(rng.uniform(*ends(settings.contexts))), settings.contexts)
        theta, parameters = self._programs.propose(
            np.uint32(settings.seed), np.uint32(trial_id), self._state, np.asarray(context, np.float32)
        )
        parameters = _within(shortest(parameters), settings.parameters)
        return Trial(
            id=trial_id,
            context=dict(zip(settings.context_names, context, strict=True)),
            parameters=dict(zip(settings.parameter_names, parameters, strict=True)),
            theta=tuple(shortest(theta)),
        )

    @property
    def contexts(self) -> np.ndarray:
        """The contexts (n, s) at which policies are compared."""
        return np.asarray(self._programs.grid)

    def mean_parameters(self, policy: LinearGaussian) -> np.ndarray:
        """Return a policy's mean parameters (n, d) at these contexts."""
        return np.asarray(self._programs.means(policy))

    def learned(self) -> Learned:
        """Return the current policy for other tools."""
        settings = self.settings
        return Learned(
            self.policy,
            feature_map(settings),
            space_of(settings.contexts),
            space_of(settings.parameters, settings.constraint),
            settings.task,
        )

    def _restart(self) -> None:
        try:
            self._state: CrepsState = self._programs.algorithm.init(self.first)
        except ValueError as error:
            raise UserError(str(error)) from error
        self.updates: list[Update] = []
        self._batches: list[list[Trial]] = []


class _Programs(NamedTuple):
    """Programs that are compiled once for all sessions of the same settings."""

    algorithm: Creps
    tell: Callable[..., Any]
    propose: Callable[..., tuple[jax.Array, jax.Array]]
    """(seed, trial, state, context (s,)) -> theta (d,) and parameters (d,)"""
    grid: jax.Array
    means: Callable[[LinearGaussian], jax.Array]
    distance: Callable[[LinearGaussian, LinearGaussian], jax.Array]


@functools.lru_cache(maxsize=8)
def _programs(settings: Settings) -> _Programs:
    features = feature_map(settings)
    num_contexts = len(settings.contexts)
    low, high = ends(settings.contexts)
    baseline = settings.features.make_baseline(low, high)
    try:
        algorithm = creps(
            features,
            baseline,
            kl_bound=settings.kl_bound,
            archive_size=settings.archive_size or 0,
            m_step=fit_within(settings.mean_kl_bound, settings.cov_kl_bound),
        )
        grid = context_grid(low, high, round(_GRID ** (1 / num_contexts)))
    except ValueError as error:
        raise UserError(str(error)) from error
    inside = space_of(settings.parameters, settings.constraint).inside

    def propose(seed: jax.Array, trial: jax.Array, state: CrepsState, context: jax.Array) -> tuple:
        key = jax.random.fold_in(jax.random.key(seed), trial)
        theta = algorithm.ask(key, state, context[None])[0]
        parameters = inside(theta)
        # The part that clipping cuts off was not tried: the search learns from the clipped numbers.
        return (theta if settings.constraint == SIGMOID else parameters), parameters

    def distance(policy: LinearGaussian, reference: LinearGaussian) -> jax.Array:
        rows = jax.vmap(features.apply)(grid)
        return jnp.mean(jax.vmap(gaussian.kl, (None, None, 0))(policy, reference, rows))

    return _Programs(
        algorithm=algorithm,
        tell=algorithm.tell,
        propose=jax.jit(propose),
        grid=grid,
        means=jax.jit(lambda policy: inside(algorithm.mean(policy, grid))),
        distance=jax.jit(distance),
    )


def _within(values: Sequence[float], variables: Sequence[Context]) -> list[float]:
    """Move numbers that rounding has put outside of the ranges back into them."""
    return [min(max(value, each.low), each.high) for value, each in zip(values, variables, strict=True)]


def _as_batch(trials: Sequence[Trial]) -> Batch:
    rewards = [math.nan if trial.reward is None else trial.reward for trial in trials]
    columns = (
        [list(trial.context.values()) for trial in trials],
        [trial.theta for trial in trials],
        rewards,
    )
    # In float64 rewards with a large offset keep their differences.
    wide: Any = [np.array(column, np.float64) for column in columns]
    return Batch(*wide)
