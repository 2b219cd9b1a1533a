"""Weigh samples by contextual relative entropy policy search: the dual function, its minimum, the weights."""

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import logsumexp

from creps_jax import checks
from creps_jax.numerics.linalg import (
    as_bits,
    centre_columns,
    exact_dot,
    normalised,
    times_power,
    whitened_regression,
)
from creps_jax.numerics.minimise import minimise
from creps_jax.typing import Array, Bool, Float, Int, Num, Scalar, ScalarLike

__all__ = ["DualSolution", "dual_objective", "sample_kl", "sample_weights", "solve_and_weigh", "solve_dual"]

Rewards: TypeAlias = Float[Array, " n"] | Num[np.ndarray, " n"] | Sequence[float | int]
"""Rewards; what is of float64 outside of jax loses no digits of their differences."""
Features: TypeAlias = Float[Array, "n m"] | Float[np.ndarray, "n m"]
Valid: TypeAlias = Bool[Array, " n"] | Float[Array, " n"] | Bool[np.ndarray, " n"] | Float[np.ndarray, " n"]
"""Which samples count, or as numbers: how much each counts."""

_NUM_ROUNDS = 4
"""Most rounds of standardising and minimising, before and after the bound may be given up."""
_RESOLUTION = 42.0
"""Lowest temperature, in units of the rounding of the numbers whose difference is the advantage."""
_ROUNDING = 1.75
"""Size of differences, in the same unit, up to which they are rounding."""
_FIT_ROUNDING = 4.0
"""The same of a baseline, in units of the rounding of its terms."""
_SPARE_EXPONENTS = 8
"""How far, in powers of two, coefficients may be from what their units suggest."""
_NEARLY_GREEDY = 0.99
"""Share of the largest possible relative entropy that the weights get where the bound is out of reach."""


class DualSolution(NamedTuple):
    """Hold the minimum of the dual function, in units of the given rewards and features, and its quality."""

    temperature: Float[Array, ""]
    """The Lagrangian multiplier eta of the bound on the relative entropy, above zero."""
    baseline_coef: Float[Array, " m"]
    """The coefficients w of the baseline V(s) = phi(s)' w, which is determined up to a constant."""
    grad_norm: Float[Array, ""]
    """How far the constraints are from being met: the norm of the excess of the relative entropy and of the
    mismatch of the standardised, uncorrelated features."""
    num_steps: Int[Array, ""]
    """Newton steps taken."""
    is_active: Bool[Array, ""]
    """Whether the relative entropy equals its bound. False where no temperature reaches it, as with too few
    samples: the weights are then nearly greedy. False as well where the weights are what `valid` gives."""
    is_informative: Bool[Array, ""] | bool = True
    """Whether the samples call for other weights than `valid` gives them. False where all that the baseline
    leaves of the rewards is rounding, or where a traced bound is no number above zero."""


def dual_objective(
    log_temperature: ScalarLike,
    baseline_coef: Float[Array, " m"],
    reward: Float[Array, " n"],
    features: Float[Array, "n m"],
    valid: Valid,
    kl_bound: ScalarLike,
) -> Scalar:
    """Evaluate the dual function of contextual REPS on samples; convex in (temperature, baseline_coef).

    Args:
        log_temperature: Logarithm of the temperature eta.
        baseline_coef: Coefficients w of the baseline V(s) = phi(s)' w.
        reward: Reward R of each sample.
        features: Baseline features phi of the context of each sample.
        valid: Which samples count, or how much each does; what those hold that do not is never used.
        kl_bound: Largest relative entropy epsilon between the weights and what `valid` gives them.

    Returns:
        g(eta, w) = eta epsilon + mean(phi)' w + eta log mean exp((R - phi' w) / eta), means over what counts.

    Source: Abdolmaleki et al. 2016, Eq. 13.
    """
    reward, features, prior = _mask(*_checked_samples(reward, features, valid))
    coef, bound = (jnp.asarray(x, reward.dtype) for x in (baseline_coef, kl_bound))
    return _dual(jnp.asarray(log_temperature, reward.dtype), coef, reward, features, prior, bound)


