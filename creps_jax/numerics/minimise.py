"""Minimise a smooth convex function of a few variables by Newton's method."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from creps_jax.typing import Array, Bool, Float, Int, Scalar, ScalarLike

__all__ = ["Minimum", "minimise"]

_NUM_TRIALS = 6
"""Number of step lengths that are tried: 1, 1/4, ..., 1/1024 of the Newton step."""
_NEAR_MINIMUM = 0.5
"""A point is near the minimum along a step if its slope is at most this share of the slope at the start."""
_FLAT = 8.0
"""Least curvature of an axis relative to the largest curvature, in units of the rounding of the format."""


class Minimum(NamedTuple):
    """The result of a minimisation."""

    point: Float[Array, " k"]
    value: Float[Array, ""]
    grad_norm: Float[Array, ""]
    num_steps: Int[Array, ""]
    is_converged: Bool[Array, ""]
    """Whether the norm of the gradient is within the tolerance."""


class _Search(NamedTuple):
    point: Array
    value: Array
    grad: Array
    num_steps: Array
    is_stalled: Array


class _Trials(NamedTuple):
    """The best of the points that were tried along a step."""

    point: Array
    value: Array
    grad: Array
    is_found: Array
    is_good: Array
    length: Array  # of the next trial
    num: Array


def minimise(
    function: Callable[[Float[Array, " k"]], Scalar],
    start: Float[Array, " k"],
    *,
    hessian: Callable[[Float[Array, " k"]], Float[Array, "k k"]] | None = None,
    max_steps: int = 50,
    tolerance: ScalarLike | None = None,
    max_change: ScalarLike | Float[Array, " k"] = 1e3,
) -> Minimum:
    """Minimise a convex function by damped Newton steps with `jax.grad` and `jax.hessian`.

    The Hessian may be singular (the function may be flat along some directions) and, away from the minimum,
    even indefinite (a convex function of x is not convex in log x): steps use the absolute values of its
    eigenvalues. The step length is the longest of a fixed list whose value is the best one up to rounding.
    Near the minimum, where values no longer differ in the floating-point format, slopes are compared.

    Args:
        function: The function, scaled such that changes of order one in values and gradients matter.
        start: First point, at which the function must be finite.
        hessian: The matrix of second derivatives, if it is known; by default `jax.hessian` computes it.
        max_steps: Largest number of Newton steps.
        tolerance: Norm of the gradient at which the search ends; by default 9e-7 in float32 and 2e-14 in
            float64.
        max_change: Largest change of each variable in a step along one axis: the range in which the quadratic
            model of the function is trusted.

    Returns:
        The last point; up to rounding, its value is never larger than at the start. The search also ends,
        without convergence, if rounding allows no further progress.

    Raises:
        ValueError: If `start` is not a vector or `max_steps` is below 1.
    """
    if start.ndim != 1 or start.size == 0:
        raise ValueError(f"start must have shape (k,), k >= 1, got {start.shape}")
    if max_steps < 1:
        raise ValueError(f"max_steps must be at least 1, got {max_steps}")
    if tolerance is None:
        tolerance = float(jnp.finfo(start.dtype).eps) ** (7 / 8)
    limits = jnp.broadcast_to(jnp.asarray(max_change, start.dtype), start.shape)
    value_and_grad = jax.value_and_grad(function)
    hessian = jax.hessian(function) if hessian is None else hessian

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
    """Return Newton's step, made a safe descent step along each principal axis of the Hessian separately."""
    eps = float(jnp.finfo(hessian.dtype).eps)
    flat, no_curvature = _FLAT * eps, (_FLAT * eps) ** 2  # divisors stay above zero
    # Variables may have different units: a diagonal of ones makes "flat" mean the same for all.
    diagonal = jnp.abs(jnp.diagonal(hessian))
    unit = jnp.sqrt(jnp.maximum(diagonal, flat * jnp.max(diagonal) + no_curvature))
    curvature, axes = jnp.linalg.eigh(hessian / (unit[:, None] * unit[None, :]))
    curvature, slopes = jnp.abs(curvature), jnp.sum(axes * (grad / unit)[:, None], axis=0)
    least = flat * jnp.max(curvature) + no_curvature
    # Along flat axes the slope is rounding: do not follow it.
    is_flat = (curvature <= least) & (jnp.abs(slopes) <= 10.0 * flat * jnp.max(jnp.abs(slopes)))
    lengths = jnp.where(is_flat, 0.0, -slopes / jnp.maximum(curvature, least))
    steps = axes * lengths[None, :] / unit[:, None]  # one column for each axis
    # An axis without curvature has a very long step: only this one is shortened.
    excess = jnp.max(jnp.abs(steps) / max_change[:, None], axis=0)
    return jnp.sum(steps / jnp.maximum(excess, 1.0)[None, :], axis=1)


def _line_search(
    value_and_grad: Callable[[Array], tuple[Array, Array]], search: _Search, step: Array
) -> _Search:
    """Move along the step by the longest trial length whose value is the best one up to rounding.

    Trials end at a length that is near the minimum along the step; mostly this is the first one.
    """
    slope = jnp.sum(search.grad * step)
    rounding = 8.0 * jnp.finfo(step.dtype).eps * (1.0 + jnp.abs(search.value))

    def is_going_on(trials: _Trials) -> Array:
        return ~trials.is_good & (trials.num < _NUM_TRIALS)

    def try_next(trials: _Trials) -> _Trials:
        length = trials.length
        point = search.point + length * step
        value, grad = value_and_grad(point)
        new_slope = jnp.sum(grad * step)
        # Sufficient decrease, judged by the value or by the slope (approximate Wolfe, Hager & Zhang 2005).
        is_lower = value <= search.value + 1e-4 * length * slope - rounding
        is_flatter = (value <= search.value + rounding) & (new_slope <= -0.8 * slope)
        is_finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(grad))
        is_acceptable = is_finite & (is_lower | is_flatter)
        is_better = is_acceptable & (~trials.is_found | (value < trials.value - rounding))
        point, value, grad = (
            jnp.where(is_better, new, old)
            for new, old in ((point, trials.point), (value, trials.value), (grad, trials.grad))
        )
        is_good = is_acceptable & (jnp.abs(new_slope) <= _NEAR_MINIMUM * jnp.abs(slope))
        return _Trials(
            point, value, grad, trials.is_found | is_acceptable, is_good, 0.25 * length, trials.num + 1
        )

    no, none, one = jnp.zeros((), bool), jnp.zeros((), jnp.int32), jnp.ones((), step.dtype)
    start = _Trials(search.point, search.value, search.grad, no, no, one, none)
    best = lax.while_loop(is_going_on, try_next, start)
    is_progress = (best.value < search.value - rounding) | (
        jnp.linalg.norm(best.grad) < jnp.linalg.norm(search.grad)
    )
    return _Search(best.point, best.value, best.grad, search.num_steps + 1, ~(best.is_found & is_progress))
