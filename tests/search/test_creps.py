"""Ask and tell as a user with a robot calls them: hand-made batches, failed measurements, wrong shapes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from creps_jax.policies import gaussian
from creps_jax.policies.features import linear_features, quadratic_features, rbf_features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.search.archive import Batch
from creps_jax.search.creps import CrepsState, creps
from creps_jax.search.dual import sample_weights
from creps_jax.search.fit import bounded_ml, weighted_ml
from creps_jax.search.importance import Importance

ARCHIVE_SIZE, NUM, THETA_DIM = 60, 40, 2
ALGORITHM = creps(linear_features(1), quadratic_features(1), archive_size=ARCHIVE_SIZE)
ASK, TELL, MEAN = jax.jit(ALGORITHM.ask), jax.jit(ALGORITHM.tell), jax.jit(ALGORITHM.mean)


@pytest.fixture
def state() -> CrepsState:
    coef = jnp.asarray([[1.0, -1.0], [0.5, 2.0]])
    return ALGORITHM.init(LinearGaussian(coef, jnp.asarray([[1.0, 0.0], [0.5, 0.3]])))


@pytest.fixture
def batch(key, state) -> Batch:
    contexts = jax.random.normal(key, (NUM, 1))
    thetas = ASK(key, state, contexts)
    return Batch(contexts, thetas, -jnp.sum((thetas - contexts) ** 2, axis=1))


def all_finite(tree) -> bool:
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


def assert_same(left, right, **tolerance):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, **tolerance), left, right)


def test_asks_from_the_policy(key, state):
    num, context = 20_000, 0.7
    thetas = np.asarray(ASK(key, state, jnp.full((num, 1), context)), np.float64)
    mean = np.asarray(state.policy.coef[0] + context * state.policy.coef[1])
    cov = np.asarray(state.policy.cov_chol @ state.policy.cov_chol.T)
    np.testing.assert_allclose(thetas.mean(0), mean, atol=5 * np.sqrt(cov.max() / num))
    np.testing.assert_allclose(np.cov(thetas.T), cov, atol=10 * cov.max() / np.sqrt(num))
    np.testing.assert_allclose(MEAN(state.policy, jnp.full((1, 1), context))[0], mean, rtol=1e-6)


def test_rewards_pull_the_policy_towards_better_parameters(state, batch):
    new_state, info = TELL(state, batch)
    better = -np.sum((MEAN(new_state.policy, batch.context) - batch.context) ** 2, axis=1).mean()
    worse = -np.sum((MEAN(state.policy, batch.context) - batch.context) ** 2, axis=1).mean()
    assert better > worse
    assert info.is_updated and new_state.iteration == 1 and new_state.archive.size == NUM


def test_info_agrees_with_its_definitions(state, batch):
    new_state, info = TELL(state, batch)
    features = jax.vmap(quadratic_features(1).apply)(batch.context)
    weights = np.asarray(sample_weights(info.dual, batch.reward, features), np.float64)
    assert info.kl == pytest.approx(scipy.stats.entropy(weights, np.full(NUM, 1 / NUM)), rel=1e-4)
    assert info.kl == pytest.approx(0.5, rel=1e-3)
    assert info.effective_samples == pytest.approx(1 / np.sum(weights**2), rel=1e-4)
    assert info.num_valid == NUM
    cov = np.asarray(new_state.policy.cov_chol @ new_state.policy.cov_chol.T, np.float64)
    assert info.entropy == pytest.approx(scipy.stats.multivariate_normal(cov=cov).entropy(), rel=1e-4)
    phi = jax.vmap(linear_features(1).apply)(batch.context)
    kls = jax.vmap(gaussian.kl, (None, None, 0))(new_state.policy, state.policy, phi)
    assert info.policy_kl == pytest.approx(float(kls.mean()), rel=1e-4)


def test_the_context_does_not_have_to_be_explained_by_the_reward(state, batch):
    """A reward that depends on the context alone says nothing of the parameters."""
    features = np.stack([batch.context[:, 0], batch.context[:, 0] ** 2], axis=1)
    shifted = batch._replace(reward=batch.reward + jnp.asarray(features @ [300.0, -50.0], jnp.float32))
    assert_same(TELL(state, batch)[0].policy, TELL(state, shifted)[0].policy, rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize("field", Batch._fields)
def test_failed_measurements_are_left_out(state, batch, field):
    failed = np.arange(NUM) % 2 == 1
    mask = failed.reshape(-1, *[1] * (getattr(batch, field).ndim - 1))
    spoilt = batch._replace(**{field: jnp.where(mask, jnp.nan, getattr(batch, field))})
    new_state, info = TELL(state, spoilt)
    expected, expected_info = TELL(state, jax.tree.map(lambda x: x[~failed], batch))
    assert info.num_valid == expected_info.num_valid == NUM - failed.sum()
    assert_same(new_state.policy, expected.policy, rtol=1e-4, atol=1e-5)
    # They do not come back to life later either.
    later, later_info = TELL(new_state, batch)
    assert all_finite((later.policy, later_info)) and later_info.is_updated


@pytest.mark.parametrize(
    "spoil",
    [
        lambda b: b._replace(reward=jnp.full(NUM, jnp.nan)),
        lambda b: b._replace(reward=jnp.full(NUM, -jnp.inf)),
        lambda b: b._replace(theta=b.theta.at[3:].set(jnp.inf)),
    ],
    ids=["all nan", "all -inf", "three left"],
)
def test_keeps_the_policy_while_there_are_too_few_samples(state, batch, spoil):
    new_state, info = TELL(state, spoil(batch))
    assert_same(new_state.policy, state.policy, rtol=0)
    assert all_finite(info) and not info.is_updated and info.policy_kl == pytest.approx(0, abs=1e-5)
    # The run goes on as if nothing had happened.
    assert TELL(new_state, batch)[1].is_updated


def test_samples_told_in_small_batches_add_up(state, batch):
    for part in (slice(0, NUM // 2), slice(NUM // 2, NUM)):
        state, info = TELL(state, jax.tree.map(lambda x, part=part: x[part], batch))
    assert info.num_valid == NUM and state.iteration == 2
    np.testing.assert_array_equal(state.archive.batch.reward[:NUM], batch.reward)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda b: b._replace(reward=jnp.full(NUM, 7.0)),
        lambda b: b._replace(reward=b.reward.at[5].set(1e9)),
        lambda b: b._replace(reward=b.reward.at[5].set(-3e38)),
        lambda b: b._replace(theta=jnp.broadcast_to(b.theta[:1], b.theta.shape)),
        lambda b: b._replace(context=jnp.ones_like(b.context)),
        lambda b: jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), b),
        lambda b: b._replace(theta=1e15 * b.theta),
    ],
    ids=["one reward", "one best", "one worst", "one theta", "one context", "one sample", "huge thetas"],
)
def test_stays_finite_and_usable_whatever_is_told(key, state, batch, spoil):
    for _ in range(3):
        state, info = TELL(state, spoil(batch))
    assert all_finite((state, info))
    assert np.all(np.diagonal(state.policy.cov_chol) > 0)
    assert all_finite(ASK(key, state, batch.context))


def test_a_person_with_a_robot_learns_with_numpy_arrays():
    """NumPy in float64 in, no simulator: theta = [2 s, 1 - s] is best."""
    state = ALGORITHM.init(LinearGaussian(np.zeros((2, 2)), np.eye(2)))
    rng = np.random.default_rng(0)
    for iteration in range(40):
        contexts = rng.uniform(-1, 1, (NUM, 1))
        thetas = np.asarray(ASK(jax.random.key(iteration), state, contexts), np.float64)
        errors = thetas - np.hstack([2 * contexts, 1 - contexts])
        rewards = -np.sum(errors**2, axis=1)
        rewards[rng.random(NUM) < 0.1] = np.nan  # The robot fell off the table.
        state, _ = TELL(state, Batch(contexts, thetas, rewards))
    np.testing.assert_allclose(state.policy.coef, [[0, 1], [2, -1]], atol=0.02)


def test_takes_any_features_and_several_contexts(key):
    rbf = rbf_features((0.0, 0.0), (1.0, 1.0), 3)
    algorithm = creps(rbf, quadratic_features(2), archive_size=50)
    state = algorithm.init(LinearGaussian(jnp.zeros((9, 3)), jnp.eye(3)))
    contexts = jax.random.uniform(key, (30, 2))
    state, info = jax.jit(algorithm.tell)(state, Batch(contexts, contexts @ jnp.ones((2, 3)), contexts[:, 0]))
    assert all_finite((state, info))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kl_bound": 0}, "kl_bound must be finite and above 0, got 0"),
        ({"kl_bound": float("nan")}, "got nan"),
        ({"archive_size": 0}, "archive_size must be at least 1, got 0"),
        ({"ridge": -1.0}, "ridge must be finite and at least 0, got -1.0"),
        ({"baseline_features": linear_features(3)}, "same context, got 1 and 3"),
        ({"m_step": bounded_ml}, r"such as bounded_ml\(\), got bounded_ml without its parentheses"),
    ],
)
def test_refuses_settings_out_of_range(settings, message):
    features = {"policy_features": linear_features(1), "baseline_features": quadratic_features(1)}
    with pytest.raises(ValueError, match=message):
        creps(**{**features, "archive_size": 10, **settings})


@pytest.mark.parametrize(
    ("coef", "cov_chol", "message"),
    [
        ((3, 2), (2, 2), r"coef \(2, d\).*got \(3, 2\) and \(2, 2\)"),
        ((2, 2), (3, 3), r"cov_chol \(d, d\), got \(2, 2\) and \(3, 3\)"),
        ((2,), (2, 2), r"got \(2,\) and \(2, 2\)"),
    ],
)
def test_refuses_a_policy_that_does_not_fit(coef, cov_chol, message):
    with pytest.raises(ValueError, match=message):
        ALGORITHM.init(LinearGaussian(jnp.zeros(coef), jnp.ones(cov_chol)))


def test_refuses_an_archive_that_no_policy_could_be_fitted_to():
    algorithm = creps(linear_features(1), quadratic_features(1), archive_size=4)
    with pytest.raises(ValueError, match="at least 5, the number of features and parameters, got 4"):
        algorithm.init(LinearGaussian(jnp.zeros((2, 3)), jnp.eye(3)))


def test_the_archive_has_five_samples_a_fitted_number_by_default(key):
    features, baseline = linear_features(1), quadratic_features(1)
    start = LinearGaussian(jnp.zeros((2, 3)), jnp.eye(3))
    assert creps(features, baseline).init(start).archive.batch.reward.shape == (25,)
    algorithm = creps(features, rbf_features(0.0, 1.0, 12))
    state = algorithm.init(start)
    assert state.archive.batch.reward.shape == (60,)
    contexts = jnp.linspace(0.0, 1.0, 30)[:, None]
    thetas = algorithm.ask(key, state, contexts)
    state, info = algorithm.tell(state, Batch(contexts, thetas, thetas[:, 0]))
    assert int(info.num_valid) == 30


@pytest.mark.parametrize("shape", [(1,), (4, 2), (0, 1), (4, 1, 1)])
def test_refuses_contexts_of_the_wrong_shape(key, state, shape):
    for call in (lambda c: ALGORITHM.ask(key, state, c), lambda c: ALGORITHM.mean(state.policy, c)):
        with pytest.raises(
            ValueError, match=r"contexts must have shape \(n, 1\) for features of 1 context variables, got"
        ) as error:
            call(jnp.zeros(shape))
        assert str(shape) in str(error.value)


def test_refuses_contexts_that_are_not_finite(key, state):
    for call in (lambda c: ALGORITHM.ask(key, state, c), lambda c: ALGORITHM.mean(state.policy, c)):
        with pytest.raises(ValueError, match="contexts must be finite, got nan"):
            call(np.array([[0.5], [np.nan]]))
        np.testing.assert_array_equal(
            jax.jit(call)(jnp.full((1, 1), jnp.nan)), np.full((1, THETA_DIM), np.nan)
        )


BESIDE = r"beside batch.reward \(5,\)"


@pytest.mark.parametrize(
    ("shapes", "message"),
    [
        (((5, 1), (5, 2), (5, 1)), r"batch.reward must have shape \(n,\), got \(5, 1\)"),
        (((5, 1), (5, 2), (0,)), r"batch.reward must have shape \(n,\), got \(0,\)"),
        (((5,), (5, 2), (5,)), rf"batch.context must have shape \(5, 1\) {BESIDE}, got \(5,\)"),
        (((4, 1), (5, 2), (5,)), rf"batch.context must have shape \(5, 1\) {BESIDE}, got \(4, 1\)"),
        (((5, 1), (5, 3), (5,)), rf"batch.theta must have shape \(5, 2\) {BESIDE}, got \(5, 3\)"),
    ],
)
def test_refuses_batches_of_the_wrong_shape(state, shapes, message):
    with pytest.raises(ValueError, match=message):
        ALGORITHM.tell(state, Batch(*(jnp.zeros(shape) for shape in shapes)))


@pytest.mark.parametrize(
    ("m_step", "importance"),
    [(weighted_ml, None), (bounded_ml(), Importance())],
    ids=["the paper's", "bounded, importance weights"],
)
def test_a_search_does_not_know_the_units_of_parameters_and_contexts(m_step, importance):
    """The same search, with parameters and the context in other units and from other zeros."""
    unit, zero = np.float32([1e-3, 1.0, 200.0]), np.float32([1.0, -3.0, 50.0])
    context_unit, context_zero = 0.1, 5.0
    features = linear_features(1)
    algorithm = creps(features, features, archive_size=120, m_step=m_step, importance=importance)
    ask, tell = algorithm.ask, algorithm.tell

    def search(convert_theta, convert_context, start):
        state, best = algorithm.init(start), []
        for iteration in range(12):
            key = jax.random.fold_in(jax.random.key(0), iteration)
            contexts = np.random.default_rng(iteration).uniform(0, 1, (40, 1)).astype(np.float32)
            asked = ask(key, state, convert_context(contexts))
            thetas = convert_theta(np.asarray(asked))
            reward = -np.sum((thetas - np.float32([1.0, -1.0, 2.0]) * contexts) ** 2, axis=1)
            state, _ = tell(state, Batch(jnp.asarray(convert_context(contexts)), asked, jnp.asarray(reward)))
            best.append(reward.mean())
        return np.array(best), thetas

    plain = search(lambda x: x, lambda s: s, LinearGaussian(jnp.zeros((2, 3)), jnp.eye(3)))
    other = search(
        lambda x: (x - zero) / unit,
        lambda s: context_unit * s + context_zero,
        LinearGaussian(jnp.asarray([zero, 0 * zero]), jnp.diag(jnp.asarray(unit))),
    )
    assert plain[0][-1] > 0.05 * plain[0][0]
    np.testing.assert_allclose(other[0], plain[0], rtol=0.02)
    np.testing.assert_allclose(other[1], plain[1], atol=0.05 * plain[1].std())
