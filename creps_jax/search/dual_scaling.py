"""Scale samples for the dual: units that neither overflow nor underflow, uncorrelated features, rounding.

Units of rewards and features are powers of two, which round nothing. Differences of rewards that may be
rounding errors are separated from differences that carry information.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax import checks
from creps_jax.numerics.linalg import centre_columns, exact_dot, times_power, whitened_regression
from creps_jax.search.weights import is_counted, mask, shift
from creps_jax.typing import Array

__all__ = [
    "ROUNDING",
    "Samples",
    "Standardised",
    "advantage",
    "eps",
    "exceeds_rounding",
    "rescale",
    "residual",
    "standardise",
    "without_offset",
]

ROUNDING = 1.75
"""Largest rounding error of a difference, in units of the precision of its terms."""
_FIT_ROUNDING = 4.0
"""Largest rounding error of a baseline, in units of the precision of its terms."""
_SPARE_EXPONENTS = 8
"""Margin, in powers of two, between the expected size of coefficients and the limits of the format."""


class Samples(NamedTuple):
    """Samples in units that neither overflow nor underflow; rows of samples that do not count are zero."""

    reward: Array  # minus the largest: from -1 to 0
    features: Array  # minus their mean
    prior: Array  # sums to one; zero where a sample does not count
    is_counted: Array
    reward_exponent: Array  # the unit of the rewards is two to this power
    feature_exponents: Array  # the unit of each feature, likewise
    largest: Array  # size of the largest reward before the shift


class Standardised(NamedTuple):
    """Standardised samples, on which the dual function is minimised."""

    reward: Array  # from -1 to 0
    centred: Array  # features minus their mean
    whitening: Array
    whitened: Array  # centred @ whitening: uncorrelated features of mean square one
    regression: Array  # least-squares coefficients of the rewards, in all directions of the features
    prior: Array


def rescale(reward: Array, features: Array, prior: Array) -> Samples:
    """Shift rewards, centre features, and choose units in which all numbers of the format are safe."""
    counts = is_counted(reward, features, prior)
    reward, features, prior = mask(reward, features, prior)
    largest = jnp.max(jnp.abs(reward))
    # Half the size of the rewards, as a difference may be twice as large.
    reward_exponent = jnp.frexp(largest)[1] + 1
    feature_exponents = jnp.frexp(jnp.max(jnp.abs(features), axis=0))[1]
    return Samples(
        reward=shift(times_power(reward, -reward_exponent), prior),
        features=centre_columns(times_power(features, -feature_exponents[None, :]), prior),
        prior=prior,
        is_counted=counts,
        reward_exponent=reward_exponent,
        feature_exponents=feature_exponents,
        largest=jnp.ldexp(largest, -reward_exponent),
    )


def standardise(samples: Samples) -> tuple[Standardised, Array]:
    """Return standardised samples, and the unit of their rewards."""
    spread = jnp.max(jnp.abs(samples.reward))
    unit = jnp.where(spread > 0, spread, 1.0)
    # Leave out features whose coefficients the format cannot hold.
    exponents = samples.feature_exponents + jnp.frexp(jnp.max(jnp.abs(samples.features), axis=0))[1]
    exponents = samples.reward_exponent + jnp.frexp(unit)[1] - exponents
    is_usable = jnp.abs(exponents) < jnp.finfo(unit.dtype).maxexp - _SPARE_EXPONENTS
    centred = jnp.where(is_usable[None, :], samples.features, 0.0)
    # Whitening leaves out directions with less spread: V would be a difference of large numbers there.
    reward, prior = samples.reward / unit, samples.prior
    target = reward - exact_dot(prior, reward)
    matrix, coef = whitened_regression(centred, target, prior, least_spread=jnp.sqrt(eps(unit)))
    return Standardised(reward, centred, matrix, exact_dot(centred, matrix), coef, prior), unit


def advantage(samples: Standardised, temperature: Array, baseline_coef: Array) -> Array:
    """Return (R - V) / eta."""
    return (samples.reward - exact_dot(samples.centred, baseline_coef)) / temperature


def residual(samples: Standardised, baseline_coef: Array) -> Array:
    """Return rewards minus baseline, minus the mean of that; zero where a sample does not count."""
    difference = samples.reward - exact_dot(samples.centred, baseline_coef)
    for _ in range(2):  # the rounding error of the first mean is relative to that mean
        difference = jnp.where(samples.prior > 0, difference - exact_dot(samples.prior, difference), 0.0)
    return difference


def exceeds_rounding(samples: Standardised, threshold: Array) -> Array:
    """Return whether the least-squares baseline leaves more of the rewards than rounding and `threshold`."""
    rest = residual(samples, samples.regression)
    sizes = exact_dot(jnp.abs(samples.centred), jnp.abs(samples.regression))
    rounding = eps(sizes) * (ROUNDING + _FIT_ROUNDING * jnp.max(sizes))
    return jnp.max(jnp.abs(rest)) > rounding + jnp.where(threshold > 0, threshold, 0.0)


def eps(*values: Any) -> float:
    """Return the machine epsilon of the coarsest floating-point format of these arrays."""
    kinds = [getattr(x, "dtype", np.dtype(bool)) for x in values]
    kinds = [kind for kind in kinds if jnp.issubdtype(kind, jnp.floating)]
    return max(float(jnp.finfo(kind).eps) for kind in kinds)


def without_offset(reward: Any, valid: Any) -> tuple[Any, float | None]:
    """Subtract the largest reward in float64, before jax narrows the rewards: a large offset loses no digits.

    Returns:
        The rewards, and their rounding error; the rewards unchanged, and None, if jax does not narrow them.
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
    # Rewards that span the whole format lose nothing by an offset.
    if known.size == 0 or known.max() - known.min() > checks.FLOAT32_MAX:
        return values, None
    return values - known.max(), ROUNDING * eps(values) * float(np.max(np.abs(known)))


def _on_host(values: Any) -> np.ndarray | None:
    """Return an array of NumPy; None if the values are traced or not an array."""
    try:
        return np.asarray(values)
    except (TypeError, ValueError):
        return None
