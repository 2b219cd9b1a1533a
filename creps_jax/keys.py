"""Recognise random keys, and convert them to keys whose numbers do not depend on the devices."""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["key_shape", "threefry"]

_THREEFRY = "threefry2x32"


def key_shape(value: Any) -> tuple[int, ...] | None:
    """Return the shape of an array of keys: () for a single key, None for a value that is not a key.

    Keys are typed keys of any implementation, or rows of uint32 with the data of the default implementation.
    """
    if not isinstance(value, np.ndarray | jax.Array):
        return None
    if _is_typed(value):
        return value.shape
    data_shape = _data_shape(_default_implementation())
    num_axes = value.ndim - len(data_shape)
    is_raw = value.dtype == np.uint32 and num_axes >= 0 and value.shape[num_axes:] == data_shape
    return value.shape[:num_axes] if is_raw else None


def threefry(key: Any) -> Any:
    """Convert a random key, or an array of keys, to the implementation threefry2x32.

    Under `vmap` the numbers of some implementations, such as rbg, depend on the size of the batch: results
    would depend on the number of devices. The numbers of threefry2x32 depend on the key only.

    Args:
        key: Key or keys; keys of threefry2x32 are returned unchanged.

    Returns:
        Typed keys, computed from all words of the data of the given keys.
    """
    implementation = jax.random.key_impl(key) if _is_typed(key) else _default_implementation()
    if implementation == _THREEFRY:
        return key
    typed = key if _is_typed(key) else jax.random.wrap_key_data(jnp.asarray(key))
    data = jax.random.key_data(typed)
    words = data.reshape(*typed.shape, math.prod(data.shape[typed.ndim :]))
    derive = _derived
    for _ in typed.shape:
        derive = jax.vmap(derive)
    return derive(words)


def _derived(words: jax.Array) -> jax.Array:
    """Fold all words (w,) of a key's data into one key."""
    start = jax.random.key(0, impl=_THREEFRY)
    return jax.lax.scan(lambda key, word: (jax.random.fold_in(key, word), None), start, words)[0]


def _is_typed(value: Any) -> bool:
    return jnp.issubdtype(value.dtype, jax.dtypes.prng_key)


def _default_implementation() -> Any:
    return jax.config.jax_default_prng_impl  # type: ignore[attr-defined]


@functools.cache
def _data_shape(implementation: Any) -> tuple[int, ...]:
    """Return the shape of the uint32 data of one key."""
    return jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0, impl=implementation))).shape
