"""The archive is a `deque(maxlen=L)` of samples."""

from collections import deque

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from creps_jax.search.archive import Archive, Batch, empty_archive, push

CONTEXT_DIM, THETA_DIM = 1, 2
PUSH = jax.jit(push)


def batch_of(rewards) -> Batch:
    """Make samples that can be told apart: all their numbers follow from the reward."""
    xp = np if isinstance(rewards, np.ndarray) else jnp
    reward = xp.asarray(rewards, xp.float32)
    return Batch(context=10 * reward[:, None], theta=xp.stack([reward, -reward], axis=1), reward=reward)


def in_order(archive: Archive) -> Batch:
    """Read the written slots from the oldest to the newest."""
    size, capacity = int(archive.size), archive.batch.reward.shape[0]
    slots = (int(archive.next_index) - size + np.arange(size)) % capacity
    return jax.tree.map(lambda field: np.asarray(field)[slots], archive.batch)


# Each pair of sizes is compiled: few of them, but with batches below, at and above the archive's size.
@settings(max_examples=50, deadline=None)
@given(archive_size=st.sampled_from([1, 4, 6]), batch_sizes=st.lists(st.sampled_from([1, 4, 9]), max_size=6))
def test_equals_a_bounded_deque(archive_size, batch_sizes):
    archive, oracle = empty_archive(archive_size, CONTEXT_DIM, THETA_DIM), deque(maxlen=archive_size)
    count = 0
    for num in batch_sizes:
        rewards = np.arange(count, count + num) + 1
        count += num
        oracle.extend(rewards)
        archive = PUSH(archive, batch_of(rewards))
        jax.tree.map(np.testing.assert_array_equal, in_order(archive), batch_of(np.array(oracle)))
        assert np.sum(archive.is_valid) == len(oracle) == int(archive.size)


def test_an_empty_archive_has_nothing_to_learn_from():
    assert not empty_archive(5, CONTEXT_DIM, THETA_DIM).is_valid.any()


def test_push_keeps_its_shapes_and_types_in_a_scan():
    def step(archive, rewards):
        return push(archive, batch_of(rewards)), None

    rewards = jnp.arange(1.0, 13.0).reshape(4, 3)
    scanned, _ = jax.lax.scan(step, empty_archive(5, CONTEXT_DIM, THETA_DIM), rewards)
    np.testing.assert_array_equal(in_order(scanned).reward, np.arange(8, 13))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", Batch._fields)
def test_samples_with_anything_not_finite_are_not_valid(field, bad):
    batch = batch_of([1.0, 2.0, 3.0])
    spoilt = batch._replace(**{field: getattr(batch, field).at[1].set(bad)})
    archive = push(empty_archive(4, CONTEXT_DIM, THETA_DIM), spoilt)
    np.testing.assert_array_equal(archive.is_valid, [True, False, True, False])


def test_refuses_an_archive_without_slots():
    with pytest.raises(ValueError, match="archive_size must be at least 1, got 0"):
        empty_archive(0, CONTEXT_DIM, THETA_DIM)
