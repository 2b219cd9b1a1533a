"""Move a Gaussian policy to the maximum of a quadratic model of the reward, within bounds on its change."""

from typing import NamedTuple

import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

from creps_jax.numerics.linalg import exact_dot
from creps_jax.policies.bounded_covariance import as_cov_chol, least_multiplier
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.search.surrogate_fit import Quadratic
from creps_jax.typing import Array, Float, Scalar, ScalarLike

__all__ = ["Step", "path_decay", "step"]

_COS_OF_STEPS = 0.2588
"""Cosine of the angle between steps, 75 degrees, at which the spread stays the same."""
_STEADY = 0.9
"""Least R2 at which the length of the path changes the spread."""
_SLOWER = 0.25
"""Factor of the bound on the covariance below this R2."""


class Step(NamedTuple):
    """A new policy, and the path of its mean."""

    policy: LinearGaussian
    path: Float[Array, "d p"]
    """Weighted sum of the last steps of the mean, in units of the spread; a column for each feature."""


def step(
    policy: LinearGaussian,
    model: Quadratic,
    path: Float[Array, "d p"],
    features: Float[Array, "n p"],
    whitening: Float[Array, "p p"],
    theta_size: Float[Array, " d"],
    *,
    kl_bound: ScalarLike,
) -> Step:
    """Move mean and covariance within their bounds, then the spread by the length of the path.

    Args:
        policy: The policy around which the model was fitted.
        model: The model.
        path: The path so far.
        features: Features of the contexts over which the path is averaged; zero for others.
        whitening: W of the model: its features are those of the policy times W.
        theta_size: Size of each parameter, which determines its rounding.
        kl_bound: Largest relative entropy by the change of the mean, the mean over the contexts, in nats.

    Source: Huettenrauch and Neumann 2024, Robust black-box optimization for stochastic search and episodic
    reinforcement learning (two bounds, step size by a path).
    """
    dim = policy.cov_chol.shape[0]
    kl_bound = jnp.asarray(kl_bound, model.slope.dtype)
    is_steady = model.r2 >= _STEADY
    cov_bound = 1.5 / (10.0 + dim**1.5) * jnp.where(is_steady, 1.0, _SLOWER)
    curvature, axes = jnp.linalg.eigh(model.curvature)
    change = exact_dot(axes, _mean_change(curvature, exact_dot(axes.T, model.slope), kl_bound))
    root = exact_dot(policy.cov_chol, axes * jnp.sqrt(_variances(curvature, cov_bound))[None, :])

    decay = path_decay(dim)
    gain = jnp.sqrt(decay * (2.0 - decay))
    change_of_features = exact_dot(change, whitening.T)
    unit = jnp.sqrt(2.0 * kl_bound)
    path = (1.0 - decay) * path + gain / unit * change_of_features
    num = jnp.maximum(jnp.sum(jnp.any(features != 0, axis=1), dtype=change.dtype), 1.0)
    length = jnp.sqrt(jnp.sum(exact_dot(features, path.T) ** 2) / num)
    factor = jnp.where(is_steady, jnp.exp((length / _desired_length(decay) - 1.0) / dim), 1.0)

    size = theta_size[:, None]
    cov_chol = size * as_cov_chol(factor * root / size, policy.cov_chol / size)
    coef = policy.coef + exact_dot(policy.cov_chol, change_of_features).T
    # The frame of z turns when the root is made triangular.
    turned = solve_triangular(cov_chol, factor * exact_dot(root, exact_dot(axes.T, path)), lower=True)
    return Step(LinearGaussian(coef, cov_chol), turned)


def path_decay(dim: int) -> float:
    """Return the share of the path that each step replaces."""
    return 1.0 / (2.0 + dim**0.7)


def _desired_length(decay: float) -> float:
    """Return the length of a path whose steps have the length one and are at 75 degrees to it."""
    gain = (decay * (2.0 - decay)) ** 0.5
    along = (1.0 - decay) * _COS_OF_STEPS
    return (along + (along**2 + gain**2) ** 0.5) / gain


def _mean_change(curvature: Array, slope: Array, kl_bound: Scalar) -> Array:
    """Return (A + l I)^-1 B on the axes of A, for the least l that meets the bound."""
    squares = 0.5 * jnp.sum(slope**2, axis=1)
    least = jnp.maximum(-jnp.min(curvature), 0.0)
    unit = _unit(jnp.max(jnp.abs(curvature)) + jnp.sqrt(jnp.sum(squares) / kl_bound))

    def kl(multiplier: Array) -> Scalar:
        return jnp.sum(squares / (curvature + least + unit * multiplier) ** 2)

    multiplier = least_multiplier(kl, kl_bound, slope.dtype)
    return slope / (curvature + least + unit * multiplier)[:, None]


def _variances(curvature: Array, kl_bound: Scalar) -> Array:
    """Return the eigenvalues of (I + A / v)^-1, for the least v that meets the bound."""
    least = jnp.maximum(-jnp.min(curvature), 0.0)
    unit = _unit(jnp.max(jnp.abs(curvature)))

    def variances(multiplier: Array) -> Array:
        scale = least + unit * multiplier
        return scale / (scale + curvature)

    def kl(multiplier: Array) -> Scalar:
        x = variances(multiplier)
        return 0.5 * jnp.sum(x - 1.0 - jnp.log(x))

    return variances(least_multiplier(kl, kl_bound, curvature.dtype))


def _unit(size: Scalar) -> Scalar:
    return jnp.where(size > 0, size, 1.0)
