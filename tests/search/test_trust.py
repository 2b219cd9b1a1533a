"""A search does not fool itself: no update without differences, no lost precision, no state of another."""

import copy
import dataclasses
import gc
import pickle
import warnings
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import creps_jax as cj
from creps_jax.contexts import uniform_contexts
from creps_jax.policies.features import FeatureMap, linear_features, polynomial_features, rbf_features
from creps_jax.policies.gaussian import LinearGaussian, start_policy
from creps_jax.policies.network import network_policy, start_network
from creps_jax.search import creps as creps_functions
from creps_jax.search.archive import Batch
from creps_jax.search.creps import creps
from creps_jax.search.fit import bounded_ml, weighted_ml
from creps_jax.search.importance import Importance
from creps_jax.tasks import PlainOutcome, Task
from creps_jax.training import train
from tests.compilations import count_compilations

NUM, DIM = 60, 3
FEATURES = linear_features(2)
ALGORITHM = creps(FEATURES, FEATURES, archive_size=NUM, m_step=bounded_ml())
START = LinearGaussian(np.zeros((3, DIM), np.float32), np.eye(DIM, dtype=np.float32))
RNG = np.random.default_rng(0)
CONTEXTS = RNG.uniform(size=(NUM, 2))
THETAS = RNG.normal(size=(NUM, DIM))
REWARDS = THETAS[:, 0] + RNG.normal(size=NUM)


def tell(reward, *, algorithm=ALGORITHM, contexts=CONTEXTS, thetas=THETAS, state=None):
    state = algorithm.init(START) if state is None else state
    return state, *algorithm.tell(state, Batch(contexts, thetas, reward))


def assert_kept(state, new, info):
    for before, after in zip(state.policy, new.policy, strict=True):
        np.testing.assert_array_equal(before, after)
    assert not info.is_updated and info.kl == 0 and info.policy_kl == 0 and info.unsupported_loss == 0


def all_finite(tree):
    return all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(tree))


SAME = {
    "zero": np.zeros(NUM),
    "one value": np.full(NUM, 3.3),
    "huge": np.full(NUM, -1e30),
    "float32": np.full(NUM, 0.1, np.float32),
    "of the context": 100 * CONTEXTS[:, 0] - 7 * CONTEXTS[:, 1] + 5,
    "of the context, float32": np.float32(100 * CONTEXTS[:, 0] - 7 * CONTEXTS[:, 1] + 5),
}


@pytest.mark.parametrize("name", SAME)
@pytest.mark.parametrize(
    "settings",
    [{"m_step": weighted_ml}, {"m_step": bounded_ml()}, {"m_step": bounded_ml(), "importance": Importance()}],
    ids=["weighted_ml", "bounded_ml", "importance"],
)
def test_rewards_that_do_not_differ_after_the_baseline_leave_the_policy_to_the_bit(name, settings):
    algorithm = creps(FEATURES, FEATURES, archive_size=NUM, **settings)
    assert_kept(*tell(SAME[name], algorithm=algorithm))


def test_fewer_samples_than_baseline_features_are_no_evidence():
    many = creps(FEATURES, rbf_features((0.0, 0.0), (1.0, 1.0), 4), archive_size=NUM)
    state, new, info = tell(REWARDS[:12], algorithm=many, contexts=CONTEXTS[:12], thetas=THETAS[:12])
    assert_kept(state, new, info)


@pytest.mark.parametrize("offset", [1e3, 1e5, 1e7, 1e8, 1e9, -1e9])
def test_an_offset_of_rewards_in_float64_changes_nothing(offset):
    _, plain, _ = tell(REWARDS)
    _, shifted, info = tell(REWARDS + offset)
    np.testing.assert_allclose(shifted.policy.coef, plain.policy.coef, atol=1e-3)
    np.testing.assert_allclose(shifted.policy.cov_chol, plain.policy.cov_chol, atol=1e-3)
    assert info.is_updated and info.reward_rounding < 1e-4


def test_rewards_that_their_format_cannot_tell_apart_are_warned_of():
    with pytest.warns(UserWarning, match="batch.reward has a spread of .* float32 has steps of 1"):
        _, _, info = tell(np.float32(3 * REWARDS + 1e7))
    assert info.reward_rounding > 0.01
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tell(np.float32(REWARDS + 10))


