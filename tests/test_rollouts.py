"""Work is done on the devices that are chosen, wherever its arrays are, and nothing drawn depends on them."""

import contextlib
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from creps_jax.policies.features import linear_features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.rollouts import compiled_roll_out, device_tuple, mean_outcome, replicate
from creps_jax.search.archive import push
from creps_jax.search.creps import CrepsState, creps
from creps_jax.tasks import PlainOutcome, Task
from creps_jax.training import evaluate, make_iteration, train, train_trials
from tests.compilations import count_compilations

FIRST, SECOND = jax.devices()
CHOICES = {"first": (FIRST,), "second": (SECOND,), "both": (FIRST, SECOND), "reversed": (SECOND, FIRST)}
BOTH = NamedSharding(Mesh(np.asarray([FIRST, SECOND]), ("rows",)), PartitionSpec())
# Where the key and where the other arrays of a call are.
PLACES = {
    "anywhere": (None, None),
    "first": (FIRST, FIRST),
    "second": (SECOND, SECOND),
    "on both": (BOTH, BOTH),
    "key first": (FIRST, SECOND),
    "key second": (SECOND, FIRST),
    "key alone": (SECOND, None),
}
choices = pytest.mark.parametrize("choice", CHOICES.values(), ids=CHOICES)
places = pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)


def rollout(key, context, theta):
    return PlainOutcome(jax.random.normal(key) - jnp.sum((theta - context) ** 2), jnp.zeros(0))


def tell_at_once(state, batch):
    """Stand in for `tell`, which takes long to compile: what is learned follows from all that is drawn."""
    coef = state.policy.coef + batch.theta.mean(0)[None, :] + batch.reward.mean()
    policy = state.policy._replace(coef=coef)
    return CrepsState(policy, push(state.archive, batch), state.iteration + 1), batch.reward.max()


TASK = Task(lambda key: jax.random.normal(key, (1,)), rollout, 1, 2, worst_reward=-50)
ALGORITHM = dataclasses.replace(
    creps(linear_features(1), linear_features(1), archive_size=12), tell=tell_at_once
)
START = LinearGaussian(np.zeros((2, 2), np.float32), np.eye(2, dtype=np.float32))
CONTEXTS, THETAS = jnp.linspace(0, 1, 5)[:, None], jnp.ones((5, 2))
KEY = jax.random.key(3)


def trial_keys(num):
    return jax.random.split(KEY, num)


def stacked_states(num):
    return jax.tree.map(lambda x: jnp.stack([x] * num), ALGORITHM.init(START))


def evaluated(key, inputs, devices):
    return evaluate(key, TASK, *inputs, repeats=2, devices=devices)


def trained(key, start, devices):
    return train(key, TASK, ALGORITHM, start, iterations=2, samples=5, devices=devices)


def trained_trials(keys, start, devices):
    return train_trials(keys, TASK, ALGORITHM, start, iterations=2, samples=5, devices=devices)


def iterated(key, state, devices):
    return make_iteration(TASK, ALGORITHM, samples=5, devices=devices)(key, state)


# What to run: its keys, its other arrays, and the function.
RUNS = {
    "evaluate": (lambda: KEY, lambda: (CONTEXTS, THETAS), evaluated),
    "train": (lambda: KEY, lambda: ALGORITHM.init(START), trained),
    "make_iteration": (lambda: KEY, lambda: ALGORITHM.init(START), iterated),
    "two trials": (lambda: trial_keys(2), lambda: stacked_states(2), trained_trials),
    "three trials": (lambda: trial_keys(3), lambda: stacked_states(3), trained_trials),
}
runs = pytest.mark.parametrize("name", RUNS)


def placed(tree, place):
    return tree if place is None else jax.device_put(tree, place)


def devices_of(tree):
    return set().union(*(leaf.devices() for leaf in jax.tree.leaves(tree)))


def assert_same(left, right):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), left, right)


@runs
@choices
@places
def test_work_is_done_on_the_chosen_devices_wherever_its_arrays_are(name, choice, place):
    keys, inputs, function = RUNS[name]
    result = function(placed(keys(), place[0]), placed(inputs(), place[1]), list(choice))
    if len(choice) == 1:
        assert devices_of(result) == set(choice)
    else:
        assert devices_of(result) >= set(choice)
    assert_same(result, function(keys(), inputs(), [FIRST]))


@choices
def test_a_state_that_another_choice_left_can_go_on(choice):
    left = [trained(KEY, ALGORITHM.init(START), list(devices))[0] for devices in CHOICES.values()]
    for state in left:
        result, _ = trained(KEY, state, list(choice))
        assert devices_of(result) == set(choice)
        assert result.iteration == 4


