"""Tasks, their outcomes, and wrappers from task to task.

A task is independent of the search: it samples contexts and maps (key, context, theta) to an outcome. All
functions are for one rollout; the caller vmaps them.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax import checks
from creps_jax.policies import space
from creps_jax.policies.space import Space
from creps_jax.programs import KeepsPrograms
from creps_jax.typing import Array, Float, PRNGKey, VectorLike

__all__ = [
    "Outcome",
    "PlainOutcome",
    "Task",
    "average_repeats",
    "penalised",
    "sigmoid_constrained",
]


@runtime_checkable
class Outcome(Protocol):
    """The result of a rollout: a NamedTuple of arrays with at least these two fields.

    The NamedTuple of a task may have more fields, such as a speed or whether the robot fell. Wrappers and the
    training loop keep them.
    """

    @property
    def reward(self) -> Float[Array, "*b"]:
        """The reward to maximise."""
        ...

    @property
    def violation(self) -> Float[Array, "*b c"]:
        """Violation of each of c constraints on theta: 0 if it holds, else positive; c may be 0."""
        ...

    def _replace(self, **fields: Any) -> Any: ...


class PlainOutcome(NamedTuple):
    """The outcome of a task without further fields."""

    reward: Float[Array, ""]
    violation: Float[Array, " c"]


@dataclasses.dataclass(frozen=True)
class Task(KeepsPrograms):
    """A contextual task: a record of pure functions. It is hashable, and never traced.

    Attributes:
        sample_context: (key) -> context (s,).
        rollout: (key, context (s,), theta (d,)) -> outcome of one rollout, or only its reward.
        context_dim: Number s of context variables.
        theta_dim: Number d of parameters.
        worst_reward: The finite reward that replaces one that is not finite.
        contexts: Names, units and ranges of the context variables, for `learned`; None if not stated.
        parameters: Names, units and bounds of the parameters, for `learned`; None if not stated.

    Raises:
        ValueError: If a field is not of its kind.
    """

    sample_context: Callable[[PRNGKey], Array]
    rollout: Callable[[PRNGKey, Array, Array], Any]
    context_dim: int
    theta_dim: int
    worst_reward: float | int
    contexts: Space | None = None
    parameters: Space | None = None

    def __post_init__(self) -> None:
        """Check the fields."""
        checks.function("sample_context", self.sample_context, "(key) -> context")
        checks.function("rollout", self.rollout, "(key, context, theta) -> outcome")
        checks.count("context_dim", self.context_dim)
        checks.count("theta_dim", self.theta_dim)
        # A plain number: programs are compiled for a hashable task.
        object.__setattr__(self, "worst_reward", checks.number("worst_reward", self.worst_reward))
        for name, size in (("contexts", self.context_dim), ("parameters", self.theta_dim)):
            stated = getattr(self, name)
            if stated is not None and (not isinstance(stated, Space) or stated.size != size):
                raise ValueError(f"{name} must be a Space of {size} variables, got {checks.shown(stated)}")

    @functools.cached_property
    def programs(self) -> dict[Any, Any]:
        """Compiled programs of this task, freed with it."""
        return {}


def check_outcome(outcome: Any) -> Any:
    """Return the result of a rollout after checking that it is an outcome of arrays with one reward.

    A bare reward becomes a `PlainOutcome`.

    Raises:
        ValueError: If the result is neither an outcome nor a reward.
    """
    if not isinstance(outcome, Outcome):
        is_number = isinstance(outcome, jax.Array | np.ndarray | np.number | float | int)
        if not is_number or isinstance(outcome, bool):
            raise ValueError(
                "a rollout must return a reward, or an Outcome, a NamedTuple with reward and violation such "
                f"as PlainOutcome, got {checks.shown(outcome)}"
            )
        reward = checks.array("the reward of a rollout", outcome, ())
        return PlainOutcome(reward, jnp.zeros(0, reward.dtype))
    checks.array("the reward of a rollout", outcome.reward, ())
    for leaf in jax.tree.leaves(outcome):
        checks.array("each field of a rollout's outcome", leaf)
    return outcome


@checks.arguments
def average_repeats(task: Task, repeats: int) -> Task:
    """Average every rollout over repeats with different keys (Abdolmaleki et al. 2016, 4.3.1).

    Args:
        task: The task to repeat.
        repeats: Number of repeats of a rollout, at least 1.

    Returns:
        A task whose outcome is the mean of each field over the repeats. Booleans become a fraction, and
        integers a mean, both floats. If one repeat is not finite, neither is the mean.

    Raises:
        ValueError: If `repeats` is below 1.
    """

    def rollout(key: PRNGKey, context: Array, theta: Array) -> Any:
        keys = jax.random.split(checks.key("key", key), repeats)
        single = lambda *arguments: check_outcome(task.rollout(*arguments))  # noqa: E731
        outcomes = jax.vmap(single, in_axes=(0, None, None))(keys, context, theta)
        return jax.tree.map(_mean_of_repeats, outcomes)

    return dataclasses.replace(task, rollout=rollout)


@checks.arguments
def sigmoid_constrained(task: Task, low: VectorLike, high: VectorLike) -> Task:
    """Map a free theta into [low, high] by a sigmoid (Abdolmaleki et al. 2016, Eq. 17).

    Args:
        task: A task whose theta has bounds.
        low: Lower bounds (d,), in the units of the task's theta.
        high: Upper bounds (d,).

    Returns:
        A task of the same size whose theta may be any vector of real numbers.

    Raises:
        ValueError: If the bounds do not fit the task or each other.
    """
    low, high = _checked_bounds(task, low, high)

    def rollout(key: PRNGKey, context: Array, theta: Array) -> Any:
        return task.rollout(key, context, space.sigmoid_gate(theta, low, high))

    parameters = _bounded(task.parameters, low, high, "sigmoid")
    return dataclasses.replace(task, rollout=rollout, parameters=parameters)


@checks.arguments
def penalised(task: Task, low: VectorLike, high: VectorLike, penalty: float | int) -> Task:
    """Subtract a penalty if theta is outside [low, high] (the 1_p of Abdolmaleki et al. 2016, Eq. 18).

    The rollout gets theta clipped to the bounds, so that a meaningless parameter, such as a negative
    duration, never reaches the task.

    Args:
        task: A task whose theta has bounds.
        low: Lower bounds (d,), in the units of the task's theta.
        high: Upper bounds (d,).
        penalty: Subtracted from the reward if any bound is violated, regardless of the amount.

    Returns:
        A task of the same size whose outcome holds the violation of each bound, and whose worst reward
        includes the penalty.

    Raises:
        ValueError: If the bounds do not fit the task or each other, or the penalty is negative.
    """
    low, high = _checked_bounds(task, low, high, largest=math.inf)
    checks.number("penalty", penalty, least=0.0)

    def rollout(key: PRNGKey, context: Array, theta: Array) -> Any:
        violation = space.violation(theta, low, high)
        outcome = check_outcome(task.rollout(key, context, jnp.clip(jnp.asarray(theta), low, high)))
        reward = outcome.reward - space.penalty(violation, penalty)  # Eq. 18
        return outcome._replace(reward=reward, violation=violation)

    worst_reward, parameters = task.worst_reward - penalty, _bounded(task.parameters, low, high, "clip")
    return dataclasses.replace(task, rollout=rollout, worst_reward=worst_reward, parameters=parameters)


def _bounded(parameters: Space | None, low: np.ndarray, high: np.ndarray, constraint: str) -> Space | None:
    if parameters is None:
        return None
    return dataclasses.replace(
        parameters, low=tuple(low.tolist()), high=tuple(high.tolist()), constraint=constraint
    )


def _mean_of_repeats(field: Array) -> Array:
    is_float = jnp.issubdtype(field.dtype, jnp.floating)
    return jnp.mean(field if is_float else field.astype(jnp.float32), axis=0)


def _checked_bounds(
    task: Task, low: VectorLike, high: VectorLike, *, largest: float = checks.FLOAT32_MAX
) -> tuple[np.ndarray, np.ndarray]:
    low, high = (
        checks.vector(name, end, largest=largest).astype(np.float32)
        for name, end in (("low", low), ("high", high))
    )
    shape = (task.theta_dim,)
    if not {low.shape, high.shape} <= {(), shape}:
        raise ValueError(
            f"low and high must be numbers or one for each of the task's {task.theta_dim} parameters, "
            f"got shapes {low.shape} and {high.shape}"
        )
    if not np.all(low <= high):
        raise ValueError(f"low must not exceed high, got {low} and {high}")
    return np.broadcast_to(low, shape), np.broadcast_to(high, shape)