def spoilt(size, value):
    """Make features of which the first is not finite where the context is above 0.3."""

    def apply(context):
        first = jnp.where(context[0] > 0.3, value, 1.0)
        return jnp.stack([first, context[0], context[1]])[:size]

    return FeatureMap(apply, size, 2)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("which", ["policy", "baseline"])
def test_samples_with_features_that_are_not_finite_are_not_valid(which, value):
    pair = (spoilt(3, value), FEATURES) if which == "policy" else (FEATURES, spoilt(1, value))
    algorithm = creps(*pair, archive_size=NUM)
    state, new, info = tell(REWARDS, algorithm=algorithm)
    assert info.num_valid == np.sum(CONTEXTS[:, 0] <= 0.3) and all_finite((new, info))
    if which == "policy":
        for call in (
            lambda: algorithm.ask(jax.random.key(0), state, CONTEXTS),
            lambda: algorithm.mean(state.policy, CONTEXTS),
        ):
            with pytest.raises(ValueError, match=r"policy_features.apply\(context\) must be finite, got"):
                call()


@pytest.mark.parametrize(
    "reward",
    [
        np.where(np.arange(NUM) == 3, 1e38, REWARDS),
        np.where(np.arange(NUM) == 3, -3e38, REWARDS),
        np.where(np.arange(NUM) % 2 == 0, 3e38, -3e38),
        3e38 * np.tanh(REWARDS),
        1e-38 * REWARDS,
    ],
    ids=["one best", "one worst", "two", "all large", "all small"],
)
def test_finite_rewards_give_finite_answers(reward):
    _, new, info = tell(reward)
    assert all_finite((new, info))
    jitted, _ = jax.jit(ALGORITHM.tell)(
        ALGORITHM.init(START), Batch(*map(jnp.float32, (CONTEXTS, THETAS, reward)))
    )
    assert all_finite(jitted)


@pytest.mark.parametrize("kl_bound", [0.0, -1.0, np.nan])
def test_a_traced_bound_that_is_none_keeps_the_policy(kl_bound):
    @jax.jit
    def update(kl_bound, batch):
        algorithm = creps(FEATURES, FEATURES, archive_size=NUM, kl_bound=kl_bound)
        state = algorithm.init(START)
        return state, *algorithm.tell(state, batch)

    batch = Batch(*map(jnp.float32, (CONTEXTS, THETAS, REWARDS)))
    state, new, info = update(jnp.float32(kl_bound), batch)
    assert not info.is_updated and all_finite((new, info)) and info.kl >= 0.0
    np.testing.assert_array_equal(new.policy.coef, state.policy.coef)


def test_a_state_of_another_archive_size_is_refused():
    other = creps(FEATURES, FEATURES, archive_size=30)
    with pytest.raises(ValueError, match=r"60 slots of archive_size, got \(30,\)"):
        tell(REWARDS, state=other.init(START))


def test_an_archive_that_is_too_small_is_warned_of_with_the_number_that_would_do():
    small = creps(FEATURES, FEATURES, archive_size=10)
    with pytest.warns(UserWarning, match="archive_size should be at least 12.*got 10"):
        small.init(START)


@pytest.mark.parametrize(("num_centers", "archive_size"), [((4, 4), 239), ((11, 1), 164)])
def test_many_features_for_the_archive_are_warned_of(num_centers, archive_size):
    features = rbf_features((0.0, 0.0), (1.0, 1.0), num_centers)
    start = start_policy(features, 5)
    with pytest.warns(
        UserWarning, match=f"at least {archive_size + 1}, 3 samples for each.*got {archive_size}"
    ):
        creps(features, FEATURES, archive_size=archive_size).init(start)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        creps(features, FEATURES, archive_size=archive_size + 1).init(start)
        assert len(creps(features, FEATURES).init(start).archive.batch.reward) == archive_size + 1


def test_the_features_of_a_network_are_not_its_coefficients():
    kind = network_policy((-1.0,) * 5, (1.0,) * 5)
    start = start_network(jax.random.key(0), kind.features, 10)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        creps(kind, archive_size=400).init(start)


