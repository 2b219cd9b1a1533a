"""The dual of contextual REPS: the dual function (Eq. 13), its minimum, and the weights it gives (Eq. 12).

The reward R of a sample is compared with a baseline V(s) = phi(s)' w of its context, at a temperature eta.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import logsumexp

from creps_jax import checks
from creps_jax.numerics.linalg import exact_dot
from creps_jax.search.dual_rounds import Guess, first_guess, minimise_in_rounds
from creps_jax.search.dual_scaling import (
    ROUNDING,
    Samples,
    eps,
    exceeds_rounding,
    rescale,
    standardise,
    without_offset,
)
from creps_jax.search.weights import log_prior, mask, relative_entropy, softmax_weights
from creps_jax.typing import Array, Bool, Float, Int, Num, Scalar, ScalarLike

__all__ = ["DualSolution", "dual_objective", "sample_kl", "sample_weights", "solve_and_weigh", "solve_dual"]

Rewards: TypeAlias = Float[Array, " n"] | Num[np.ndarray, " n"] | Sequence[float | int]
"""Rewards; those in float64 outside of jax keep all digits of their differences."""
Features: TypeAlias = Float[Array, "n m"] | Float[np.ndarray, "n m"]
Valid: TypeAlias = Bool[Array, " n"] | Float[Array, " n"] | Bool[np.ndarray, " n"] | Float[np.ndarray, " n"]
"""Which samples count, or as numbers: the weight of each before its reward is seen."""


class DualSolution(NamedTuple):
    """Minimum of the dual function, in units of the given rewards and features, and its quality."""

    temperature: Float[Array, ""]
    """Lagrangian multiplier eta of the bound on the relative entropy, above zero."""
    baseline_coef: Float[Array, " m"]
    """Coefficients w of the baseline V(s) = phi(s)' w; V is determined up to a constant."""
    grad_norm: Float[Array, ""]
    """Violation of the constraints: the norm of the difference between relative entropy and bound, and of
    the change of the means of the standardised, uncorrelated features."""
    num_steps: Int[Array, ""]
    """Number of Newton steps."""
    is_active: Bool[Array, ""]
    """Whether the relative entropy equals its bound. False where no temperature reaches the bound, as with
    too few samples: the weights are then nearly greedy. Also False where the weights are those of `valid`."""
    is_informative: Bool[Array, ""] | bool = True
    """Whether the samples call for weights other than those of `valid`. False where the baseline explains
    the rewards up to rounding, or where a traced bound is not a number above zero."""


def dual_objective(
    log_temperature: ScalarLike,
    baseline_coef: Float[Array, " m"],
    reward: Float[Array, " n"],
    features: Float[Array, "n m"],
    valid: Valid,
    kl_bound: ScalarLike,
) -> Scalar:
    """Evaluate the dual function of contextual REPS on samples; it is convex in (eta, w).

    Args:
        log_temperature: Logarithm of the temperature eta.
        baseline_coef: Coefficients w of the baseline V(s) = phi(s)' w.
        reward: Reward R of each sample.
        features: Baseline features phi of the context of each sample.
        valid: Which samples count, or the weight of each. Values of samples that do not count are not used.
        kl_bound: Largest relative entropy epsilon between the weights and those of `valid`, in nats.

    Returns:
        g(eta, w) = eta epsilon + mean(phi)' w + eta log mean exp((R - phi' w) / eta), with means over the
        samples that count.

    Raises:
        ValueError: If shapes do not fit.

    Source: Abdolmaleki et al. 2016, Eq. 13.
    """
    reward, features, prior = mask(*_checked_samples(reward, features, valid))
    coef, bound = (jnp.asarray(x, reward.dtype) for x in (baseline_coef, kl_bound))
    return _dual_function(jnp.asarray(log_temperature, reward.dtype), coef, reward, features, prior, bound)


def _dual_function(
    log_temperature: Array,
    baseline_coef: Array,
    reward: Array,
    features: Array,
    prior: Array,
    kl_bound: Array,
) -> Scalar:
    """Evaluate the dual function on masked samples, whose prior sums to one."""
    temperature = jnp.exp(log_temperature)
    mean_features = exact_dot(prior, features)
    advantage = (reward - exact_dot(features, baseline_coef)) / temperature
    log_mean = logsumexp(advantage + log_prior(prior), where=prior > 0)
    # In print: g = eta epsilon + phi^' w + eta log(mean of exp((R - phi' w) / eta))
    return temperature * kl_bound + exact_dot(mean_features, baseline_coef) + temperature * log_mean  # Eq. 13