@pytest.mark.parametrize("choice", [None, *map(list, CHOICES.values())], ids=["default", *CHOICES])
def test_an_iteration_is_compiled_once_wherever_its_arrays_are(choice):
    step = make_iteration(TASK, ALGORITHM, samples=5, devices=choice)
    state, _ = step(KEY, ALGORITHM.init(START))
    with count_compilations() as compilations:
        for key_place, place in PLACES.values():
            start = ALGORITHM.init(START)
            step(placed(KEY, key_place), placed(start, place))
            state, _ = step(KEY, state)
    assert not compilations


@choices
def test_an_iteration_can_be_vmapped_and_jitted_on_any_choice(choice):
    step = make_iteration(TASK, ALGORITHM, samples=5, devices=list(choice))
    batched, _ = jax.jit(jax.vmap(step))(trial_keys(2), stacked_states(2))
    assert devices_of(batched) == set(choice)
    single, _ = step(trial_keys(2)[1], ALGORITHM.init(START))
    assert_same(jax.tree.map(lambda x: x[1], batched), single)


def test_the_only_device_is_no_choice(monkeypatch):
    assert device_tuple(None) == (FIRST, SECOND)
    monkeypatch.setattr(jax, "local_devices", lambda: [FIRST])
    assert device_tuple(None) == () and device_tuple([FIRST]) == (FIRST,)
    arrays = placed(CONTEXTS, SECOND), THETAS
    assert replicate(arrays, ()) is arrays
    # Arrays stay where they are, as with any function of jax.
    assert devices_of(evaluated(KEY, placed((CONTEXTS, THETAS), SECOND), None)) == {SECOND}
    trained_trials(trial_keys(2), START, None)


def keys_of_all_kinds():
    for implementation in ("threefry2x32", "rbg", "unsafe_rbg"):
        yield f"typed {implementation}", None, jax.random.key(5, impl=implementation)
        with jax.default_prng_impl(implementation):
            yield f"raw {implementation}", implementation, jax.random.PRNGKey(5)


KEYS = {name: (implementation, key) for name, implementation, key in keys_of_all_kinds()}


def default_implementation(implementation):
    return contextlib.nullcontext() if implementation is None else jax.default_prng_impl(implementation)


@pytest.mark.parametrize(("implementation", "key"), KEYS.values(), ids=KEYS)
@pytest.mark.parametrize("name", ["evaluate", "make_iteration"])
def test_numbers_of_any_key_do_not_depend_on_the_devices(name, implementation, key):
    with default_implementation(implementation):
        _, inputs, function = RUNS[name]
        alone = function(key, inputs(), [FIRST])
        assert_same(alone, function(key, inputs(), [SECOND, FIRST]))
        assert np.isfinite(jax.tree.leaves(alone)[0]).all()


@pytest.mark.parametrize("implementation", ["threefry2x32", "rbg", "unsafe_rbg"])
@pytest.mark.parametrize("is_raw", [False, True], ids=["typed", "raw"])
@pytest.mark.parametrize("num", [2, 3])
def test_numbers_of_trials_of_any_keys_are_those_of_runs_of_their_own(num, is_raw, implementation):
    with jax.default_prng_impl(implementation):
        keys = jax.random.split((jax.random.PRNGKey if is_raw else jax.random.key)(0), num)
        states, logs = trained_trials(keys, START, [FIRST, SECOND])
        for trial, key in enumerate(keys):
            single = train(key, TASK, ALGORITHM, START, iterations=2, samples=5, devices=[SECOND])
            assert_same(jax.tree.map(lambda x, trial=trial: x[trial], (states, logs)), single)


NAN_TASK = dataclasses.replace(
    TASK,
    rollout=lambda key, context, theta: PlainOutcome(
        jnp.where(context[0] > 0.3, jnp.nan, theta.sum()), jnp.zeros(0)
    ),
)


@choices
def test_failed_rollouts_pass_while_jax_looks_for_nan(choice):
    with jax.debug_nans(True):
        outcome = evaluate(KEY, NAN_TASK, CONTEXTS, THETAS, devices=list(choice))
        np.testing.assert_array_equal(outcome.reward[:, 0], [2, 2, -50, -50, -50])
        outcomes, is_failed = compiled_roll_out(NAN_TASK, ())(KEY, CONTEXTS, THETAS)
        assert mean_outcome(outcomes, ~is_failed).reward == 2
        _, log = train(KEY, NAN_TASK, ALGORITHM, START, iterations=2, samples=20, devices=list(choice))
        assert (log.num_failed > 0).all() and np.isfinite(log.mean_reward).all()
    # That no rollout counts is a NaN on purpose.
    assert np.isnan(mean_outcome(outcomes, jnp.zeros_like(is_failed)).reward)