def _dual(
    log_temperature: ScalarLike,
    baseline_coef: Array,
    reward: Array,
    features: Array,
    prior: Array,
    kl_bound: ScalarLike,
) -> Scalar:
    """Evaluate the dual function on what `_mask` returns."""
    temperature = jnp.exp(log_temperature)
    mean_features = exact_dot(prior, features)
    advantage = (reward - exact_dot(features, baseline_coef)) / temperature
    log_mean = logsumexp(advantage + _log(prior), where=prior > 0)
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

    The answer does not depend on units: shifting the rewards changes no weight, scaling them by c scales the
    temperature and the baseline by c. Features may be offset, scaled, collinear, or more than samples.

    Args:
        reward: Reward R of each sample.
        features: Baseline features phi of the context of each sample.
        valid: Which samples count; all by default. As numbers: how much each counts before its reward is
            seen, such as its importance weight. One whose reward or features are not finite never counts.
        kl_bound: Largest relative entropy epsilon between the weights and those of `valid`, above zero.
        resolution: Differences between rewards up to this size, in the unit of the rewards, count as rounding
            error; by default that of the largest reward in the format in which it was given. For rewards from
            which an offset was subtracted it is the rounding error of the offset.

    Returns:
        The solution, finite for any number of samples that count, none included. Where the bound is active,
        the relative entropy of `sample_weights` equals it and they keep the mean of the features.

    Raises:
        ValueError: If shapes do not fit, `kl_bound` is not a positive number, or `resolution` is negative.

    Source: Abdolmaleki et al. 2016, Eq. 12 and 13.
    """
    return _solve_and_weigh(reward, features, valid, kl_bound, resolution)[0]


def solve_and_weigh(
    reward: Rewards,
    features: Features,
    valid: Valid | None = None,
    *,
    kl_bound: ScalarLike,
    resolution: ScalarLike | None = None,
) -> tuple[DualSolution, Float[Array, " n"]]:
    """Return what `solve_dual` and `sample_weights` do, in the time of the first."""
    return _solve_and_weigh(reward, features, valid, kl_bound, resolution)


def _solve_and_weigh(
    reward: Any, features: Any, valid: Any, kl_bound: Any, resolution: Any
) -> tuple[DualSolution, Array]:
    if resolution is not None:
        checks.number("resolution", resolution, least=0.0)
    given, rounding = _without_offset(reward, valid)
    given, features, prior = _checked_samples(given, features, valid)
    relative = _ROUNDING * _eps(given, reward) if resolution is None and rounding is None else 0.0
    absolute = resolution if resolution is not None else 0.0 if rounding is None else rounding
    numbers = checks.number("kl_bound", kl_bound, above=0.0), relative, absolute
    return _solve(given, features, prior, *(jnp.asarray(number, given.dtype) for number in numbers))


# Compiled here, as it is called by hand as well.
@jax.jit
def _solve(
    reward: Array, features: Array, prior: Array, kl_bound: Array, relative: Array, absolute: Array
) -> tuple[DualSolution, Array]:
    """Solve for samples of one format; differences are rounding by their size relative to the rewards'."""
    samples = _rescaled(reward, features, prior)
    threshold = relative * samples.largest + jnp.ldexp(absolute, -samples.reward_exponent)
    is_bound = kl_bound > 0  # a traced one may be no such number
    # No weights have more than all on the sample with the least prior. A bound far beyond that would drive
    # the temperature down to where rounding decides; one nat beyond, it still does not count as met.
    kl_bound = jnp.minimum(jnp.where(is_bound, kl_bound, 1.0), 1.0 - jnp.min(_log(samples.prior)))
    standardised, unit = _standardise(samples)
    first = _first_guess(standardised, kl_bound)
    is_informative = is_bound & _is_informative(standardised, threshold / unit)
    guess = _search(first._replace(is_settled=~is_informative), standardised, kl_bound)
    solution = _solution(guess, unit, samples, is_informative)
    # The quality is that of the weights as the caller gets them, with the rounding of the solution.
    weights = _weights(solution, samples)
    excess = sample_kl(weights, samples.prior * jnp.any(weights > 0).astype(weights.dtype)) - kl_bound
    excess = jnp.where(solution.is_active, excess, jnp.maximum(excess, 0.0))
    mismatch = exact_dot(weights - samples.prior, standardised.whitened)
    return solution._replace(grad_norm=jnp.sqrt(excess**2 + jnp.sum(mismatch**2))), weights


