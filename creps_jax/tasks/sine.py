"""The smallest task: one parameter, whose optimum is the sine of one context."""

import math

import jax.numpy as jnp

from creps_jax import checks
from creps_jax.contexts import gaussian_contexts
from creps_jax.policies.space import Space
from creps_jax.tasks.base import PlainOutcome, Task
from creps_jax.typing import Array, Float, PRNGKey

__all__ = ["sinus"]


@checks.arguments
def sinus(low: float = 0.0, high: float = 5 * math.pi) -> Task:
    """Make the sine task: the optimum is theta = sin(context), the reward -(theta - sin s)^2.

    The paper's figure gives the range of contexts as "[0.05PI]", in which a character is missing. With the
    range 0 to 5 pi a linear policy fails, as the paper reports; from 0 to pi / 2 the sine is almost straight,
    and a linear policy suffices.

    Args:
        low: Lower end of the contexts, in radians.
        high: Upper end of the contexts, in radians.

    Returns:
        A task with one context, Gaussian over the range, and one parameter.

    Raises:
        ValueError: If `low` is not below `high`, or one of them is not a number.

    Source: Abdolmaleki et al. 2016, Section 4.1 and Fig. 5 (the reward is printed without its minus).
    """

    @checks.arguments
    def rollout(key: PRNGKey, context: Float[Array, " 1"], theta: Float[Array, " 1"]) -> PlainOutcome:
        del key  # The task has no noise.
        reward = -jnp.square(theta[0] - jnp.sin(context[0]))
        return PlainOutcome(reward=reward, violation=jnp.zeros(0))

    return Task(
        sample_context=gaussian_contexts(low, high, clip=True),
        rollout=rollout,
        context_dim=1,
        theta_dim=1,
        worst_reward=-100.0,
        contexts=Space(("angle",), (low,), (high,), ("rad",)),
        parameters=Space.unbounded(("sine",)),
    )