@pytest.mark.parametrize(
    ("hidden", "num_baseline", "archive_size"), [(32, 2, 380), (8, 2, 140), ((64, 4), 2, 100), (2, 18, 90)]
)
def test_the_default_archive_of_a_network_has_ten_samples_for_each_last_unit(
    hidden, num_baseline, archive_size
):
    kind = network_policy((-1.0, -1.0), (1.0, 1.0))
    start = start_network(jax.random.key(0), kind.features, 5, hidden=hidden)
    baseline = rbf_features((-1.0, -1.0), (1.0, 1.0), (num_baseline, 1))
    assert len(creps(kind, baseline).init(start).archive.batch.reward) == archive_size


def test_a_small_archive_of_a_network_is_warned_of():
    kind = network_policy((-1.0, -1.0), (1.0, 1.0))
    start = start_network(jax.random.key(0), kind.features, 5, hidden=32)
    with pytest.warns(UserWarning, match="archive_size should be at least 76, 2 samples for each of 33 feat"):
        creps(kind, archive_size=75).init(start)
    with pytest.raises(ValueError, match="archive_size must be at least 11, the number of features"):
        creps(kind, archive_size=10).init(start)


def test_few_features_are_not_warned_of():
    features = rbf_features((0.0, 0.0), (1.0, 1.0), (5, 2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        creps(features, FEATURES, archive_size=80).init(start_policy(features, 30))


@pytest.mark.parametrize(("num_centers", "archive_size"), [(6, 30), (6, 36)])
def test_a_baseline_that_could_explain_all_of_the_archive_is_refused(num_centers, archive_size):
    baseline = rbf_features((0.0, 0.0), (1.0, 1.0), num_centers)
    algorithm = creps(FEATURES, baseline, archive_size=archive_size)
    with pytest.raises(ValueError, match=f"at least 37, one more than baseline.*got {archive_size}"):
        algorithm.init(START)


def test_a_large_baseline_is_warned_of_with_the_number_that_would_do():
    algorithm = creps(FEATURES, rbf_features((0.0, 0.0), (1.0, 1.0), 6), archive_size=60)
    with pytest.warns(UserWarning, match="archive_size should be at least 72.*36 baseline features, got 60"):
        algorithm.init(START)


@pytest.mark.parametrize("field", Batch._fields)
def test_failed_measurements_pass_where_jax_looks_out_for_nan(field):
    values = dict(zip(Batch._fields, (CONTEXTS, THETAS, REWARDS), strict=True))
    spoilt = values[field].copy()
    spoilt[3] = np.nan
    with jax.debug_nans(True):
        _, info = ALGORITHM.tell(ALGORITHM.init(START), Batch(**{**values, field: spoilt}))
    assert info.num_valid == NUM - 1


# Programs.


def test_functions_keep_their_documentation_and_settings():
    for name in ("init", "ask", "tell", "policy", "mean"):
        assert getattr(ALGORITHM, name).__doc__ == getattr(creps_functions, name).__doc__
        replaced = dataclasses.replace(ALGORITHM, **{name: lambda *arguments: None})
        assert replaced.settings is None and replaced.programs == {}
    assert ALGORITHM.settings.archive_size == NUM


def test_algorithms_are_data():
    for features in (FEATURES, rbf_features((0.0, 0.0), (1.0, 1.0), 2), polynomial_features(2, 2)):
        algorithm = creps(features, features, archive_size=NUM, m_step=bounded_ml())
        algorithm.programs  # noqa: B018  what is compiled must not be in the way
        for other in (pickle.loads(pickle.dumps(algorithm)), copy.deepcopy(algorithm)):
            assert other.programs is algorithm.programs


def test_equal_settings_share_programs_whatever_their_kl_bound_and_the_last_frees_them():
    def make(**settings):
        return creps(linear_features(2), linear_features(2), archive_size=41, m_step=bounded_ml(), **settings)

    first, second = make(), make(kl_bound=jnp.float32(0.2))
    assert first.programs is second.programs
    assert first.programs is not make(ridge=1e-3).programs
    kept = weakref.ref(first.settings.programs)
    del first
    gc.collect()
    assert kept() is not None
    del second
    gc.collect()
    assert kept() is None


def test_a_training_that_has_ended_is_freed():
    class Big:
        pass

    def study(number):
        big = Big()

        def rollout(key, context, theta):
            assert big is not None
            return PlainOutcome(-jnp.sum((theta - number) ** 2), jnp.zeros(0))

        task = Task(uniform_contexts(0.0, 1.0), rollout, 1, 1, worst_reward=-1e3)
        features = FeatureMap(
            lambda context: jnp.concatenate([jnp.ones(1), context, 0 * number + context**2]), 3, 1
        )
        algorithm = creps(features, features, archive_size=40)
        policy = LinearGaussian(np.zeros((3, 1)), np.eye(1))
        train(jax.random.key(0), task, algorithm, policy, iterations=2, samples=10)
        return weakref.ref(big)

    ended = study(2)
    gc.collect()
    assert ended() is None


def test_another_kl_bound_or_batch_size_compiles_no_update_anew():
    algorithm = creps(FEATURES, FEATURES, archive_size=43, m_step=bounded_ml())
    state, _ = algorithm.tell(algorithm.init(START), Batch(CONTEXTS[:9], THETAS[:9], REWARDS[:9]))
    with count_compilations() as compiled:
        other = creps(FEATURES, FEATURES, archive_size=43, m_step=bounded_ml(), kl_bound=np.float64(0.1))
        other.tell(state, Batch(CONTEXTS[:9], THETAS[:9], REWARDS[:9]))
        assert not compiled
        for num in (5, 6):
            algorithm.tell(state, Batch(CONTEXTS[:num], THETAS[:num], REWARDS[:num]))
    # Only what puts a batch into the archive knows its size.
    assert len(compiled) == 2


def test_a_policy_of_tiny_spread_is_searched_in_float64():
    with jax.enable_x64(True):
        features = linear_features(1)
        algorithm = creps(features, features, archive_size=NUM)
        policy = LinearGaussian(np.array([[1.0], [0.0]]), 1e-9 * np.eye(1))
        state = algorithm.init(policy)
        contexts = CONTEXTS[:, :1]
        thetas = np.asarray(algorithm.ask(jax.random.key(0), state, contexts))
        assert thetas.dtype == np.float64 and len(np.unique(thetas)) == NUM
        state, info = algorithm.tell(state, Batch(contexts, thetas, 1e9 * (thetas[:, 0] - 1)))
        assert info.is_updated and state.policy.coef[0, 0] > 1.0


@pytest.mark.parametrize("dtype", [np.float16, np.float32, jnp.bfloat16, jnp.float32])
def test_the_rounding_is_that_of_the_format_the_rewards_were_told_in(dtype):
    """Rewards coarser than the archive, which is of another format, are not taken for exact."""
    with jax.enable_x64(True):
        rewards = np.asarray(REWARDS, np.float64)
        start = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), START)
        algorithm = creps(FEATURES, FEATURES, archive_size=NUM)
        given = jnp.asarray(rewards, dtype) if dtype in (jnp.bfloat16, jnp.float32) else rewards.astype(dtype)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # bfloat16 is as coarse as this
            _, info = algorithm.tell(algorithm.init(start), Batch(CONTEXTS, THETAS, given))
        expected = 1.75 * float(jnp.finfo(dtype).eps) * np.abs(rewards).max() / np.ptp(rewards)
        assert float(info.reward_rounding) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_search_with_cubic_features_is_the_same_in_any_unit_of_the_context(unit):
    def rollout(key, context, theta):
        s = context[0] / unit
        return PlainOutcome(-((theta[0] - s + 2.0 * s**3) ** 2), jnp.zeros(0))

    features = polynomial_features(1, 3)
    algorithm = creps(features, features, archive_size=100)
    task = Task(uniform_contexts(-unit, unit), rollout, 1, 1, worst_reward=-100.0)
    start = LinearGaussian(jnp.zeros((4, 1)), jnp.eye(1))
    state, log = train(jax.random.key(3), task, algorithm, start, iterations=40, samples=20)
    assert float(log.mean_reward[0]) < -0.5 and float(log.mean_reward[-1]) > -0.05
    contexts = unit * jnp.linspace(-1.0, 1.0, 11)[:, None]
    expected = contexts / unit - 2.0 * (contexts / unit) ** 3
    np.testing.assert_allclose(algorithm.mean(state.policy, contexts), expected, atol=0.2)
    algorithm.init(state.policy)  # what was learned is where the next search can begin


