"""Describe, sample and fit the upper-level policy: a Gaussian whose mean is linear in context features.

Functions take the features of one context; `jax.vmap` them over a batch.
"""

import dataclasses
import inspect
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.scipy.linalg import solve_triangular

from creps_jax import checks
from creps_jax.numerics.linalg import divided, exact_dot, safe_cholesky, safe_sqrt
from creps_jax.policies.base import MStep, Policy, WeightedSamples
from creps_jax.policies.features import FeatureMap
from creps_jax.policies.regression import Regression, as_coefficients, regress
from creps_jax.typing import Array, Float, PRNGKey, Scalar, ScalarLike, VectorLike

__all__ = [
    "LinearGaussian",
    "blend",
    "blended_cov_chol",
    "check_cov_chol",
    "checked",
    "entropy",
    "fit_weighted_ml",
    "kl",
    "linear_gaussian",
    "log_prob",
    "log_prob_rows",
    "mean",
    "mean_rows",
    "sample",
    "sample_rows",
    "start_policy",
    "whitened",
]

_LOG_TWO_PI = 1.8378770664093453


class LinearGaussian(NamedTuple):
    """The policy pi(theta | s) = N(theta | coef' varphi(s), cov_chol cov_chol').

    Source: Abdolmaleki et al. 2016, Section 3.1.
    """

    coef: Float[Array, "p d"]
    """The coefficients A: one row for each feature, one column for each parameter."""
    cov_chol: Float[Array, "d d"]
    """The lower Cholesky factor of the covariance Sigma; its diagonal is positive."""


@checks.arguments
def start_policy(
    features: FeatureMap, theta_dim: int, *, mean: VectorLike = 0.0, std: VectorLike = 1.0
) -> LinearGaussian:
    """Make a policy to begin a search with: the same for every context.

    Args:
        features: The policy's features.
        theta_dim: Number d of parameters.
        mean: Mean of the free parameters, before bounds are applied: a number for all, or one for each.
            `Space.free` turns parameters into free ones.
        std: Their standard deviations, likewise.

    Returns:
        The policy; its parameters are independent of each other.

    Raises:
        ValueError: If there is not one number for each parameter, a standard deviation is not above zero, or
            the mean is not zero and the features cannot express a constant.
    """
    means, stds = (
        np.asarray(checks.vector(name, value), np.float32) for name, value in (("mean", mean), ("std", std))
    )
    for name, values in (("mean", means), ("std", stds)):
        if values.shape not in ((), (1,), (theta_dim,)):
            raise ValueError(
                f"{name} must be a number or one for each of {theta_dim} parameters, got shape {values.shape}"
            )
    if not np.all(stds > 0):
        raise ValueError(f"std must be above zero, got {std}")
    if features.constant is None and np.any(means != 0):
        raise ValueError(f"mean must be zero for features that cannot express a constant, got {mean}")
    constant = np.zeros(features.size) if features.constant is None else np.asarray(features.constant)
    coef = constant[:, None] * np.broadcast_to(means, theta_dim)[None, :]
    return LinearGaussian(
        jnp.asarray(coef, jnp.float32), jnp.diag(jnp.asarray(np.broadcast_to(stds, theta_dim)))
    )


def mean(policy: LinearGaussian, features: Float[Array, " p"]) -> Float[Array, " d"]:
    """Return the mean parameters A' varphi(s) for the features of a context.

    Raises:
        ValueError: If the policy has another number of features.
    """
    return exact_dot(checks.array("features", features, policy.coef.shape[:1]), policy.coef)


def sample(key: PRNGKey, policy: LinearGaussian, features: Float[Array, " p"]) -> Float[Array, " d"]:
    """Draw parameters theta ~ pi(theta | s) for the features of a context.

    Raises:
        ValueError: If the policy has another number of features.
    """
    centre = mean(policy, features)
    noise = jax.random.normal(key, centre.shape, centre.dtype)
    return centre + exact_dot(policy.cov_chol, noise)


