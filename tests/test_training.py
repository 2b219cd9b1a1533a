"""Runs are the same as a scan, a loop, resumed, on any number of devices, alone or among trials."""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax import tasks
from creps_jax.policies.features import linear_features, quadratic_features
from creps_jax.policies.gaussian import LinearGaussian, start_policy
from creps_jax.policies.learned import load
from creps_jax.search.archive import push
from creps_jax.search.creps import CrepsState, creps
from creps_jax.tasks import Task, penalised, sigmoid_constrained
from creps_jax.training import evaluate, learned, make_iteration, train, train_trials
from tests.compilations import count_compilations

SAMPLES, FIRST_SAMPLES, ITERATIONS = 15, 25, 7
ALGORITHM = creps(linear_features(1), quadratic_features(1), archive_size=40)
POLICY = LinearGaussian(coef=np.zeros((2, 2), np.float32), cov_chol=np.eye(2, dtype=np.float32))


def tell_at_once(state, batch):
    """Stand in for `tell` where what is learned does not matter: it compiles at once."""
    policy = state.policy._replace(coef=state.policy.coef + batch.theta.mean(0)[None, :])
    return CrepsState(policy, push(state.archive, batch), state.iteration + 1), batch.reward.max()


QUICK = dataclasses.replace(ALGORITHM, tell=tell_at_once)


class NoisyOutcome(NamedTuple):
    reward: jax.Array
    violation: jax.Array
    fell: jax.Array


class CountedTask:
    """A noisy task of two parameters that counts how often its rollout is traced."""

    def __init__(self, reward_of=lambda reward, theta: reward):
        self.num_traces = 0

        def rollout(key, context, theta):
            self.num_traces += 1

            # A loop that starts from constants, as simulations do.
            def step(total, key):
                return total + 0.1 * jax.random.normal(key), None

            noise, _ = jax.lax.scan(step, jnp.zeros(()), jax.random.split(key, 4))
            reward = -jnp.sum((theta - jnp.sin(context)) ** 2) + noise
            return NoisyOutcome(reward_of(reward, theta), jnp.maximum(theta - 1, 0), noise > 0)

        self.task = Task(lambda key: jax.random.normal(key, (1,)), rollout, 1, 2, worst_reward=-50)


TASK = CountedTask().task
# What fuses operations could change bits.
pytestmark = pytest.mark.usefixtures("compiled_as_for_users")


def run(key, *, task=TASK, algorithm=ALGORITHM, start=POLICY, iterations=ITERATIONS, **settings):
    settings = {"samples": SAMPLES, "first_samples": FIRST_SAMPLES, **settings}
    return train(key, task, algorithm, start, iterations=iterations, **settings)


def ignore(state, log):
    """Do nothing on an iteration, but make the run a loop."""


@pytest.fixture(scope="module")
def scanned() -> tuple:
    return run(jax.random.key(0))


def assert_equal(left, right):
    jax.tree.map(np.testing.assert_array_equal, left, right)


def assert_close(left, right):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-3), left, right)


def without_steps(run):
    """Leave out how many steps the dual took: rounding, which batches change, decides about the last one."""
    state, log = run
    return state, log._replace(info=log.info._replace(dual=log.info.dual._replace(num_steps=0)))


def test_a_loop_equals_the_scan_to_the_bit(key, scanned):
    calls = []
    looped = run(key, on_iteration=lambda state, log: calls.append((state, log)))
    assert_equal(looped, scanned)
    assert [int(state.iteration) for state, _ in calls] == list(range(1, ITERATIONS + 1))
    logs = [log._replace(samples=None) for _, log in calls]
    assert_equal(jax.tree.map(lambda *x: jnp.stack(x), *logs), scanned[1])


def test_the_log_of_one_iteration_holds_its_samples(key):
    step = make_iteration(TASK, QUICK, samples=SAMPLES)
    state, log = step(key, QUICK.init(POLICY))
    samples = log.samples
    np.testing.assert_array_equal(samples.context, state.archive.batch.context[:SAMPLES])
    np.testing.assert_array_equal(samples.outcome.reward, state.archive.batch.reward[:SAMPLES])
    assert samples.outcome.fell.dtype == bool
    np.testing.assert_allclose(samples.outcome.fell.mean(), log.outcome.fell, rtol=1e-6)