def test_a_sweep_of_kl_bounds_through_train_compiles_once_and_is_that_of_the_numbers():
    def rollout(key, context, theta):
        return PlainOutcome(-jnp.sum((theta - context[0]) ** 2), jnp.zeros(0))

    task = Task(uniform_contexts((0.0, 0.0), (1.0, 1.0)), rollout, 2, DIM, worst_reward=-100.0)

    coefs, compilations = [], []
    for kl_bound in (0.2, 0.7, jnp.float32(0.2), np.float64(0.7)):
        # Each takes the place of the last one, which is then freed.
        algorithm = creps(FEATURES, FEATURES, archive_size=44, kl_bound=kl_bound)
        with count_compilations() as compiled:
            state, _ = train(jax.random.key(0), task, algorithm, START, iterations=3, samples=20)
        coefs.append(np.asarray(state.policy.coef))
        compilations.append(len(compiled))
    assert compilations[0] > 0 and not any(compilations[1:])
    np.testing.assert_array_equal(coefs[2:], coefs[:2])
    assert not np.array_equal(coefs[0], coefs[1])


@pytest.mark.parametrize("bad", [-1.0, 0.0, float("nan"), "x"])
def test_another_kl_bound_is_checked_as_the_first_one(bad):
    with pytest.raises((ValueError, TypeError), match="kl_bound"):
        ALGORITHM.with_kl_bound(bad)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kl_bound": -1.0}, "kl_bound must be finite and above 0, got -1"),
        ({"significance": 7}, "significance must be above 0 and at most 1, or None, got 7"),
        ({"significance": "x"}, "significance must be a number, got 'x'"),
        ({"archive_size": "x"}, "archive_size must be a whole number, got 'x'"),
        ({"importance": 3}, "importance must be of type Importance, got 3"),
        ({"kind": 3}, "kind must be of type Policy, got 3"),
        ({"baseline_features": 3}, "baseline_features must be of type FeatureMap, got 3"),
        ({"baseline_features": linear_features(9)}, "must be of the same context, got 2 and 9 variables"),
    ],
)
def test_changed_settings_are_checked_as_the_first_ones(change, message):
    with pytest.raises(ValueError, match=message):
        ALGORITHM.with_settings(**change)


