from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax import files
from creps_jax.checkpoints import Checkpoint, append_log, load_checkpoint, named_leaves, save_checkpoint
from creps_jax.errors import UserError


class Inner(NamedTuple):
    kl: np.ndarray
    steps: np.ndarray


class State(NamedTuple):
    inner: Inner
    mean: np.ndarray


RUN = {"experiment": "walk", "seed": 0, "settings": {"samples": 30, "bounds": (0.0, 1.0)}}


def make_state(offset: float = 0.0) -> State:
    return State(Inner(jnp.float32(0.5 + offset), jnp.int32(3)), jnp.arange(4.0) + offset)


def test_leaves_are_named_by_their_fields():
    assert list(named_leaves(make_state(), "state.")) == ["state.inner.kl", "state.inner.steps", "state.mean"]


def test_log_grows_by_an_iteration_at_a_time():
    log = {}
    for number in range(3):
        log = append_log(log, {"a": np.full(2, number), "b": np.array(number)})
    np.testing.assert_array_equal(log["a"], [[0, 0], [1, 1], [2, 2]])
    np.testing.assert_array_equal(log["b"], [0, 1, 2])


def test_a_checkpoint_comes_back_as_it_was_saved(tmp_path):
    path, log = tmp_path / "checkpoint.npz", {"mean_reward": np.arange(3.0)}
    save_checkpoint(path, Checkpoint(make_state(1.0), log), run=RUN)
    loaded = load_checkpoint(path, make_state(), run=RUN)
    assert isinstance(loaded.state, State)
    for name, values in named_leaves(make_state(1.0)).items():
        np.testing.assert_array_equal(named_leaves(loaded.state)[name], values)
        assert named_leaves(loaded.state)[name].dtype == values.dtype
    np.testing.assert_array_equal(loaded.log["mean_reward"], log["mean_reward"])


def test_bad_checkpoints_are_refused_and_left_alone(tmp_path):
    path = tmp_path / "checkpoint.npz"
    save_checkpoint(path, Checkpoint(make_state(), {}), run=RUN)
    whole = path.read_bytes()

    def refused(match: str, template: State | None = None, run=RUN) -> None:
        before = path.read_bytes()
        with pytest.raises(UserError, match=match) as caught:
            load_checkpoint(path, template or make_state(), run=run)
        assert "\n" not in str(caught.value)
        assert path.read_bytes() == before

    refused("its seed is 0, expected 1", run={**RUN, "seed": 1})
    refused(
        "its settings is .*30.* expected .*40", run={**RUN, "settings": {"samples": 40, "bounds": (0.0, 1.0)}}
    )
    refused(r"expected float32\(5,\) for state.mean", template=make_state()._replace(mean=jnp.zeros(5)))
    path.write_bytes(whole[: len(whole) // 2])
    refused("cut short")
    files.save_arrays(path, {"a": np.ones(3)})
    refused("no checkpoint of this program")