@pytest.mark.parametrize("on_iteration", [None, ignore], ids=["scan", "loop"])
def test_a_resumed_run_equals_the_scan_to_the_bit(key, scanned, on_iteration):
    state, before = run(key, iterations=4, on_iteration=on_iteration)
    saved = CrepsState(*jax.tree.map(np.asarray, state))  # as read from a file
    state, after = run(key, start=saved, iterations=ITERATIONS - 4, on_iteration=on_iteration)
    log = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), before, after)
    assert_equal((state, log), scanned)


def test_iterations_called_by_hand_equal_the_scan_to_the_bit(key, scanned):
    first = make_iteration(TASK, ALGORITHM, samples=FIRST_SAMPLES)
    later = make_iteration(TASK, ALGORITHM, samples=SAMPLES)
    state, _ = first(key, ALGORITHM.init(POLICY))
    for _ in range(ITERATIONS - 1):
        state, _ = later(key, state)
    assert_equal(state, scanned[0])


def test_the_first_iteration_may_have_more_samples(scanned):
    state, log = scanned
    expected = np.minimum(FIRST_SAMPLES + SAMPLES * np.arange(ITERATIONS), 40)
    np.testing.assert_array_equal(log.info.num_valid, expected)
    assert state.iteration == ITERATIONS and log.mean_reward.shape == (ITERATIONS,)


def test_another_key_is_another_run(key):
    runs = [run(k, algorithm=QUICK, on_iteration=ignore)[0].policy.coef for k in jax.random.split(key)]
    assert not np.allclose(*runs)


def test_the_numbers_do_not_depend_on_the_devices(key):
    assert len(jax.devices()) == 2
    settings = {"first_samples": None, "on_iteration": ignore}
    one, all_of_them = run(key, devices=jax.devices()[:1], **settings), run(key, **settings)
    assert_close(without_steps(one), without_steps(all_of_them))
    states = [run(key, algorithm=QUICK, devices=d)[0] for d in (jax.devices()[:1], jax.devices()[::-1])]
    assert_close(*states)


def test_rollouts_run_on_all_devices():
    placed = {}

    def rollout(key, context, theta):
        # Runs on the host, once for each device's share.
        jax.debug.callback(lambda i: placed.setdefault(int(i), 0), jax.lax.axis_index("rows"))
        return TASK.rollout(key, context, theta)

    task = Task(TASK.sample_context, rollout, 1, 2, -50)
    jax.block_until_ready(evaluate(jax.random.key(0), task, jnp.zeros((5, 1)), jnp.zeros((5, 2))))
    jax.effects_barrier()
    assert set(placed) == {0, 1}


def test_each_number_of_samples_is_traced_and_compiled_once(key):
    counted = CountedTask()
    step = make_iteration(counted.task, QUICK, samples=SAMPLES)
    state = QUICK.init(POLICY)
    state, _ = step(key, state)
    with count_compilations() as compilations:
        for _ in range(2):
            state, _ = step(key, state)
    assert counted.num_traces == 1 and not compilations
    # A loop, and another `train`, find that again; the first iteration has other shapes.
    for _ in range(2):
        run(key, task=counted.task, algorithm=QUICK, on_iteration=ignore)
    assert counted.num_traces == 2


def test_rollouts_that_fail_are_counted_and_get_the_worst_reward(key):
    task = CountedTask(lambda reward, theta: jnp.where(theta[0] > 0.5, jnp.nan, reward)).task
    settings = {"task": task, "samples": 10, "first_samples": None, "on_iteration": ignore}
    state, log = run(key, iterations=4, **settings)
    rewards = np.asarray(state.archive.batch.reward).reshape(4, 10)
    failed = np.asarray(state.archive.batch.theta[:, 0] > 0.5).reshape(4, 10)
    assert failed.any() and (rewards[failed] == -50).all() and (rewards[~failed] > -50).all()
    np.testing.assert_array_equal(log.num_failed, failed.sum(1))
    np.testing.assert_allclose(log.mean_reward, rewards.mean(1), rtol=1e-5)
    counted = [row[~is_failed].mean() for row, is_failed in zip(rewards, failed, strict=True)]
    np.testing.assert_allclose(log.outcome.reward, counted, rtol=1e-5)
    assert isinstance(log.outcome, NoisyOutcome) and log.outcome.violation.shape == (4, 2)
    assert ((log.outcome.fell >= 0) & (log.outcome.fell <= 1)).all()
    assert log.num_failed[-1] < log.num_failed[0]

    # Where all fail, all rewards are equal: nothing is learned, nothing breaks.
    far = LinearGaussian(coef=np.float32([[20, 0], [0, 0]]), cov_chol=np.eye(2))
    state, log = run(key, start=far, iterations=3, **settings)
    np.testing.assert_array_equal(log.num_failed, [10, 10, 10])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, log.info, log.mean_reward)))
    assert np.isnan(log.outcome.reward).all()


