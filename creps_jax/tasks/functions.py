"""Test functions of optimisation, to be minimised, and a task in which the context moves the minimum."""

import math
from collections.abc import Callable

import jax.numpy as jnp

from creps_jax import checks
from creps_jax.contexts import uniform_contexts
from creps_jax.tasks.base import PlainOutcome, Task
from creps_jax.typing import Array, Float, PRNGKey, Scalar

__all__ = ["ackley", "contextual_function", "ellipsoid", "rastrigin", "rosenbrock", "sphere"]


@checks.arguments
def contextual_function(
    function: Callable[[Float[Array, " d"]], Scalar],
    transform: Float[Array, "d s"],
    *,
    low: float = 1.0,
    high: float = 2.0,
) -> Task:
    """Make the task of minimising a function whose minimum is moved by a linear function of the context.

    The reward is `-function(theta + transform @ context)`: the optimal policy is affine in the context for
    any function. The usual benchmark has 20 parameters, two contexts and 50 samples an iteration, draws the
    entries of `transform` and of the first mean from N(0, 1), and starts with the covariance I.

    Args:
        function: The function of d parameters to minimise.
        transform: Displacement of each parameter per unit of each context variable.
        low: Lower end of the range of each context variable.
        high: Upper end of that range.

    Returns:
        The task, with uniform contexts and without noise.

    Raises:
        ValueError: If `transform` is not a finite matrix, or the range is not in order.

    Source: Abdolmaleki et al. 2017, Contextual covariance matrix adaptation evolutionary strategies,
    Section 4.1.
    """
    checks.function("function", function, "(x) -> number")
    checks.finite("transform", transform)
    theta_dim, context_dim = transform.shape

    def rollout(key: PRNGKey, context: Float[Array, " s"], theta: Float[Array, " d"]) -> PlainOutcome:
        del key
        context = checks.array("context", context, (context_dim,))
        theta = checks.array("theta", theta, (theta_dim,))
        moved = theta + jnp.sum(jnp.asarray(transform, theta.dtype) * context[None], axis=1)
        return PlainOutcome(-function(moved), jnp.zeros(0, theta.dtype))

    sample_context = uniform_contexts((low,) * context_dim, (high,) * context_dim)
    return Task(sample_context, rollout, context_dim, theta_dim, worst_reward=-1e30)


@checks.arguments
def sphere(x: Float[Array, " d"]) -> Scalar:
    """Return the sum of squares; the minimum is 0 at x = 0."""
    return jnp.sum(x**2)


@checks.arguments
def ellipsoid(x: Float[Array, " d"]) -> Scalar:
    """Return a sum of squares with weights from 1 to 1e6, ill-conditioned; the minimum is 0 at x = 0."""
    return jnp.sum(10.0 ** jnp.linspace(0.0, 6.0, x.size, dtype=x.dtype) * x**2)


@checks.arguments
def rosenbrock(x: Float[Array, " d"]) -> Scalar:
    """Return Rosenbrock's function of two or more variables, a curved valley; the minimum is 0 at x = 1."""
    return jnp.sum(100.0 * (x[1:] - x[:-1] ** 2) ** 2 + (1.0 - x[:-1]) ** 2)


@checks.arguments
def rastrigin(x: Float[Array, " d"]) -> Scalar:
    """Return Rastrigin's function, a sphere with many local minima; the global minimum is 0 at x = 0."""
    return jnp.sum(x**2 + 10.0 * (1.0 - jnp.cos(2.0 * math.pi * x)))


@checks.arguments
def ackley(x: Float[Array, " d"]) -> Scalar:
    """Return Ackley's function, nearly flat with many local minima; the global minimum is 0 at x = 0."""
    root_mean_square = jnp.sqrt(jnp.mean(x**2))
    mean_cosine = jnp.mean(jnp.cos(2.0 * math.pi * x))
    return 20.0 * (1.0 - jnp.exp(-0.2 * root_mean_square)) + math.e - jnp.exp(mean_cosine)