def sample_weights(
    solution: DualSolution,
    reward: Rewards,
    features: Features,
    valid: Valid | None = None,
) -> Float[Array, " n"]:
    """Weigh the samples by exp((R - V(s)) / eta), times how much they count before.

    Args:
        solution: Temperature eta and baseline coefficients w, from `solve_dual` on the same samples.
        reward: Reward R of each sample.
        features: Baseline features phi of the context of each sample.
        valid: Which samples count; all by default. As numbers: how much each counts before its reward is
            seen, such as its importance weight. One whose reward or features are not finite never counts.

    Returns:
        Weights that sum to one, zero where a sample does not count; all zero if none does. They are what
        `valid` gives where the solution is not informative.

    Raises:
        ValueError: If shapes do not fit.

    Source: Abdolmaleki et al. 2016, the solution p(s, theta) below Eq. 12.
    """
    reward, features, prior = _checked_samples(_without_offset(reward, valid)[0], features, valid)
    solution = _checked_solution(solution, features)
    return _weights_of(solution, reward, features, prior)


def sample_kl(weights: Float[Array, " n"], valid: Valid | None = None) -> Scalar:
    """Return the relative entropy between weights and uniform ones, or those that the samples had before.

    Args:
        weights: Weights d that sum to one, zero where a sample does not count.
        valid: Which samples count, all by default; as numbers, how much each did before its reward was seen.

    Returns:
        sum d log(d / p), where p is `valid`, scaled to a sum of one; between 0 and log n if it is uniform.

    Raises:
        ValueError: If the shapes differ.
    """
    prior = jnp.ones_like(weights) if valid is None else checks.array("valid", valid)
    if weights.shape != prior.shape:
        raise ValueError(f"weights and valid have to have one shape, got {weights.shape} and {prior.shape}")
    prior = normalised(prior).astype(weights.dtype)
    # By terms of d log(d / p) - d + p, which are not negative but for rounding: those of sum d log(d / p)
    # would cancel.
    change = weights / jnp.where(prior > 0, prior, 1.0) - 1.0
    log_ratio = jnp.log1p(jnp.where(change > -1.0, change, 0.0))
    return jnp.maximum(jnp.sum(weights * log_ratio - prior * change, where=prior > 0), 0.0)


@jax.jit
def _weights_of(solution: DualSolution, reward: Array, features: Array, prior: Array) -> Array:
    return _weights(solution, _rescaled(reward, features, prior))


def _weights(solution: DualSolution, samples: "_Samples") -> Array:
    dtype = samples.reward.dtype
    coef = solution.baseline_coef.astype(dtype)
    coef = jnp.ldexp(coef, samples.feature_exponents - samples.reward_exponent)
    temperature = jnp.ldexp(jnp.asarray(solution.temperature, dtype), -samples.reward_exponent)
    temperature = jnp.maximum(temperature, jnp.finfo(dtype).tiny)
    advantage = (samples.reward - exact_dot(samples.features, coef)) / temperature
    # In print: p = q mu exp((R - V) / eta), up to a factor
    weights = _softmax(advantage, samples.prior)  # Eq. 12
    weights = jnp.where(solution.is_informative, weights, samples.prior)
    return jnp.where(samples.is_counted, weights, 0.0)


def _solution(guess: "_Guess", unit: Array, samples: "_Samples", is_informative: Array) -> DualSolution:
    """Return a point of the search in the units of the user, as far as the format can hold it."""
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


class _Samples(NamedTuple):
    """Samples in units that neither overflow nor underflow; all rows that do not count are zero."""

    reward: Array  # less the largest: from -1 to 0
    features: Array  # less their mean
    prior: Array  # sums to one; zero where a sample does not count
    is_counted: Array
    reward_exponent: Array  # the unit of the rewards is two to this power
    feature_exponents: Array  # and that of each feature
    largest: Array  # size of the largest reward before the shift


class _Standardised(NamedTuple):
    """What the search works with."""

    reward: Array  # from -1 to 0
    centred: Array  # features less their mean
    whitening: Array
    whitened: Array  # centred @ whitening: uncorrelated features of mean square one
    regression: Array  # coefficients of the rewards' regression, directions left out by whitening included
    prior: Array


class _Guess(NamedTuple):
    """A point on the way to the minimum, in units of the standardised samples."""

    temperature: Array
    baseline_coef: Array
    floor: Array  # of the temperature
    kl: Array  # of the weights
    is_active: Array
    is_settled: Array  # whether another round would find nothing to do
    num_steps: Array