def test_trials_equal_runs_of_their_own(key):
    keys = jnp.stack([key, jax.random.key(7)])
    settings = {"samples": SAMPLES, "iterations": 3}
    halfway, first_logs = train_trials(keys, TASK, ALGORITHM, POLICY, **settings)
    states, logs = train_trials(keys, TASK, ALGORITHM, halfway, **settings)
    assert logs.mean_reward.shape == (2, 3) and logs.outcome.violation.shape == (2, 3, 2)
    logs = jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=1), first_logs, logs)
    for trial, trial_key in enumerate(keys):
        single = run(trial_key, first_samples=None, iterations=6, on_iteration=ignore)
        found = jax.tree.map(lambda x, trial=trial: x[trial], (states, logs))
        assert_close(*map(without_steps, (found, single)))


def test_trials_may_be_watched_and_have_more_samples_first(key):
    seen = []
    keys = jax.random.split(key, 3)
    settings = {"samples": 4, "first_samples": 8, "iterations": 3}
    looped = train_trials(
        keys, TASK, QUICK, POLICY, **settings, on_iteration=lambda state, log: seen.append(log.mean_reward)
    )
    assert_equal(looped, train_trials(keys, TASK, QUICK, POLICY, **settings))
    np.testing.assert_array_equal(np.stack(seen, axis=1), looped[1].mean_reward)
    np.testing.assert_array_equal(looped[0].archive.size, [16, 16, 16])


def test_trials_shared_out_over_devices_stay_where_they_are(key):
    keys, settings = jax.random.split(key, 4), {"samples": SAMPLES, "iterations": 3}
    with count_compilations() as compilations:
        counts = []

        def watch(state, log):
            counts.append(len(compilations))

        states, _ = train_trials(keys, TASK, QUICK, POLICY, on_iteration=watch, **settings)
    assert {shard.data.shape[0] for shard in states.iteration.addressable_shards} == {2}
    # What an iteration finds is where the last one left it: nothing is compiled anew.
    assert counts[0] == counts[-1]
    alone, _ = train_trials(keys, TASK, QUICK, POLICY, devices=jax.devices()[:1], **settings)
    assert_close(states, alone)


def test_an_iteration_can_be_vmapped_and_jitted(key):
    step = make_iteration(TASK, QUICK, samples=SAMPLES)
    keys = jax.random.split(key, 2)
    states = jax.tree.map(lambda x: jnp.stack([x, x]), QUICK.init(POLICY))
    batched, _ = jax.jit(jax.vmap(step))(keys, states)
    single, _ = step(keys[1], QUICK.init(POLICY))
    assert_close(jax.tree.map(lambda x: x[1], batched), single)


def test_evaluation_repeats_each_row_with_fresh_seeds(key):
    contexts, thetas = jnp.zeros((3, 1)), jnp.asarray([[0.0, 0.0], [1.0, 0.0], [1.0, 3.0]])
    outcome = evaluate(key, TASK, contexts, thetas, repeats=200)
    assert isinstance(outcome, NoisyOutcome)
    assert outcome.reward.shape == outcome.fell.shape == (3, 200) and outcome.violation.shape == (3, 200, 2)
    assert len(np.unique(outcome.reward)) > 590
    np.testing.assert_allclose(outcome.reward.mean(1), [0, -1, -10], atol=5 * 0.2 / np.sqrt(200))
    np.testing.assert_array_equal(outcome.violation[:, 0], jnp.maximum(thetas - 1, 0))
    one_device = evaluate(key, TASK, contexts, thetas, repeats=200, devices=jax.devices()[:1])
    assert_close(outcome, one_device)


