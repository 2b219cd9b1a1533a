"""Minimise the dual function in rounds, each of which standardises the rewards by the weights of the last.

One round is enough for well-behaved rewards. Where some rewards are far below the others (falls), the scale
and baseline of all rewards say little about the samples that get a weight, and more rounds are needed.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.special import logsumexp

from creps_jax.numerics.linalg import exact_dot
from creps_jax.numerics.minimise import minimise
from creps_jax.search.dual_scaling import Standardised, advantage, eps, residual
from creps_jax.search.weights import log_prior, relative_entropy, shift, softmax_weights
from creps_jax.typing import Array, Scalar

__all__ = ["DualFunction", "Guess", "first_guess", "minimise_in_rounds"]

DualFunction = Callable[[Array, Array, Array, Array, Array, Array], Scalar]
"""`(log temperature, baseline coefficients, rewards, features, prior, KL bound) -> g`, Eq. 13."""

_NUM_ROUNDS = 4
"""Largest number of rounds before and after a bound that is out of reach is replaced."""
_RESOLUTION = 42.0
"""Lowest temperature, in units of the rounding error of the advantages."""
_NEARLY_GREEDY = 0.99
"""Bound that replaces one that is out of reach, as a share of the largest possible relative entropy."""


class Guess(NamedTuple):
    """An estimate of the minimum, in units of the standardised samples."""

    temperature: Array
    baseline_coef: Array
    floor: Array  # of the temperature
    kl: Array  # of the weights
    is_active: Array
    is_settled: Array  # whether another round would change nothing
    num_steps: Array


def first_guess(samples: Standardised, kl_bound: Array) -> Guess:
    """Return the solution for a small bound: the least-squares baseline, and eta from the residual spread."""
    coef = exact_dot(samples.whitening, exact_dot(samples.prior * samples.reward, samples.whitened))
    rest = residual(samples, coef)
    # For a small bound the relative entropy is var(R - V) / (2 eta^2).
    temperature = jnp.sqrt(exact_dot(samples.prior, rest**2) / (2.0 * kl_bound))
    mean_size = -exact_dot(samples.prior, samples.reward)
    floor = _RESOLUTION * eps(mean_size) * jnp.where(mean_size > 0, mean_size, 1.0)
    return Guess(
        temperature=jnp.maximum(temperature, 2.0 * floor),
        baseline_coef=coef,
        floor=floor,
        kl=jnp.zeros_like(floor),
        is_active=jnp.ones((), bool),
        is_settled=jnp.zeros((), bool),
        num_steps=jnp.zeros((), jnp.int32),
    )


def minimise_in_rounds(dual: DualFunction, first: Guess, samples: Standardised, kl_bound: Array) -> Guess:
    """Improve a first guess until it is settled; replace the bound midway if it is out of reach."""

    def is_running(search: tuple[Guess, Array, Array]) -> Array:
        guess, _, num_rounds = search
        return (num_rounds < 2 * _NUM_ROUNDS) & ~guess.is_settled

    def advance(search: tuple[Guess, Array, Array]) -> tuple[Guess, Array, Array]:
        guess, bound, num_rounds = search
        # Rounding decides among greedy weights: start again with a bound slightly short of them.
        is_given_up = (num_rounds == _NUM_ROUNDS) & _misses(guess, kl_bound)
        bound = jnp.where(is_given_up, _NEARLY_GREEDY * guess.kl, bound)
        restart = first._replace(
            is_settled=jnp.zeros((), bool), is_active=jnp.zeros((), bool), num_steps=guess.num_steps
        )
        guess = jax.tree.map(lambda new, old: jnp.where(is_given_up, new, old), restart, guess)
        return _improved(dual, guess, samples, bound), bound, num_rounds + 1

    start = (first, kl_bound, jnp.zeros((), jnp.int32))
    return lax.while_loop(is_running, advance, start)[0]


def _misses(guess: Guess, kl_bound: Array) -> Array:
    """Return whether the relative entropy is below its bound, as where no temperature reaches the bound."""
    return (guess.temperature <= 1.1 * guess.floor) | (guess.kl < 0.999 * kl_bound)


def _improved(dual: DualFunction, guess: Guess, samples: Standardised, kl_bound: Array) -> Guess:
    """Standardise the rewards by the last guess, and minimise the dual function of the residuals."""
    floor = _temperature_floor(guess, samples)
    unit = jnp.maximum(guess.temperature, 2.0 * floor)
    share = floor / unit
    rest = shift(advantage(samples, unit, guess.baseline_coef), samples.prior)

    def temperature_of(variable: Array) -> Array:
        # The floor keeps the minimum finite where no temperature above zero reaches the bound.
        return share + (1.0 - share) * jnp.exp(variable)

    def objective(variables: Array) -> Array:
        log_temperature, coef = jnp.log(temperature_of(variables[0])), variables[1:]
        return dual(log_temperature, coef, rest, samples.whitened, samples.prior, kl_bound)

    def hessian(variables: Array) -> Array:
        """Return the second derivatives of the objective, much faster than `jax.hessian`."""
        temperature, coef = temperature_of(variables[0]), variables[1:]
        scaled = (rest - exact_dot(samples.whitened, coef)) / temperature
        by_temperature, by_both = _dual_derivatives(temperature, scaled, samples, kl_bound)
        # The first and second derivative of the temperature by its variable are equal.
        change = temperature - share
        scale = jnp.ones_like(variables).at[0].set(change)
        return (scale[:, None] * by_both * scale[None, :]).at[0, 0].add(change * by_temperature)

    start = jnp.zeros(1 + samples.whitened.shape[1], rest.dtype)
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
    improved = improved._replace(kl=relative_entropy(_weights(improved, samples), samples.prior))
    # If the unit was about right, another round would repeat this one.
    is_settled = minimum.is_converged & (jnp.abs(jnp.log(change)) < 0.7) & ~_misses(improved, kl_bound)
    return improved._replace(is_settled=is_settled)


def _dual_derivatives(
    temperature: Array, scaled_advantage: Array, samples: Standardised, kl_bound: Array
) -> tuple[Array, Array]:
    """Return derivatives of Eq. 13: the first by the temperature, the second ones by all variables.

    The second derivatives are the weighted covariance of advantages and features over the temperature.
    """
    log_weights = jnp.where(samples.prior > 0, scaled_advantage + log_prior(samples.prior), -jnp.inf)
    weights = jax.nn.softmax(log_weights)
    columns = jnp.concatenate([scaled_advantage[:, None], samples.whitened], axis=1)
    means = exact_dot(weights, columns)
    columns = columns - means[None, :]
    by_both = exact_dot(columns.T, weights[:, None] * columns) / temperature
    return kl_bound + logsumexp(log_weights) - means[0], by_both


def _temperature_floor(guess: Guess, samples: Standardised) -> Array:
    """Return the temperature below which the rounding of the advantages would decide between samples."""
    # An advantage is a difference of numbers of this size, and has their rounding error.
    size = jnp.abs(samples.reward) + exact_dot(jnp.abs(samples.centred), jnp.abs(guess.baseline_coef))
    mean_size = exact_dot(_weights(guess, samples), size)
    lowered = jnp.maximum(_RESOLUTION * eps(mean_size) * mean_size, 1e-3 * guess.floor)
    return jnp.where(mean_size > 0, lowered, guess.floor)


def _weights(guess: Guess, samples: Standardised) -> Array:
    return softmax_weights(advantage(samples, guess.temperature, guess.baseline_coef), samples.prior)