def _first_guess(samples: _Standardised, kl_bound: Array) -> _Guess:
    """Return the solution for a small bound: a least-squares baseline, and the spread that it leaves."""
    coef = exact_dot(samples.whitening, exact_dot(samples.prior * samples.reward, samples.whitened))
    residual = _residual(samples, coef)
    # For a small bound the relative entropy is var(R - V) / (2 eta^2).
    temperature = jnp.sqrt(exact_dot(samples.prior, residual**2) / (2.0 * kl_bound))
    mean_size = -exact_dot(samples.prior, samples.reward)
    floor = _RESOLUTION * _eps(mean_size) * jnp.where(mean_size > 0, mean_size, 1.0)
    return _Guess(
        temperature=jnp.maximum(temperature, 2.0 * floor),
        baseline_coef=coef,
        floor=floor,
        kl=jnp.zeros_like(floor),
        is_active=jnp.ones((), bool),
        is_settled=jnp.zeros((), bool),
        num_steps=jnp.zeros((), jnp.int32),
    )


def _is_informative(samples: _Standardised, threshold: Array) -> Array:
    """Say whether a baseline, the best of all in the sense of least squares, leaves more than rounding."""
    residual = _residual(samples, samples.regression)
    sizes = exact_dot(jnp.abs(samples.centred), jnp.abs(samples.regression))
    rounding = _eps(sizes) * (_ROUNDING + _FIT_ROUNDING * jnp.max(sizes))
    return jnp.max(jnp.abs(residual)) > rounding + jnp.where(threshold > 0, threshold, 0.0)


def _residual(samples: _Standardised, baseline_coef: Array) -> Array:
    """Return what a baseline leaves of the rewards, less its mean; zero where a sample does not count."""
    residual = samples.reward - exact_dot(samples.centred, baseline_coef)
    for _ in range(2):  # the first mean is rounded in units of itself
        residual = jnp.where(samples.prior > 0, residual - exact_dot(samples.prior, residual), 0.0)
    return residual


def _search(first: _Guess, samples: _Standardised, kl_bound: Array) -> _Guess:
    """Improve a first guess, round by round; midway, give up a bound that is out of reach.

    One round is enough for well-behaved rewards. Where some are far worse than the others (falls), the scale
    and the baseline of all rewards say little of those that end up with a weight: each round takes both from
    the weights of the last.
    """

    def is_going_on(search: tuple[_Guess, Array, Array]) -> Array:
        guess, _, num_rounds = search
        return (num_rounds < 2 * _NUM_ROUNDS) & ~guess.is_settled

    def improve(search: tuple[_Guess, Array, Array]) -> tuple[_Guess, Array, Array]:
        guess, bound, num_rounds = search
        # Rounding decides among greedy weights: start again, and stop a little short of them.
        is_given_up = (num_rounds == _NUM_ROUNDS) & _misses(guess, kl_bound)
        bound = jnp.where(is_given_up, _NEARLY_GREEDY * guess.kl, bound)
        restart = first._replace(
            is_settled=jnp.zeros((), bool), is_active=jnp.zeros((), bool), num_steps=guess.num_steps
        )
        guess = jax.tree.map(lambda new, old: jnp.where(is_given_up, new, old), restart, guess)
        return _improve(guess, samples, bound), bound, num_rounds + 1

    start = (first, kl_bound, jnp.zeros((), jnp.int32))
    return lax.while_loop(is_going_on, improve, start)[0]


def _misses(guess: _Guess, kl_bound: Array) -> Array:
    """Say whether the weights fall short of the bound, as they do where no temperature reaches it."""
    return (guess.temperature <= 1.1 * guess.floor) | (guess.kl < 0.999 * kl_bound)