def test_evaluation_gives_failed_rollouts_the_worst_reward(key):
    task = CountedTask(lambda reward, theta: jnp.where(theta[0] > 0.5, -jnp.inf, reward)).task
    outcome = evaluate(key, task, jnp.zeros((2, 1)), jnp.asarray([[0.0, 0.0], [1.0, 0.0]]))
    assert outcome.reward[0, 0] > -50 and outcome.reward[1, 0] == -50


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"iterations": 0}, "iterations must be at least 1, got 0"),
        ({"samples": 0}, "samples must be at least 1, got 0"),
        ({"first_samples": -5}, "first_samples must be at least 1, got -5"),
        ({"devices": []}, r"devices must be one device or more, .* got \[\]"),
        ({"devices": 2 * jax.devices()[:1]}, "devices must be given once each, got"),
        (
            {"start": LinearGaussian(np.zeros((2, 3)), np.eye(3))},
            r"the task's 2 parameters, got thetas of shape \(25, 3\)",
        ),
        ({"start": LinearGaussian(np.zeros((5, 2)), np.eye(2))}, r"coef \(2, d\).*got \(5, 2\)"),
    ],
)
def test_refuses_what_does_not_fit(key, settings, message):
    with pytest.raises(ValueError, match=message):
        run(key, **settings)


def test_refuses_features_of_other_contexts_than_the_task(key):
    algorithm = creps(linear_features(2), quadratic_features(2), archive_size=10)
    start = LinearGaussian(np.zeros((3, 2)), np.eye(2))
    with pytest.raises(
        ValueError,
        match=r"contexts must have shape \(n, 2\) for features of 2 context variables, got \(3, 1\)",
    ):
        train(key, TASK, algorithm, start, iterations=1, samples=3)


def test_refuses_tasks_that_do_not_keep_to_their_numbers(key):
    wide = Task(lambda key: jnp.zeros(2), TASK.rollout, 1, 2, -50)
    with pytest.raises(ValueError, match=r"what sample_context gives must have shape \(1,\), got \(2,\)"):
        run(key, task=wide)
    vector = CountedTask(lambda reward, theta: theta).task
    with pytest.raises(ValueError, match=r"the reward of a rollout must have shape \(\), got \(2,\)"):
        run(key, task=vector)


def test_refuses_states_that_are_not_one_for_each_key(key):
    with pytest.raises(ValueError, match=r"each of 2 keys, got \(\)"):
        state = ALGORITHM.init(POLICY)
        train_trials(jax.random.split(key, 2), TASK, ALGORITHM, state, iterations=1, samples=3)


def test_evaluation_refuses_what_does_not_fit(key):
    with pytest.raises(
        ValueError, match=r"contexts must be \(n, 1\) and thetas \(n, 2\), got \(4, 1\) and \(4, 3\)"
    ):
        evaluate(key, TASK, jnp.zeros((4, 1)), jnp.zeros((4, 3)))
    with pytest.raises(ValueError, match="repeats must be at least 1, got 0"):
        evaluate(key, TASK, jnp.zeros((4, 1)), jnp.zeros((4, 2)), repeats=0)


@pytest.mark.parametrize("make", [tasks.sinus, tasks.via_point_reaching, tasks.hole_reaching, tasks.nao_walk])
def test_a_state_becomes_a_policy_with_the_names_and_units_of_its_task(make, tmp_path):
    task = sigmoid_constrained(make(), -2.0, 3.0)
    features = linear_features(task.context_dim)
    algorithm = creps(features)
    state = algorithm.init(start_policy(features, task.theta_dim, std=0.1))
    found = learned(task, algorithm, state, made_for={"name": "mine"})
    found.save(tmp_path / "policy.npz")
    found = load(tmp_path / "policy.npz")
    assert found.contexts == task.contexts
    assert found.task == {"name": "mine"}
    middle = 0.5 * (np.array(task.contexts.low) + np.array(task.contexts.high))
    parameters = found(*middle)
    assert tuple(parameters) == task.parameters.names
    np.testing.assert_allclose(list(parameters.values()), 0.5)  # the sigmoid's middle
    assert len(task.parameters.units) == task.theta_dim


def test_clipped_parameters_of_a_penalised_task_stay_in_its_bounds():
    task = penalised(tasks.sinus(), -0.5, 0.5, 1.0)
    features = linear_features(1)
    algorithm = creps(features)
    found = learned(task, algorithm, algorithm.init(start_policy(features, 1, mean=2.0, std=0.1)))
    assert found(1.0) == {"sine": 0.5}


def test_a_task_that_does_not_state_its_variables_cannot_make_a_learned_policy():
    task = dataclasses.replace(tasks.sinus(), parameters=None)
    algorithm = creps(linear_features(1))
    state = algorithm.init(start_policy(linear_features(1), 1))
    with pytest.raises(ValueError, match="the task must state its parameters"):
        learned(task, algorithm, state)