def log_prob(policy: LinearGaussian, features: Float[Array, " p"], theta: Float[Array, " d"]) -> Scalar:
    """Return the log density log pi(theta | s), in nats, for the features of a context.

    Raises:
        ValueError: If the policy has another number of features or parameters.
    """
    centre = mean(policy, features)
    theta = checks.array("theta", theta, centre.shape)
    whitened = solve_triangular(policy.cov_chol, theta - centre, lower=True)
    return -0.5 * jnp.sum(whitened**2) - _half_log_det(policy) - 0.5 * _LOG_TWO_PI * centre.size


def kl(policy: LinearGaussian, reference: LinearGaussian, features: Float[Array, " p"]) -> Scalar:
    """Return the relative entropy KL(policy || reference) of theta, in nats, for the features of a context.

    The expectation is taken over `policy`, usually the new one; `reference` is usually the old one.

    Raises:
        ValueError: If the policies differ in shape or have another number of features.
    """
    checks.array("coef of the reference", reference.coef, policy.coef.shape)
    shift = mean(policy, features) - mean(reference, features)
    both = jnp.concatenate([policy.cov_chol, shift[:, None]], axis=1)
    ratio = solve_triangular(reference.cov_chol, both, lower=True)
    log_dets = _half_log_det(reference) - _half_log_det(policy)
    return 0.5 * (jnp.sum(ratio**2) - shift.size) + log_dets


def entropy(policy: LinearGaussian) -> Scalar:
    """Return the differential entropy of theta, the same for all contexts, in nats."""
    return _half_log_det(policy) + 0.5 * (1.0 + _LOG_TWO_PI) * policy.cov_chol.shape[0]


@checks.arguments
def fit_weighted_ml(
    features: Float[Array, "n p"],
    theta: Float[Array, "n d"],
    weights: Float[Array, " n"],
    *,
    ridge: ScalarLike,
    scale: Float[Array, " p"] | None = None,
    start: Float[Array, "p d"] | None = None,
    constant: Float[Array, " p"] | None = None,
) -> LinearGaussian:
    """Fit the policy to weighted samples by maximum likelihood.

    With the features as rows of Phi, the parameters as rows of U and the weights on the diagonal of D, the
    coefficients are `A = (Phi' D Phi)^-1 Phi' D U` (Eq. 14), here with a ridge, and the covariance is
    `Sigma = sum_i d_i (theta_i - A' phi_i) (theta_i - A' phi_i)' / Z` (Eq. 15).

    The fit does not depend on the units and zeros of parameters and features. The ridge shrinks the policy
    towards the weighted mean of theta (if the features can express a constant), not towards zero: it
    penalises how the mean changes with the context. If the zero of the context moves, its powers become other
    features, which the ridge penalises differently: with powers, measure the context from the middle of its
    range, or set the ridge to zero.

    Args:
        features: Policy features varphi of the context of each sample.
        theta: Parameters of each sample.
        weights: Weights d of the samples, not negative; a sample of weight zero may hold anything.
        ridge: Penalty on the coefficients, except along `constant`, relative to the square of each feature's
            scale; may be zero.
        scale: Size of each feature, above zero; by default its standard deviation. A feature that hardly
            varies in the samples but can vary outside of them is then hardly penalised: give its scale.
        start: Coefficients of the last policy. The ridge penalises the change from them: a ridge towards a
            constant would accumulate over many updates. By default the ridge is towards a constant.
        constant: Coefficients whose sum with the features is one, see `FeatureMap.constant`. By default they
            are taken from the samples: ones, if the features sum to one, else the inverse of the first
            feature that has one value in all samples, else none.

    Returns:
        The policy. Its covariance is taken about its own, context-dependent mean, and is unbiased for any
        number of features. It is finite and positive definite for any weights: directions that too few
        samples leave undetermined get the smallest spread that rounding allows.

    Raises:
        ValueError: If shapes do not fit each other, or a number is out of its range.

    Source: Abdolmaleki et al. 2016, Eq. 14 and 15.
    """
    fit = regress(features, theta, weights, ridge=ridge, scale=scale, start=start, constant=constant)
    change = as_coefficients(fit.basis, fit.solution.at[0].add(fit.centre), fit.size)
    coef = change if start is None else start + change
    return LinearGaussian(coef, fit.size[:, None] * _weighted_cov_chol(fit))