def _improve(guess: _Guess, samples: _Standardised, kl_bound: Array) -> _Guess:
    """Standardise the rewards by the last guess, and minimise the dual function of what is left."""
    floor = _temperature_floor(guess, samples)
    unit = jnp.maximum(guess.temperature, 2.0 * floor)
    share = floor / unit
    residual = _shift(_advantage(samples, unit, guess.baseline_coef), samples.prior)

    def temperature_of(variable: Array) -> Array:
        # The floor keeps the minimum finite where no temperature above zero reaches the bound.
        return share + (1.0 - share) * jnp.exp(variable)

    def objective(variables: Array) -> Array:
        log_temperature, coef = jnp.log(temperature_of(variables[0])), variables[1:]
        return _dual(log_temperature, coef, residual, samples.whitened, samples.prior, kl_bound)

    def hessian(variables: Array) -> Array:
        """Return the second derivatives of the objective, in a fraction of the time of `jax.hessian`."""
        temperature, coef = temperature_of(variables[0]), variables[1:]
        advantage = (residual - exact_dot(samples.whitened, coef)) / temperature
        by_temperature, by_both = _dual_hessian(temperature, advantage, samples, kl_bound)
        # Both derivatives of the temperature by its variable.
        change = temperature - share
        scale = jnp.ones_like(variables).at[0].set(change)
        return (scale[:, None] * by_both * scale[None, :]).at[0, 0].add(change * by_temperature)

    start = jnp.zeros(1 + samples.whitened.shape[1], residual.dtype)
    # In units of the temperature: weights change by factors up to e^10 times the whitened features.
    max_change = jnp.full_like(start, 10.0).at[0].set(2.0)
    minimum = minimise(objective, start, hessian=hessian, max_steps=40, max_change=max_change)
    change = temperature_of(minimum.point[0])
    improved = guess._replace(
        temperature=unit * change,
        baseline_coef=guess.baseline_coef + unit * exact_dot(samples.whitening, minimum.point[1:]),
        floor=floor,
        num_steps=guess.num_steps + minimum.num_steps,
    )
    improved = improved._replace(kl=sample_kl(_weigh(improved, samples), samples.prior))
    # Was the unit about right, then another round would be this one over again.
    is_settled = minimum.is_converged & (jnp.abs(jnp.log(change)) < 0.7) & ~_misses(improved, kl_bound)
    return improved._replace(is_settled=is_settled)


def _dual_hessian(
    temperature: Array, advantage: Array, samples: _Standardised, kl_bound: Array
) -> tuple[Array, Array]:
    """Return the derivative of the dual by the temperature, and the second ones by it and the coefficients.

    The latter are the weighted covariance of the advantages and the features, over the temperature.
    """
    log_weights = jnp.where(samples.prior > 0, advantage + _log(samples.prior), -jnp.inf)
    weights = jax.nn.softmax(log_weights)
    columns = jnp.concatenate([advantage[:, None], samples.whitened], axis=1)
    means = exact_dot(weights, columns)
    columns = columns - means[None, :]
    by_both = exact_dot(columns.T, weights[:, None] * columns) / temperature
    return kl_bound + logsumexp(log_weights) - means[0], by_both


def _temperature_floor(guess: _Guess, samples: _Standardised) -> Array:
    """Return the temperature below which rounding of the advantages would decide between samples."""
    # An advantage is a difference of these numbers and carries their rounding.
    size = jnp.abs(samples.reward) + exact_dot(jnp.abs(samples.centred), jnp.abs(guess.baseline_coef))
    mean_size = exact_dot(_weigh(guess, samples), size)
    lowered = jnp.maximum(_RESOLUTION * _eps(mean_size) * mean_size, 1e-3 * guess.floor)
    return jnp.where(mean_size > 0, lowered, guess.floor)


def _weigh(guess: _Guess, samples: _Standardised) -> Array:
    return _softmax(_advantage(samples, guess.temperature, guess.baseline_coef), samples.prior)


def _rescaled(reward: Array, features: Array, prior: Array) -> _Samples:
    """Shift rewards and centre features, in units that bear every number of the format."""
    is_counted = _is_counted(reward, features, prior)
    reward, features, prior = _mask(reward, features, prior)
    largest = jnp.max(jnp.abs(reward))
    # Powers of two round nothing. Half the size of the rewards, as a difference may be twice as large.
    reward_exponent = jnp.frexp(largest)[1] + 1
    feature_exponents = jnp.frexp(jnp.max(jnp.abs(features), axis=0))[1]
    return _Samples(
        reward=_shift(times_power(reward, -reward_exponent), prior),
        features=centre_columns(times_power(features, -feature_exponents[None, :]), prior),
        prior=prior,
        is_counted=is_counted,
        reward_exponent=reward_exponent,
        feature_exponents=feature_exponents,
        largest=jnp.ldexp(largest, -reward_exponent),
    )


