"""A Gaussian policy whose mean is a small network of the context.

The mean is `coef' h(u)`, where u are the context variables, scaled to -1 to 1, and h(u) are a constant and
the outputs of the last layer of tanh units. The covariance is the same for all contexts. Given h, the policy
is a `LinearGaussian`, whose functions it uses.
"""

import math
import numbers
from typing import Any

import jax
import jax.numpy as jnp

from creps_jax import checks
from creps_jax.keys import threefry
from creps_jax.numerics.linalg import divided
from creps_jax.policies import gaussian
from creps_jax.policies.base import Policy
from creps_jax.policies.features import FeatureMap, scaled_polynomial_features
from creps_jax.policies.gaussian import start_policy
from creps_jax.policies.network_fit import NetworkFit
from creps_jax.policies.network_mean import Layer, NetworkGaussian, checked, in_units, mean_rows, units
from creps_jax.typing import Array, PRNGKey, Scalar, VectorLike

__all__ = ["Layer", "NetworkGaussian", "network_policy", "start_network"]

_BASELINE_DEGREE = 2
"""Degree of the features, which also serve as those of the baseline."""
_MOST_UNITS = 10_000
"""Largest number of units of a layer."""


@checks.arguments
def network_policy(
    low: VectorLike,
    high: VectorLike,
    *,
    steps: int = 100,
    learning_rate: float | int = 0.1,
    mean_kl_bound: float | int = 1.0,
    cov_kl_bound: float | int = 0.05,
    entropy_loss_bound: float | int | None = None,
) -> Policy:
    """Make the kind of policy whose mean is a small network of the context.

    `creps(network_policy(low, high))` searches with it; `start_network` makes the first state. The default
    size of the archive is ten samples for each unit of the last layer and each parameter.

    The fit takes a fixed number of steps of Adam from the old weights on the weighted log-likelihood, in
    which parameters are in units of the old covariance, whatever their own units. Then it goes back towards
    the old weights as far as the bound on the change of the mean requires, and moves the covariance within
    its bounds as `bounded_ml` does.

    Args:
        low: Lower end of the range of each context variable.
        high: Upper end of the range of each context variable.
        steps: Number of training steps of an update.
        learning_rate: Learning rate of Adam in the first step; it falls to zero by a cosine.
        mean_kl_bound: Largest relative entropy of the new policy to the old one that the change of the mean
            causes, averaged over the contexts, in nats.
        cov_kl_bound: The same for the change of the covariance.
        entropy_loss_bound: Largest loss of differential entropy, in nats; by default only `cov_kl_bound`
            limits it.

    Returns:
        The record of its functions; those of equal settings are equal. Its features are the polynomials of
        degree 2 of the scaled context, which are good features of a baseline. The network has the scaled
        context alone as its input.

    Raises:
        ValueError: If low and high are not vectors of one length with low < high, or a setting is not above
            zero.
    """
    bounds = {"mean_kl_bound": mean_kl_bound, "cov_kl_bound": cov_kl_bound}
    if entropy_loss_bound is not None:
        bounds["entropy_loss_bound"] = entropy_loss_bound
    for name, value in {"learning_rate": learning_rate, **bounds}.items():
        checks.number(name, value, above=0.0)
    fit = NetworkFit(steps, learning_rate, mean_kl_bound, cov_kl_bound, entropy_loss_bound)
    return Policy(
        scaled_polynomial_features(low, high, _BASELINE_DEGREE),
        mean=mean_rows,
        sample=_sample,
        log_prob=_log_prob,
        kl=_kl,
        entropy=_entropy,
        fit=fit,
        blend=gaussian.blend,
        noise=_noise,
        checked=checked,
        num_features=_num_features,
    )


@checks.arguments
def start_network(
    key: PRNGKey,
    features: FeatureMap,
    theta_dim: int,
    *,
    hidden: int | tuple[int, ...] = 32,
    mean: VectorLike = 0.0,
    std: VectorLike = 1.0,
) -> NetworkGaussian:
    """Make the first state of a search with a `network_policy`: the same policy for every context.

    Args:
        key: Random key of the weights of the hidden layers.
        features: The features of the policy, `network_policy(...).features`.
        theta_dim: Number d of parameters.
        hidden: Number of tanh units of each hidden layer: a number for one layer, or one for each.
        mean: Mean of the free parameters, as in `start_policy`.
        std: Their standard deviations, likewise.

    Returns:
        The state; its parameters are independent of each other.

    Raises:
        ValueError: If a layer has no unit or too many, or for what `start_policy` refuses.
    """
    sizes = _sizes(hidden)
    num = sizes[-1]
    constant = (1.0,) + (0.0,) * num
    last = FeatureMap(_no_function, 1 + num, features.context_dim, constant=constant)
    coef, cov_chol = start_policy(last, theta_dim, mean=mean, std=std)
    layers = []
    num_inputs, key = checks.count("features.context_dim", features.context_dim), threefry(key)
    for size, layer_key in zip(sizes, jax.random.split(key, len(sizes)), strict=True):
        weight_key, bias_key = jax.random.split(layer_key)
        # Inputs from -1 to 1 have a mean square of 1/3.
        weight = math.sqrt(3.0 / num_inputs) * jax.random.normal(weight_key, (num_inputs, size))
        layers.append(Layer(weight, jax.random.uniform(bias_key, (size,), minval=-1.0, maxval=1.0)))
        num_inputs = size
    return NetworkGaussian(tuple(layers), coef, cov_chol)


def _sizes(hidden: Any) -> tuple[int, ...]:
    sizes = tuple(hidden) if isinstance(hidden, tuple | list) else (hidden,)
    is_whole = all(isinstance(size, numbers.Integral) and not isinstance(size, bool) for size in sizes)
    if not sizes or not is_whole or not all(1 <= size <= _MOST_UNITS for size in sizes):
        raise ValueError(
            f"hidden must be a number of units from 1 to {_MOST_UNITS}, or one for each layer, "
            f"got {checks.shown(hidden)}"
        )
    return tuple(map(int, sizes))


def _no_function(context: Array) -> Array:
    raise NotImplementedError


def _sample(key: PRNGKey, state: NetworkGaussian, features: Array) -> Array:
    return gaussian.sample_rows(key, in_units(state), units(state.layers, features))


def _log_prob(state: NetworkGaussian, features: Array, theta: Array) -> Array:
    return gaussian.log_prob_rows(in_units(state), units(state.layers, features), theta)


def _kl(state: NetworkGaussian, reference: NetworkGaussian, features: Array) -> Array:
    # Only the shift of the mean depends on the context.
    linear = in_units(state)
    without_shift = gaussian.kl(linear, in_units(reference), jnp.zeros_like(linear.coef[:, 0]))
    shifts = divided(mean_rows(state, features) - mean_rows(reference, features), reference.cov_chol.T)
    return without_shift + 0.5 * jnp.sum(shifts**2, axis=1)


def _entropy(state: NetworkGaussian) -> Scalar:
    return gaussian.entropy(in_units(state))


def _num_features(state: NetworkGaussian) -> int:
    return state.coef.shape[0]


def _noise(state: NetworkGaussian, features: Array, theta: Array) -> Array:
    return gaussian.whitened(in_units(state), units(state.layers, features), theta)