def _weighted_cov_chol(fit: Regression) -> Float[Array, "d d"]:
    """Return the Cholesky factor of the weighted covariance of residuals, in units of the parameters.

    The correlations are factored: the multiple of the identity that makes them positive definite is then
    relative to the spread of each parameter. The spread is at least the rounding of the parameter.
    """
    residual = fit.rest - exact_dot(fit.rows, fit.solution)
    # In print: Sigma = sum of d (theta - A' phi) (theta - A' phi)' / Z
    scatter = exact_dot(residual.T, residual) / fit.normaliser  # Eq. 15
    spread = jnp.maximum(safe_sqrt(jnp.diagonal(scatter)), 4.0 * jnp.finfo(residual.dtype).eps)
    correlation = scatter / (spread[:, None] * spread[None, :])
    is_diagonal = jnp.eye(spread.size, dtype=bool)
    return spread[:, None] * safe_cholesky(jnp.where(is_diagonal, 1.0, correlation))


def linear_gaussian(features: FeatureMap, *, m_step: MStep, ridge: float | int = 1e-4) -> Policy:
    """Make the kind of policy whose states are `LinearGaussian` records.

    Args:
        features: Features varphi(s) that the mean is linear in.
        m_step: Fit to weighted samples, see `MStep`.
        ridge: Penalty on the coefficients, relative to the square of each feature's scale.

    Returns:
        The record of its functions. Those of equal settings are equal.

    Raises:
        ValueError: If the ridge is negative or no number, or the m_step is no function.
    """
    checks.instance("features", features, FeatureMap)
    checks.number("ridge", ridge, least=0.0)
    checks.function("m_step", m_step, "(policy, samples, *, ridge, scale, constant) -> policy")
    return Policy(
        features,
        mean=mean_rows,
        sample=sample_rows,
        log_prob=log_prob_rows,
        kl=_kl_rows,
        entropy=entropy,
        fit=_Fit(m_step, ridge, features.scale, features.constant),
        blend=blend,
        noise=whitened,
        checked=checked,
    )


@dataclasses.dataclass(frozen=True)
class _Fit:
    """Fit a policy with the settings of `linear_gaussian`."""

    m_step: MStep
    ridge: float | int
    scale: tuple[float, ...] | None
    constant: tuple[float, ...] | None

    def __call__(self, policy: LinearGaussian, samples: WeightedSamples) -> LinearGaussian:
        settings = {
            name: None if numbers is None else jnp.asarray(numbers, samples.theta.dtype)
            for name, numbers in (("scale", self.scale), ("constant", self.constant))
        }
        parameters = inspect.signature(self.m_step).parameters
        takes_any = any(each.kind is each.VAR_KEYWORD for each in parameters.values())
        if not (takes_any or "constant" in parameters):
            del settings["constant"]
        fitted = self.m_step(policy, samples, ridge=self.ridge, **settings)
        checks.instance("what m_step returns", fitted, LinearGaussian)
        for field, values in policy._asdict().items():
            checks.array(f"{field} of what m_step returns", getattr(fitted, field), values.shape)
        return fitted


def mean_rows(policy: LinearGaussian, features: Array) -> Array:
    """Return the mean parameters for rows of features."""
    return jax.vmap(mean, (None, 0))(policy, features)


def sample_rows(key: PRNGKey, policy: LinearGaussian, features: Array) -> Array:
    """Draw parameters for rows of features."""
    keys = jax.random.split(key, features.shape[0])
    return jax.vmap(sample, (0, None, 0))(keys, policy, features)


def log_prob_rows(policy: LinearGaussian, features: Array, theta: Array) -> Array:
    """Return the log densities of rows of parameters, in nats."""
    noise = whitened(policy, features, theta)
    constant = _half_log_det(policy) + 0.5 * _LOG_TWO_PI * theta.shape[1]
    return -0.5 * jnp.sum(noise**2, axis=1) - constant


