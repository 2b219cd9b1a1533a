"""Every key of jax is one, and becomes a key of threefry2x32 that follows from all its data."""

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax import checks
from creps_jax.keys import key_shape, threefry
from creps_jax.typing import PRNGKey

IMPLEMENTATIONS = {"threefry2x32": 2, "rbg": 4, "unsafe_rbg": 4}
implementations = pytest.mark.parametrize(("implementation", "num_words"), IMPLEMENTATIONS.items())


@checks.arguments
def annotated(key: PRNGKey):
    return key


@implementations
@pytest.mark.parametrize("num_axes", [0, 1])
def test_keys_of_every_implementation_are_keys(implementation, num_words, num_axes):
    typed = jax.random.key(0, impl=implementation)
    with jax.default_prng_impl(implementation):
        raw = jax.random.PRNGKey(0)
        assert raw.shape == (num_words,)
        for key in (typed, raw):
            key = jax.random.split(key, 3) if num_axes else key
            assert checks.key("key", key, num_axes=num_axes) is key
            assert jax.jit(lambda key: jnp.zeros(key_shape(key)))(key).shape == (3,) * num_axes
            if not num_axes:
                assert annotated(key) is key
                assert annotated(np.asarray(raw)) is not None
        for wrong in (num_words - 1, num_words + 1):
            with pytest.raises(ValueError, match=rf"key must be a random key, .* got uint32\({wrong},\)"):
                annotated(jnp.zeros(wrong, jnp.uint32))


@pytest.mark.parametrize("value", [3, None, "key", jnp.zeros(2), np.uint32(7), np.zeros(2, np.int32)])
def test_other_values_are_no_keys(value):
    assert key_shape(value) is None


def test_a_threefry_key_is_returned_as_it_is():
    for key in (jax.random.key(4), jax.random.PRNGKey(4), np.asarray(jax.random.PRNGKey(4))):
        assert threefry(key) is key
    assert not jax.make_jaxpr(threefry)(jax.random.key(4)).eqns


@pytest.mark.parametrize("implementation", ["rbg", "unsafe_rbg"])
def test_all_words_of_a_key_matter(implementation):
    words = np.zeros((9, 4), np.uint32)
    for word in range(4):
        words[1 + word, word] = 1
        words[5 + word, word] = 2**31
    keys = jax.random.wrap_key_data(jnp.asarray(words), impl=implementation)
    derived = np.asarray(jax.random.key_data(threefry(keys)))
    assert derived.shape == (9, 2) and len(np.unique(derived, axis=0)) == 9


@pytest.mark.parametrize("implementation", ["rbg", "unsafe_rbg"])
@pytest.mark.parametrize("is_raw", [False, True], ids=["typed", "raw"])
def test_derived_keys_do_not_depend_on_the_batch(implementation, is_raw):
    with jax.default_prng_impl(implementation):
        keys = jax.random.split((jax.random.PRNGKey if is_raw else jax.random.key)(1), 6)
        expected = jnp.stack([threefry(key) for key in keys])
        batches = [jax.vmap(threefry)(keys), jax.jit(jax.vmap(threefry))(keys)]
        if not is_raw:
            batches += [threefry(keys), threefry(keys.reshape(2, 3)).reshape(6)]
        else:
            batches += [threefry(keys), threefry(np.asarray(keys))]
    for batch in batches:
        assert jax.random.key_impl(batch) == "threefry2x32"
        assert (batch == expected).all()


@pytest.mark.parametrize("key_shape_of_one", [(1,), (3,), (2, 2)])
def test_an_implementation_of_ones_own_is_as_good(key_shape_of_one):
    size = int(np.prod(key_shape_of_one))
    implementation = jax.extend.random.define_prng_impl(
        key_shape=key_shape_of_one,
        seed=lambda seed: jnp.full(key_shape_of_one, seed, jnp.uint32),
        split=lambda key, shape: jnp.broadcast_to(key, (*shape, *key_shape_of_one)),
        random_bits=lambda key, width, shape: jnp.zeros(shape, jnp.uint32),
        fold_in=lambda key, data: key,
        name=f"own_{size}",
        tag=f"own{size}",
    )
    keys = jax.random.wrap_key_data(
        jnp.arange(2 * size, dtype=jnp.uint32).reshape(2, *key_shape_of_one), impl=implementation
    )
    assert checks.key("keys", keys, num_axes=1) is keys
    derived = threefry(keys)
    assert derived.shape == (2,) and jax.random.key_impl(derived) == "threefry2x32"
    assert derived[0] != derived[1]
