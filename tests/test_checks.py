"""Checks speak where a value is known, and are silent and free where it is traced."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax import checks
from creps_jax.typing import Array, Float, PRNGKey, ScalarLike


def test_checks_add_nothing_to_a_program():
    def checked(key, x, size):
        checks.key("key", key)
        checks.number("size", size, above=0.0)
        return checks.finite("x", checks.array("x", x, ("n", 2)), least=0.0)

    @checks.arguments
    def annotated(key: PRNGKey, x: Float[Array, "n 2"], size: ScalarLike):
        return x

    for function in (checked, annotated):
        assert not jax.make_jaxpr(function)(jax.random.key(0), jnp.full((3, 2), jnp.nan), -1.0).eqns


@checks.arguments
def annotated(
    table: Float[Array, "n 2"],
    row: Float[Array, " n"] | None,
    factor: ScalarLike,
    num: int,
    kind: type,
    *,
    key: PRNGKey | None = None,
    free=None,
):
    return table, row, factor, num, kind, key, free


def test_arguments_become_what_their_annotations_say():
    table, row, *rest = annotated([[1, 2]], np.arange(1), 0.5, np.int64(3), int, free="x")
    assert (table.dtype, table.shape, row.dtype) == (jnp.float32, (1, 2), jnp.float32)
    assert rest == [0.5, 3, int, None, "x"]
    assert annotated(table, None, 1, 1, int)[1] is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"table": np.ones((3, 1))}, r"table must have shape \(n, 2\), got \(3, 1\)"),
        ({"row": np.ones(3)}, r"row must have shape \(2,\) beside table \(2, 2\), got \(3,\)"),
        ({"factor": np.nan}, "factor must be finite, got nan"),
        ({"num": 0}, "num must be at least 1, got 0"),
        ({"kind": 3}, "kind must be of type type, got 3"),
        ({"key": 3}, "key must be a random key, .* got 3"),
    ],
)
def test_arguments_are_held_to_their_annotations(change, message):
    good = {"table": np.ones((2, 2)), "row": None, "factor": 1.0, "num": 1, "kind": int}
    with pytest.raises(ValueError, match=message):
        annotated(**{**good, **change})


def test_arguments_that_are_too_many_or_missing_are_named_as_python_does():
    with pytest.raises(TypeError, match=r"^annotated\(\) missing a required argument: 'row'"):
        annotated(np.ones((2, 2)))
    with pytest.raises(TypeError, match=r"^annotated\(\) got an unexpected keyword argument 'rows'"):
        annotated(np.ones((2, 2)), None, 1.0, 1, int, rows=None)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (np.arange(3), jnp.float32),
        (np.array([True, False]), jnp.float32),
        ([1, 2.5], jnp.float32),
        (np.ones(2, np.float16), jnp.float32),
    ],
)
def test_numbers_of_any_kind_become_floats(value, expected):
    array = checks.array("x", value)
    assert array.dtype == expected
    np.testing.assert_array_equal(array, np.asarray(value, np.float32))


@pytest.mark.parametrize("value", [1e300, [1e300], np.array(1e300)])
def test_what_is_too_large_becomes_infinite_without_a_warning(value):
    assert jnp.isinf(checks.array("x", value)).all()


def test_an_array_that_is_good_is_returned_itself():
    array = jnp.ones(3)
    assert checks.finite("x", checks.array("x", array, ("n",)), above=0.0) is array


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (partial(checks.count, "n", 2.0), "n must be a whole number, got 2.0"),
        (partial(checks.count, "n", True), "n must be a whole number, got True"),
        (partial(checks.count, "n", 1, least=2), "n must be at least 2, got 1"),
        (partial(checks.count, "n", 2**31), "n must be at most 2147483647, got 2147483648"),
        (partial(checks.grid, "n", 100, 4), "at most 10000000 points in all, got 100 along each of 4 axes"),
        (partial(checks.number, "x", "1"), "x must be a number, got '1'"),
        (partial(checks.number, "x", -1, least=0.0), "x must be finite and at least 0, got -1"),
        (partial(checks.number, "x", 1e-50, above=0.0), "above 0, got 1e-50, which float32 cannot hold"),
        (partial(checks.number, "x", 10**400), r"x must be finite, got 10000.* \.\.\."),
        (
            partial(checks.vector, "x", (1.0, None)),
            r"x must be a number or a vector of numbers, got \(1.0, None",
        ),
        (partial(checks.vector, "x", (1.0, np.inf)), "x must be finite, got inf"),
        (partial(checks.vector, "x", (1.0, 1e300), largest=np.inf), r"x must be finite, got 1e\+300"),
        (partial(checks.array, "x", "one"), "x must be an array of real numbers, got 'one'"),
        (partial(checks.array, "x", np.ones(2, complex)), r"real numbers, got complex128\(2,\)"),
        (partial(checks.array, "x", np.ones((3, 1)), ("n", 2)), r"x must have shape \(n, 2\), got \(3, 1\)"),
        (partial(checks.array, "x", np.ones(0), ("n",)), r"x must have shape \(n,\), got \(0,\)"),
        (
            partial(checks.finite, "x", np.array([1.0, -2.0]), least=0.0),
            "x must be finite and at least 0, got -2.0",
        ),
        (partial(checks.key, "key", 0), r"key must be a random key, such as jax.random.key\(0\), got 0"),
        (
            partial(checks.key, "keys", jax.random.key(0), num_axes=1),
            r"keys must be random keys, .* got key<",
        ),
        (partial(checks.function, "f", 3, "(x)"), r"f must be a function \(x\), got 3"),
        (partial(checks.instance, "x", 3, str, list), "x must be of type str or list, got 3"),
    ],
)
def test_errors_show_the_value_and_what_was_expected(check, message):
    with pytest.raises(ValueError, match=message):
        check()


def test_old_and_new_keys_are_keys():
    for key in (jax.random.key(0), jax.random.PRNGKey(0), np.asarray(jax.random.PRNGKey(0))):
        assert checks.key("key", key) is key
    for keys in (jax.random.split(key, 3) for key in (jax.random.key(0), jax.random.PRNGKey(0))):
        assert checks.key("keys", keys, num_axes=1) is keys