def _kl_rows(policy: LinearGaussian, reference: LinearGaussian, features: Array) -> Array:
    # Only the shift of the mean depends on the context.
    without_shift = kl(policy, reference, jnp.zeros_like(features[0]))
    shifts = exact_dot(features, divided(policy.coef - reference.coef, reference.cov_chol.T))
    return without_shift + 0.5 * jnp.sum(shifts**2, axis=1)


def whitened(policy: LinearGaussian, features: Array, theta: Array) -> Array:
    """Return the differences of theta from the mean, in units of the root of the covariance."""
    # One small inverse and a product: a triangular system for each sample takes many times as long.
    inverse = divided(jnp.eye(theta.shape[1], dtype=theta.dtype), policy.cov_chol.T)
    return exact_dot(theta - exact_dot(features, policy.coef), inverse)


def blend(old: Any, fitted: Any, share: Scalar) -> Any:
    """Return the fitted policy, its covariance moved by a share of the way from the old to its own."""
    return fitted._replace(cov_chol=blended_cov_chol(old.cov_chol, fitted.cov_chol, share))


def blended_cov_chol(
    old: Float[Array, "d d"], new: Float[Array, "d d"], share: ScalarLike
) -> Float[Array, "d d"]:
    """Return the Cholesky factor of `(1 - share) old old' + share new new'`, exactly if the share is 0 or 1.

    The relative entropy to the old covariance is convex in the new one: the blend keeps its bounds.
    """
    share = jnp.asarray(share, new.dtype)
    # In units of the old factor, squares of small spreads lose no digits.
    change = solve_triangular(old, new, lower=True)
    blend = (1.0 - share) * jnp.eye(old.shape[0], dtype=new.dtype) + share * exact_dot(change, change.T)
    is_between = (share > 0.0) & (share < 1.0)
    factor = jnp.linalg.cholesky(jnp.where(is_between, blend, jnp.eye(old.shape[0], dtype=new.dtype)))
    return jnp.where(share >= 1.0, new, jnp.where(share <= 0.0, old, jnp.tril(exact_dot(old, factor))))


def checked(name: str, policy: LinearGaussian, features: FeatureMap) -> LinearGaussian:
    """Return a policy in one precision, after checking that it fits the features.

    Raises:
        ValueError: If it does not, is not finite, or `cov_chol` is no Cholesky factor.
    """
    checks.instance(name, policy, LinearGaussian)
    coef, cov_chol = (
        checks.array(f"{name}.coef", policy.coef),
        checks.array(f"{name}.cov_chol", policy.cov_chol),
    )
    if (
        coef.ndim != 2
        or coef.shape[0] != features.size
        or 0 in coef.shape
        or cov_chol.shape != (coef.shape[1],) * 2
    ):
        raise ValueError(
            f"the {name} must have coef ({features.size}, d), a row for each of the policy features, "
            f"and cov_chol (d, d), got {coef.shape} and {cov_chol.shape}"
        )
    dtype = jnp.promote_types(coef.dtype, cov_chol.dtype)
    policy = LinearGaussian(checks.converted(coef, dtype), checks.converted(cov_chol, dtype))
    for field, values in policy._asdict().items():
        checks.finite(f"{name}.{field}", values)
    check_cov_chol(f"{name}.cov_chol", policy.cov_chol)
    return policy


def check_cov_chol(name: str, cov_chol: Float[Array, "d d"]) -> None:
    """Check that a matrix is a Cholesky factor, unless it is traced.

    Raises:
        ValueError: If it is not lower triangular with a positive diagonal.
    """
    if not isinstance(cov_chol, Tracer):
        upper, diagonal = np.triu(cov_chol, 1), np.diagonal(cov_chol)
        if upper.any():
            entry = upper[upper != 0][0]
            raise ValueError(f"{name} must be lower triangular, got {entry} above its diagonal")
        checks.finite(f"the diagonal of {name}", diagonal, above=0.0)


def _half_log_det(policy: LinearGaussian) -> Array:
    return jnp.sum(jnp.log(jnp.diagonal(policy.cov_chol)))