def solve_dual(
    reward: Rewards,
    features: Features,
    valid: Valid | None = None,
    *,
    kl_bound: ScalarLike,
    resolution: ScalarLike | None = None,
) -> DualSolution:
    """Minimise the dual function over the temperature and the baseline.

    The solution is independent of units: adding a constant to the rewards changes no weight, and scaling
    them by c scales the temperature and the baseline by c. Features may have offsets and different scales,
    may be collinear, and may outnumber the samples.

    Args:
        reward: Reward R of each sample.
        features: Baseline features phi of the context of each sample.
        valid: Which samples count; all by default. As numbers: the weight of each before its reward is seen,
            such as its importance weight. Where reward or features are not finite, a sample never counts.
        kl_bound: Largest relative entropy epsilon between the weights and those of `valid`, above zero, in
            nats.
        resolution: Largest difference between rewards that is rounding error, in the unit of the rewards; by
            default the rounding error of the largest reward in the format in which it was given. For rewards
            from which an offset was subtracted it is the rounding error of the offset.

    Returns:
        The solution, finite for any number of samples that count, including none. Where the bound is active,
        the relative entropy of `sample_weights` equals it, and the weighted mean of the features is their
        mean by `valid`.

    Raises:
        ValueError: If shapes do not fit, `kl_bound` is not a positive number, or `resolution` is negative.

    Source: Abdolmaleki et al. 2016, Eq. 12 and 13.
    """
    if resolution is not None:
        checks.number("resolution", resolution, least=0.0)
    given, rounding = without_offset(reward, valid)
    given, features, prior = _checked_samples(given, features, valid)
    checks.number("kl_bound", kl_bound, above=0.0)
    relative = ROUNDING * eps(given, reward) if resolution is None and rounding is None else 0.0
    absolute = resolution if resolution is not None else 0.0 if rounding is None else rounding
    return solve_and_weigh(given, features, prior, kl_bound, relative=relative, resolution=absolute)[0]


def solve_and_weigh(
    reward: Float[Array, " n"],
    features: Float[Array, "n m"],
    prior: Array,
    kl_bound: ScalarLike,
    *,
    resolution: ScalarLike,
    relative: ScalarLike = 0.0,
) -> tuple[DualSolution, Float[Array, " n"]]:
    """Return the results of `solve_dual` and `sample_weights` for samples of one format, without checks.

    Differences between rewards of up to `resolution`, plus `relative` times the largest reward, are rounding
    errors.
    """
    numbers = (jnp.asarray(number, reward.dtype) for number in (kl_bound, relative, resolution))
    return _solve_and_weigh(reward, features, prior, *numbers)


# Compiled here for calls from outside of a compiled program.
@jax.jit
def _solve_and_weigh(
    reward: Array, features: Array, prior: Array, kl_bound: Array, relative: Array, resolution: Array
) -> tuple[DualSolution, Array]:
    samples = rescale(reward, features, prior)
    threshold = relative * samples.largest + jnp.ldexp(resolution, -samples.reward_exponent)
    is_bound = kl_bound > 0  # not checked where it is traced
    # The relative entropy is largest with all weight on the sample of the least prior. A bound far above
    # that would lower the temperature until rounding decides; one nat above it, the bound is still not met.
    kl_bound = jnp.minimum(jnp.where(is_bound, kl_bound, 1.0), 1.0 - jnp.min(log_prior(samples.prior)))
    standardised, unit = standardise(samples)
    first = first_guess(standardised, kl_bound)
    is_informative = is_bound & exceeds_rounding(standardised, threshold / unit)
    first = first._replace(is_settled=~is_informative)
    guess = minimise_in_rounds(_dual_function, first, standardised, kl_bound)
    solution = _in_given_units(guess, unit, samples, is_informative)
    # The quality is that of the weights that the caller gets, including the rounding of the solution.
    weights = _weights(solution, samples)
    excess = relative_entropy(weights, samples.prior * jnp.any(weights > 0).astype(weights.dtype)) - kl_bound
    excess = jnp.where(solution.is_active, excess, jnp.maximum(excess, 0.0))
    mismatch = exact_dot(weights - samples.prior, standardised.whitened)
    return solution._replace(grad_norm=jnp.sqrt(excess**2 + jnp.sum(mismatch**2))), weights


