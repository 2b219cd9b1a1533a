"""What a task is, and wrappers from task to task.

A task knows nothing of learning: it draws contexts and turns (key, context, theta) into an
outcome. Everything is written for one rollout; the caller vmaps.
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
    """What a rollout brings back: a NamedTuple of arrays with at least these two fields.

    A task returns a NamedTuple of its own and may add fields (speed, whether the robot fell);
    wrappers and the training loop carry them along.
    """

    @property
    def reward(self) -> Float[Array, "*b"]:
        """The reward to maximise."""
        ...

    @property
    def violation(self) -> Float[Array, "*b c"]:
        """How far each constraint on theta is violated, zero where it holds; c is 0 without any."""
        ...

    def _replace(self, **fields: Any) -> Any: ...


class PlainOutcome(NamedTuple):
    """The outcome of a task that has nothing to add."""

    reward: Float[Array, ""]
    violation: Float[Array, " c"]


@dataclasses.dataclass(frozen=True)
class Task(KeepsPrograms):
    """A contextual task: a record of pure functions, closed over and never traced.

    Attributes:
        sample_context: (key) -> context (s,).
        rollout: (key, context (s,), theta (d,)) -> outcome of one rollout, or its reward alone.
        context_dim: Number s of context variables.
        theta_dim: Number d of parameters.
        worst_reward: The finite reward put in place of one that is not finite.
        contexts: Names, units and ranges of the context variables, for `learned`; None if not stated.
        parameters: Names, units and bounds of the parameters, for `learned`; None if not stated.
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
        # An array could not be compiled for.
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
    """Return what a rollout gave, after checking that it is an outcome of arrays with one reward.

    A bare reward becomes a `PlainOutcome`.

    Raises:
        ValueError: If it is neither.
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
    """Average every rollout over repeats with keys of their own (Abdolmaleki et al. 2016, 4.3.1).

    Args:
        task: The task to repeat.
        repeats: How often a rollout is repeated, at least 1.

    Returns:
        A task whose outcome is the mean of each field over the repeats; booleans and integers
        become the float fraction or mean. One repeat that is not finite makes the mean so.

    Raises:
        ValueError: If repeats < 1.
    """

    def rollout(key: PRNGKey, context: Array, theta: Array) -> Any:
        keys = jax.random.split(checks.key("key", key), repeats)
        single = lambda *arguments: check_outcome(task.rollout(*arguments))  # noqa: E731
        outcomes = jax.vmap(single, in_axes=(0, None, None))(keys, context, theta)
        return jax.tree.map(_mean_of_repeats, outcomes)

    return dataclasses.replace(task, rollout=rollout)


@checks.arguments
def sigmoid_constrained(task: Task, low: VectorLike, high: VectorLike) -> Task:
    """Let theta be free and squash it into [low, high] (Abdolmaleki et al. 2016, Eq. 17).

    Args:
        task: A task whose theta has bounds.
        low: Lower bounds (d,), in the units of the task's theta.
        high: Upper bounds (d,).

    Returns:
        A task of the same size whose theta is any vector of real numbers.

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
    """Charge a penalty where theta leaves [low, high] (the 1_p of Abdolmaleki et al. 2016, Eq. 18).

    The rollout itself is run at theta clipped to the box, so that a parameter without a
    meaning (a negative duration) never reaches the task.

    Args:
        task: A task whose theta has bounds.
        low: Lower bounds (d,), in the units of the task's theta.
        high: Upper bounds (d,).
        penalty: Taken from the reward if any bound is violated, by however little.

    Returns:
        A task of the same size whose outcome carries the violation of each bound, and whose
        worst reward includes the penalty.

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
    low, high = tuple(low.tolist()), tuple(high.tolist())
    return dataclasses.replace(parameters, low=low, high=high, constraint=constraint)


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