def _standardise(samples: _Samples) -> tuple[_Standardised, Array]:
    """Return standardised samples, and the unit of their rewards."""
    spread = jnp.max(jnp.abs(samples.reward))
    unit = jnp.where(spread > 0, spread, 1.0)
    # Features whose coefficients the format cannot hold are left out.
    exponents = samples.feature_exponents + jnp.frexp(jnp.max(jnp.abs(samples.features), axis=0))[1]
    exponents = samples.reward_exponent + jnp.frexp(unit)[1] - exponents
    is_usable = jnp.abs(exponents) < jnp.finfo(unit.dtype).maxexp - _SPARE_EXPONENTS
    centred = jnp.where(is_usable[None, :], samples.features, 0.0)
    # Directions with less spread are left out: in V they would be differences of large numbers.
    reward, prior = samples.reward / unit, samples.prior
    target = reward - exact_dot(prior, reward)
    matrix, coef = whitened_regression(centred, target, prior, least_spread=jnp.sqrt(_eps(unit)))
    return _Standardised(reward, centred, matrix, exact_dot(centred, matrix), coef, prior), unit


def _advantage(samples: _Standardised, temperature: Array, baseline_coef: Array) -> Array:
    return (samples.reward - exact_dot(samples.centred, baseline_coef)) / temperature


def _softmax(advantage: Array, prior: Array) -> Array:
    return jax.nn.softmax(jnp.where(prior > 0, advantage + _log(prior), -jnp.inf))


def _log(prior: Array) -> Array:
    """Return logarithms, zero where a sample does not count.

    They belong into the exponent: times the exponential, a small prior with a large advantage makes all other
    terms underflow.
    """
    return jnp.log(jnp.where(prior > 0, prior, 1.0))


def _shift(values: Array, prior: Array) -> Array:
    """Subtract the largest of the values that count, which changes no weight; the others become zero."""
    largest = lax.stop_gradient(jnp.max(jnp.where(prior > 0, values, -jnp.inf)))
    return jnp.where(prior > 0, values - largest, 0.0)


def _mask(reward: Array, features: Array, prior: Array) -> tuple[Array, Array, Array]:
    """Put zeros where a sample does not count; where none does, all do equally, as zeros.

    It comes before any arithmetic: neither values nor gradients see what a sample that does not count holds.
    The prior is scaled to a sum of one.
    """
    counts = _is_counted(reward, features, prior)
    prior = jnp.where(counts, prior, 0.0)
    reward = jnp.where(counts, reward, 0.0)
    features = jnp.where(counts[:, None], features, 0.0)
    prior = normalised(jnp.where(jnp.any(counts), prior, 1.0))  # in its own format, then in that of the rest
    return reward, features, prior.astype(reward.dtype)


def _is_counted(reward: Array, features: Array, prior: Array) -> Array:
    is_known = jnp.isfinite(reward) & jnp.all(jnp.isfinite(features), axis=1)
    return (as_bits(prior) > 0) & jnp.isfinite(prior) & is_known


def _eps(*values: Any) -> float:
    """Return the rounding of the coarsest format of these arrays, among those that are floats."""
    kinds = [getattr(x, "dtype", np.dtype(bool)) for x in values]
    kinds = [kind for kind in kinds if jnp.issubdtype(kind, jnp.floating)]
    return max(float(jnp.finfo(kind).eps) for kind in kinds)


def _without_offset(reward: Any, valid: Any) -> tuple[Any, float | None]:
    """Subtract the largest reward before jax narrows float64, as rewards with a large offset need it.

    Returns:
        The rewards, and the size of their rounding; as they are, and None, if there is nothing to narrow.
    """
    values = None if isinstance(reward, jax.Array) else _on_host(reward)
    is_wide = values is not None and (values.dtype.kind in "iu" or values.dtype == np.float64)
    if values is None or not is_wide or values.ndim != 1:
        return reward, None
    values = values.astype(np.float64)
    counts, prior = np.abs(values) <= checks.FLOAT32_MAX, None if valid is None else _on_host(valid)
    if prior is not None and prior.shape == values.shape and prior.dtype.kind in "biuf":
        counts = counts & (prior > 0)
    known = values[counts]
    # What spreads over all of the format loses nothing by an offset.
    if known.size == 0 or known.max() - known.min() > checks.FLOAT32_MAX:
        return values, None
    return values - known.max(), _ROUNDING * _eps(values) * float(np.max(np.abs(known)))


def _on_host(values: Any) -> np.ndarray | None:
    """Return an array of NumPy, None where values are traced or are no array."""
    try:
        return np.asarray(values)
    except (TypeError, ValueError):
        return None


def _checked_samples(reward: Any, features: Any, valid: Any) -> tuple[Array, Array, Array]:
    """Return rewards and features in one format, and how much each sample counts, after checking shapes."""
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