def test_changed_settings_hold_the_kl_bound_in_single_precision():
    assert ALGORITHM.with_settings(kl_bound=0.1).settings.kl_bound.dtype == np.float32


def test_an_algorithm_with_another_function_refuses_another_kl_bound():
    other = dataclasses.replace(ALGORITHM, ask=lambda key, state, contexts: contexts)
    with pytest.raises(ValueError, match=r"algorithm must be made by creps\(\) to change its settings"):
        other.with_kl_bound(0.1)
    assert other.with_traced(other.traced).ask is other.ask


def test_equal_rewards_keep_the_policy_however_often_they_are_told():
    state = ALGORITHM.init(START)
    for _ in range(150):
        chosen = RNG.integers(0, NUM, 7)
        batch = Batch(CONTEXTS[chosen], THETAS[chosen], np.full(7, 3.3))
        new, info = ALGORITHM.tell(state, batch)
        assert_kept(state, new, info)
        state = new
    assert int(state.iteration) == 150


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_rewards_that_are_coarse_in_the_format_they_were_told_in_are_warned_of(dtype):
    offset = {np.float16: 2e4, np.float32: 1e7}[dtype]
    with pytest.warns(UserWarning, match="batch.reward has a spread of"):
        tell((offset + 3.0 * REWARDS).astype(dtype))


@pytest.mark.parametrize("size", [1e-300, 1e-150, 1e-50, 1e-30, 1e30, 1e60, 1e300])
def test_only_the_ratios_of_what_counts_matter_even_where_single_precision_ends(size):
    features = np.concatenate([np.ones((NUM, 1)), CONTEXTS], axis=1)
    valid = np.linspace(0.5, 1.0, NUM)

    def results(valid):
        solution = cj.solve_dual(REWARDS, features, valid, kl_bound=0.5)
        return solution, cj.sample_weights(solution, REWARDS, features, valid)

    for found, expected in zip(*map(jax.tree.leaves, (results(valid * size), results(valid))), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-6)