def sample_weights(
    solution: DualSolution,
    reward: Rewards,
    features: Features,
    valid: Valid | None = None,
) -> Float[Array, " n"]:
    """Weigh the samples by exp((R - V(s)) / eta), times their weights in `valid`.

    Args:
        solution: Temperature eta and baseline coefficients w, from `solve_dual` on the same samples.
        reward: Reward R of each sample.
        features: Baseline features phi of the context of each sample.
        valid: Which samples count; all by default. As numbers: the weight of each before its reward is seen,
            such as its importance weight. Where reward or features are not finite, a sample never counts.

    Returns:
        Weights that sum to one, zero where a sample does not count; all zero if no sample counts. If the
        solution is not informative they are the weights of `valid`.

    Raises:
        ValueError: If shapes do not fit, or numbers of the solution are not finite.

    Source: Abdolmaleki et al. 2016, the solution p(s, theta) below Eq. 12.
    """
    reward, features, prior = _checked_samples(without_offset(reward, valid)[0], features, valid)
    solution = _checked_solution(solution, features)
    return _weights_of(solution, reward, features, prior)


@jax.jit
def _weights_of(solution: DualSolution, reward: Array, features: Array, prior: Array) -> Array:
    return _weights(solution, rescale(reward, features, prior))


def _weights(solution: DualSolution, samples: Samples) -> Array:
    dtype = samples.reward.dtype
    coef = solution.baseline_coef.astype(dtype)
    coef = jnp.ldexp(coef, samples.feature_exponents - samples.reward_exponent)
    temperature = jnp.ldexp(jnp.asarray(solution.temperature, dtype), -samples.reward_exponent)
    temperature = jnp.maximum(temperature, jnp.finfo(dtype).tiny)
    advantage = (samples.reward - exact_dot(samples.features, coef)) / temperature
    # In print: p = q mu exp((R - V) / eta), up to a factor
    weights = softmax_weights(advantage, samples.prior)  # Eq. 12
    weights = jnp.where(solution.is_informative, weights, samples.prior)
    return jnp.where(samples.is_counted, weights, 0.0)


def _in_given_units(guess: Guess, unit: Array, samples: Samples, is_informative: Array) -> DualSolution:
    """Return the minimum in the units of the given samples, clipped to the range of the format."""
    info = jnp.finfo(unit.dtype)
    temperature = jnp.ldexp(unit * guess.temperature, samples.reward_exponent)
    coef = jnp.ldexp(unit * guess.baseline_coef, samples.reward_exponent - samples.feature_exponents)
    is_held = jnp.isfinite(temperature) & jnp.all(jnp.isfinite(coef))
    return DualSolution(
        temperature=jnp.clip(temperature, info.tiny, info.max),
        baseline_coef=jnp.clip(coef, info.min, info.max),
        grad_norm=jnp.zeros_like(unit),
        num_steps=guess.num_steps,
        is_active=guess.is_active & is_held & is_informative,
        is_informative=is_informative,
    )


def sample_kl(weights: Float[Array, " n"], valid: Valid | None = None) -> Scalar:
    """Return the relative entropy between weights and the weights of `valid`, in nats.

    Args:
        weights: Weights d that sum to one, zero where a sample does not count.
        valid: Which samples count; all by default. As numbers: the weight of each before its reward is seen.

    Returns:
        sum d log(d / p), where p is `valid`, scaled to a sum of one; between 0 and log n if it is uniform.

    Raises:
        ValueError: If the shapes differ.
    """
    prior = jnp.ones_like(weights) if valid is None else checks.array("valid", valid)
    if weights.shape != prior.shape:
        raise ValueError(f"weights and valid must have the same shape, got {weights.shape} and {prior.shape}")
    return relative_entropy(weights, prior)


def _checked_samples(reward: Any, features: Any, valid: Any) -> tuple[Array, Array, Array]:
    """Return rewards and features in one format, and the prior, after checking their shapes."""
    reward, features = checks.array("reward", reward), checks.array("features", features)
    if reward.ndim != 1 or features.ndim != 2 or features.shape[0] != reward.shape[0] or 0 in features.shape:
        raise ValueError(
            f"reward must have shape (n,) and features (n, m), got shapes {reward.shape} and {features.shape}"
        )
    dtype = max(reward.dtype, features.dtype, key=lambda kind: kind.itemsize)
    reward, features = reward.astype(dtype), features.astype(dtype)
    if valid is None:
        return reward, features, jnp.ones_like(reward)
    return reward, features, checks.array("valid", checks.in_range(valid), reward.shape)


def _checked_solution(solution: DualSolution, features: Array) -> DualSolution:
    checks.instance("solution", solution, DualSolution)
    checks.number("solution.temperature", solution.temperature, above=0.0)
    coef = checks.array("solution.baseline_coef", solution.baseline_coef, features.shape[1:])
    return solution._replace(baseline_coef=checks.finite("solution.baseline_coef", coef))
