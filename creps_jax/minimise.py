"""Minimise a smooth convex function of a few variables: the one minimiser of the library."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax.typing import Array, Bool, Float, Int, Scalar, ScalarLike

__all__ = ["Minimum", "minimise"]

_NUM_TRIALS = 6
"""Step lengths tried at once: 1, 1/4, ..., 1/1024 of the Newton step."""
_FLAT = 8.0
"""Least curvature of an axis, as a share of the largest, in units of the rounding of the format."""


class Minimum(NamedTuple):
    """Where a minimisation ended, and how."""

    point: Float[Array, " k"]
    value: Float[Array, ""]
    grad_norm: Float[Array, ""]
    num_steps: Int[Array, ""]
    is_converged: Bool[Array, ""]
    """Whether the norm of the gradient came below the tolerance."""


class _Search(NamedTuple):
    point: Array
    value: Array
    grad: Array
    num_steps: Array
    is_stalled: Array


def minimise(
    function: Callable[[Float[Array, " k"]], Scalar],
    start: Float[Array, " k"],
    *,
    max_steps: int = 50,
    tolerance: ScalarLike | None = None,
    max_change: ScalarLike | Float[Array, " k"] = 1e3,
) -> Minimum:
    """Minimise a convex function by damped Newton steps with `jax.grad` and `jax.hessian`.

    The Hessian may be singular (the function may be flat along some directions) and, away from the minimum,
    even indefinite (a convex function of x is not convex in log x): steps use the absolute values of its
    eigenvalues. The step length is the longest of a fixed ladder that is as good as the best of it. Near the
    minimum, where values no longer differ in the floating-point format, the slope decides.

    Args:
        function: What to minimise; scaled such that values and gradients of order one matter.
        start: First point, where the function has to be finite.
        max_steps: Largest number of Newton steps.
        tolerance: Norm of the gradient at which the search ends; by default 9e-7 in float32 and 2e-14 in
            float64.
        max_change: Largest change of each variable in a step along one axis: how far the quadratic model of
            the function may be trusted.

    Returns:
        The last point, which beyond rounding is never worse than the start. The search also ends, without
        convergence, when rounding allows no further progress.

    Raises:
        ValueError: If `start` is not a vector or `max_steps` is below 1.
    """
    if start.ndim != 1 or start.size == 0:
        raise ValueError(f"minimise needs a start of shape (k,), k >= 1, got shape {start.shape}")
    if max_steps < 1:
        raise ValueError(f"minimise needs max_steps >= 1, got {max_steps}")
    if tolerance is None:
        tolerance = float(jnp.finfo(start.dtype).eps) ** (7 / 8)
    limits = jnp.broadcast_to(jnp.asarray(max_change, start.dtype), start.shape)
    value_and_grad = jax.value_and_grad(function)
    hessian = jax.hessian(function)

    def is_running(search: _Search) -> Array:
        is_open = jnp.linalg.norm(search.grad) > tolerance
        return is_open & ~search.is_stalled & (search.num_steps < max_steps)

    def advance(search: _Search) -> _Search:
        step = _newton_step(search.grad, hessian(search.point), limits)
        return _line_search(value_and_grad, search, step)

    value, grad = value_and_grad(start)
    search = _Search(start, value, grad, jnp.zeros((), jnp.int32), jnp.zeros((), bool))
    search = lax.while_loop(is_running, advance, search)
    grad_norm = jnp.linalg.norm(search.grad)
    return Minimum(search.point, search.value, grad_norm, search.num_steps, grad_norm <= tolerance)


def _newton_step(grad: Array, hessian: Array, max_change: Array) -> Array:
    """Return a descent step: that of Newton, made safe along each principal axis of the Hessian by itself."""
    eps = float(jnp.finfo(hessian.dtype).eps)
    flat, no_curvature = _FLAT * eps, (_FLAT * eps) ** 2  # divisors stay above zero
    # Variables may have different units: a diagonal of ones gives "flat" one meaning for all.
    diagonal = jnp.abs(jnp.diagonal(hessian))
    unit = jnp.sqrt(jnp.maximum(diagonal, flat * jnp.max(diagonal) + no_curvature))
    curvature, axes = jnp.linalg.eigh(hessian / (unit[:, None] * unit[None, :]))
    curvature, slopes = jnp.abs(curvature), jnp.sum(axes * (grad / unit)[:, None], axis=0)
    least = flat * jnp.max(curvature) + no_curvature
    # Where the function is flat a slope is rounding: do not follow it.
    is_flat = (curvature <= least) & (jnp.abs(slopes) <= 10.0 * flat * jnp.max(jnp.abs(slopes)))
    lengths = jnp.where(is_flat, 0.0, -slopes / jnp.maximum(curvature, least))
    steps = axes * lengths[None, :] / unit[:, None]  # a column an axis
    # An axis without curvature asks for a very long step: it alone is shortened, others keep theirs.
    excess = jnp.max(jnp.abs(steps) / max_change[:, None], axis=0)
    return jnp.sum(steps / jnp.maximum(excess, 1.0)[None, :], axis=1)


def _line_search(
    value_and_grad: Callable[[Array], tuple[Array, Array]], search: _Search, step: Array
) -> _Search:
    """Move along the step by the longest trial length that is as good as the best one, to rounding."""
    lengths = 0.25 ** jnp.arange(_NUM_TRIALS, dtype=step.dtype)
    points = search.point[None, :] + lengths[:, None] * step[None, :]
    values, grads = jax.vmap(value_and_grad)(points)
    slope, slopes = jnp.sum(search.grad * step), jnp.sum(grads * step[None, :], axis=1)
    rounding = 8.0 * jnp.finfo(step.dtype).eps * (1.0 + jnp.abs(search.value))
    # Sufficient decrease, or (Hager & Zhang 2005, approximate Wolfe) as much as can be told from the slope.
    is_lower = values <= search.value + 1e-4 * lengths * slope - rounding
    is_flatter = (values <= search.value + rounding) & (slopes <= -0.8 * slope)
    is_finite = jnp.isfinite(values) & jnp.all(jnp.isfinite(grads), axis=1)
    is_acceptable = is_finite & (is_lower | is_flatter)
    best = jnp.min(jnp.where(is_acceptable, values, jnp.inf))
    choice = jnp.argmax(is_acceptable & (values <= best + rounding))  # the first of them: the longest
    point, value, grad = points[choice], values[choice], grads[choice]
    is_progress = (value < search.value - rounding) | (jnp.linalg.norm(grad) < jnp.linalg.norm(search.grad))
    is_moved = is_acceptable[choice] & is_progress
    moved = _Search(point, value, grad, search.num_steps + 1, jnp.zeros((), bool))
    stalled = search._replace(num_steps=search.num_steps + 1, is_stalled=jnp.ones((), bool))
    return jax.tree.map(lambda new, old: jnp.where(is_moved, new, old), moved, stalled)
