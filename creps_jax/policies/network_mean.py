"""The record of a Gaussian policy whose mean is a network, and its mean: all that using such a policy needs.

Learning it, in `network.py`, also needs optax, which takes long to import.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from creps_jax import checks
from creps_jax.numerics.linalg import exact_dot
from creps_jax.policies import gaussian
from creps_jax.policies.features import FeatureMap
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.typing import Array, Float

__all__ = ["Layer", "NetworkGaussian", "checked", "in_units", "mean_rows", "units"]

Layers = Any
"""A pair of weight and bias for each layer, such as the `layers` of a `NetworkGaussian`."""


class Layer(NamedTuple):
    """A layer of tanh units: `tanh(x weight + bias)`."""

    weight: Float[Array, "i o"]
    bias: Float[Array, " o"]


class NetworkGaussian(NamedTuple):
    """The policy pi(theta | s) = N(theta | coef' h(s), cov_chol cov_chol')."""

    layers: tuple[Layer, ...]
    """The layers of tanh units, from the context on."""
    coef: Float[Array, "k d"]
    """One row for the constant, and one for each unit of the last layer; one column for each parameter."""
    cov_chol: Float[Array, "d d"]
    """The lower Cholesky factor of the covariance; its diagonal is positive."""


def units(layers: Layers, features: Float[Array, "n p"]) -> Float[Array, "n k"]:
    """Return the constant and the outputs of the last layer for the features of n contexts."""
    # The features are the constant, the scaled context, and its products.
    outputs = features[:, 1 : 1 + layers[0][0].shape[0]]
    for weight, bias in layers:
        outputs = jnp.tanh(exact_dot(outputs, weight) + bias[None, :])
    return jnp.concatenate([features[:, :1], outputs], axis=1)


def in_units(state: NetworkGaussian) -> LinearGaussian:
    """Return the policy as one that is linear in the units of the last layer."""
    return LinearGaussian(state.coef, state.cov_chol)


def mean_rows(state: NetworkGaussian, features: Array) -> Array:
    """Return the mean parameters for rows of features."""
    return gaussian.mean_rows(in_units(state), units(state.layers, features))


def checked(name: str, state: Any, features: FeatureMap) -> NetworkGaussian:
    """Return a state in one precision, after checking that it fits the features.

    Raises:
        ValueError: If it does not, is not finite, or `cov_chol` is no Cholesky factor.
    """
    checks.instance(name, state, NetworkGaussian)
    if not isinstance(state.layers, tuple) or not state.layers:
        raise ValueError(f"{name}.layers must be a tuple of layers, got {checks.shown(state.layers)}")
    size, layers = features.context_dim, []
    for index, layer in enumerate(state.layers):
        checks.instance(f"{name}.layers[{index}]", layer, Layer)
        weight = checks.array(f"{name}.layers[{index}].weight", layer.weight, (size, "o"))
        size = weight.shape[1]
        layers.append(Layer(weight, checks.array(f"{name}.layers[{index}].bias", layer.bias, (size,))))
    coef = checks.array(f"{name}.coef", state.coef, (1 + size, "d"))
    cov_chol = checks.array(f"{name}.cov_chol", state.cov_chol, (coef.shape[1],) * 2)
    state = NetworkGaussian(tuple(layers), coef, cov_chol)
    dtype = jnp.result_type(*jax.tree.leaves(state))
    for path, leaf in jax.tree.leaves_with_path(state):
        checks.finite(name + jax.tree_util.keystr(path), leaf)
    state = jax.tree.map(lambda leaf: checks.converted(leaf, dtype), state)
    gaussian.check_cov_chol(f"{name}.cov_chol", state.cov_chol)
    return state
