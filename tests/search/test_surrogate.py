"""Search by a quadratic model: exact on quadratics, robust to falls, and contextual REPS elsewhere."""

import pickle

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import creps_jax as cj
from creps_jax.search.surrogate_fit import fit_quadratic
from creps_jax.search.surrogate_update import SurrogateInfo, surrogate_update

DIM, FEATURES = 4, cj.linear_features(1)
SEARCH = cj.surrogate(FEATURES, archive_size=120)
START = cj.start_policy(FEATURES, DIM)
SLOPE = jnp.asarray([1.0, -0.5, 0.3, 2.0])
CURVATURE = jnp.asarray([[3.0, 1, 0, 0], [1, 2, 0, 0], [0, 0, 1, 0.5], [0, 0, 0.5, 4]])


def quadratic(context, theta):
    error = theta - SLOPE.astype(theta.dtype) * context - 0.7
    return -error @ CURVATURE.astype(theta.dtype) @ error


def task(reward=quadratic, dim=DIM):
    def rollout(key, context, theta):
        return cj.PlainOutcome(reward(context, theta), jnp.zeros(0))

    return cj.Task(cj.uniform_contexts(-1.0, 1.0), rollout, 1, dim, worst_reward=-1e6)


def batch_of(key, state, num=100, reward=quadratic, search=SEARCH):
    context_key, theta_key = jax.random.split(key)
    contexts = jax.random.uniform(context_key, (num, 1), state.policy.coef.dtype, -1.0, 1.0)
    thetas = search.ask(theta_key, state, contexts)
    return cj.Batch(contexts, thetas, jax.vmap(reward)(contexts, thetas))


def regret(search, policy):
    contexts = jnp.linspace(-1, 1, 9)[:, None]
    return -float(jax.vmap(quadratic)(contexts, search.mean(policy, contexts)).mean())


def learn(key, search, iterations=14, samples=15, **kwargs):
    return cj.train(key, task(**kwargs), search, START, iterations=iterations, samples=samples)


def test_a_quadratic_is_solved_in_far_fewer_episodes_than_by_contextual_reps(key):
    state, log = learn(key, SEARCH)
    other = cj.creps(FEATURES, archive_size=60, m_step=cj.bounded_ml())
    assert regret(SEARCH, state) < 1e-8
    assert regret(other, learn(key, other, iterations=40)[0].policy) > 1e-4
    assert log.info.is_by_model[-1] and log.info.model_r2[-1] > 0.999


def test_a_step_is_exact_on_a_quadratic(key):
    state = SEARCH.with_kl_bound(1e3).init(START)
    found, info = SEARCH.with_kl_bound(1e3).tell(state, batch_of(key, state))
    expected = np.stack([np.full(DIM, 0.7), SLOPE])
    np.testing.assert_allclose(found.policy.coef, expected, atol=1e-2)
    assert info.is_by_model and info.num_left_out == 0
    # The bound on the mean is met with equality; the policy also changes its covariance, by much less.
    near, info = SEARCH.with_kl_bound(0.01).tell(state, batch_of(key, state))
    rows = FEATURES(batch_of(key, state).context)
    shifts = rows @ (near.policy.coef - START.coef)
    np.testing.assert_allclose(0.5 * np.mean(np.sum(shifts**2, axis=1)), 0.01, rtol=1e-2)
    covariance_part = float(info.policy_kl) - 0.01
    assert 0.0 < covariance_part < 0.5


@pytest.mark.parametrize(("scale", "shift"), [(1e-4, 0.0), (1e3, 0.0), (1.0, 50.0)])
def test_unit_and_zero_of_rewards_do_not_matter(key, scale, shift):
    state = SEARCH.init(START)
    batch = batch_of(key, state)
    expected, _ = SEARCH.tell(state, batch)
    found, _ = SEARCH.tell(state, batch._replace(reward=scale * batch.reward + shift))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=5e-4), found.policy, expected.policy)


def test_affine_maps_of_the_parameters_do_not_matter(key):
    state = SEARCH.init(START)
    batch = batch_of(key, state)
    factor = jnp.asarray(np.tril(np.random.default_rng(0).normal(size=(DIM, DIM)) * 0.3), jnp.float32)
    factor = factor + 2.0 * jnp.eye(DIM)
    offset = jnp.arange(4.0)
    moved = cj.LinearGaussian((START.coef @ factor.T).at[0].add(offset), factor @ START.cov_chol)
    expected, _ = SEARCH.tell(state, batch)
    found, info = SEARCH.tell(SEARCH.init(moved), batch._replace(theta=batch.theta @ factor.T + offset[None]))
    assert info.is_by_model
    np.testing.assert_allclose(
        found.policy.coef, (expected.policy.coef @ factor.T).at[0].add(offset), atol=2e-3
    )
    cov = found.policy.cov_chol @ found.policy.cov_chol.T
    root = factor @ expected.policy.cov_chol
    np.testing.assert_allclose(cov, root @ root.T, rtol=2e-3, atol=2e-3)


def test_values_that_are_not_finite_are_not_used(key):
    state = SEARCH.init(START)
    batch = batch_of(key, state)
    reward = batch.reward.at[::10].set(jnp.nan)
    found, info = SEARCH.tell(state, batch._replace(reward=reward))
    kept = np.isfinite(reward)
    expected, _ = SEARCH.tell(state, jax.tree.map(lambda x: x[kept], batch))
    assert info.is_by_model and int(info.num_valid) <= 90
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-3), found.policy, expected.policy)


def test_falls_are_left_out(key):
    def falling(context, theta):
        return jnp.where(jnp.sin(1e4 * theta[0]) > 0.951, -1e3, quadratic(context, theta))

    state, log = learn(key, SEARCH, iterations=25, reward=falling)
    assert regret(SEARCH, state) < 1e-6
    assert log.info.num_left_out[-1] > 0 and log.info.is_by_model[-1]


def test_the_model_is_not_used_where_falls_depend_on_the_parameters(key):
    state = SEARCH.init(START)
    batch = batch_of(key, state)
    is_far = batch.theta[:, 0] > jnp.sort(batch.theta[:, 0])[-12]
    for is_fall, is_by_model in ((is_far, False), (jax.random.permutation(key, is_far), True)):
        _, info = SEARCH.tell(state, batch._replace(reward=jnp.where(is_fall, -1e4, batch.reward)))
        assert 5 < info.num_left_out <= 11 and info.model_r2 > 0.9
        assert bool(info.is_by_model) is is_by_model


def test_trials_are_those_of_single_runs(key):
    keys = jax.random.split(key, 2)
    settings = {"iterations": 4, "samples": 40}
    states, _ = cj.train_trials(keys, task(), SEARCH, START, **settings)
    for trial in range(2):
        state, _ = cj.train(keys[trial], task(), SEARCH, START, **settings)
        np.testing.assert_allclose(states.policy.coef[trial], state.policy.coef, atol=5e-3)


def test_without_a_model_the_update_is_that_of_contextual_reps(key):
    other = cj.creps(FEATURES, archive_size=120, m_step=cj.bounded_ml())
    search = cj.surrogate(FEATURES, archive_size=120)
    state, creps_state = search.init(START), other.init(START)
    batch = batch_of(key, state, num=60)
    noise = jax.random.normal(key, (60,))
    found, info = search.tell(state, batch._replace(reward=noise))
    expected, expected_info = other.tell(creps_state, batch._replace(reward=noise))
    assert not info.is_by_model and info.model_r2 < 0.8
    jax.tree.map(np.testing.assert_array_equal, found.policy, expected.policy)
    for field in expected_info._fields:
        jax.tree.map(np.testing.assert_array_equal, getattr(info, field), getattr(expected_info, field))


def test_equal_rewards_keep_the_policy(key):
    state = SEARCH.init(START)
    found, info = SEARCH.tell(state, batch_of(key, state)._replace(reward=jnp.ones(100)))
    jax.tree.map(np.testing.assert_array_equal, found.policy, state.policy)
    assert not info.is_updated and not info.is_by_model


def test_float64(key):
    with jax.enable_x64(True):
        start = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), START)
        search = cj.surrogate(FEATURES, archive_size=120)
        state = search.init(start)
        for number in range(14):
            step_key = jax.random.fold_in(key, number)
            state, info = search.tell(state, batch_of(step_key, state, num=20, search=search))
        assert state.policy.coef.dtype == info.model_r2.dtype == jnp.float64
        assert regret(search, state) < 1e-14


def test_the_model_of_a_quadratic_is_exact(key):
    z = jax.random.normal(key, (80, DIM))
    ones = jnp.ones((80, 1))
    reward = 5.0 + z @ SLOPE - 0.5 * jnp.sum((z @ CURVATURE) * z, axis=1)
    model = fit_quadratic(z, ones, ones, reward, jnp.ones(80, bool), has_products=True)
    # In units of the deviation of the rewards.
    np.testing.assert_allclose(model.curvature / model.curvature[0, 0], CURVATURE / 3.0, atol=1e-3)
    np.testing.assert_allclose(model.slope[:, 0] / model.curvature[0, 0], SLOPE / 3.0, atol=1e-3)
    diagonal = fit_quadratic(z, ones, ones, reward, jnp.ones(80, bool), has_products=False)
    assert np.count_nonzero(diagonal.curvature) <= DIM and diagonal.r2 < model.r2


def test_a_search_can_be_pickled_and_resumed(key):
    state, _ = learn(key, SEARCH, iterations=6)
    half, _ = learn(key, SEARCH, iterations=3)
    search = pickle.loads(pickle.dumps(SEARCH))
    resumed, _ = cj.train(key, task(), search, half, iterations=3, samples=15)
    jax.tree.map(np.testing.assert_array_equal, resumed, state)


def test_another_bound_compiles_nothing_anew():
    assert SEARCH.with_kl_bound(0.1).settings.compiled(surrogate_update) is SEARCH.settings.compiled(
        surrogate_update
    )
    assert SEARCH.with_settings(gate=0.9).settings.gate == 0.9


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gate": 0.0}, "gate must be above 0 and at most 1, got 0.0"),
        ({"gate": 2}, "gate must be above 0 and at most 1, got 2"),
        ({"kl_bound": -1.0}, r"kl_bound must be above 0, got -1\.0|kl_bound must be .*, got -1\.0"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        cj.surrogate(FEATURES, **settings)


def test_states_of_another_search_are_refused():
    other = cj.creps(FEATURES, archive_size=120)
    with pytest.raises(ValueError, match="state must be of type SurrogateState, got CrepsState"):
        SEARCH.policy(other.init(START))
    with pytest.raises(ValueError, match="importance must be None for a surrogate"):
        SEARCH.with_settings(importance=cj.Importance())


def test_an_archive_too_small_for_the_model_is_warned_of():
    features = cj.linear_features(2)
    start = cj.start_policy(features, 20)
    with pytest.warns(UserWarning, match=r"at least 130, with which the model .* can be used, got 129"):
        cj.surrogate(features, archive_size=129).init(start)


def test_a_large_model_without_products_leaves_out_old_samples_far_from_the_policy(key):
    # 40 parameters would have 780 products: the model has 40 curvatures instead.
    features = cj.linear_features(2)
    search = cj.surrogate(features)
    state = search.init(cj.start_policy(features, 40))
    size = len(state.archive.batch.reward)
    contexts = np.random.default_rng(0).uniform(size=(size, 2)).astype(np.float32)
    thetas = search.ask(key, state, contexts)
    # All but the last 300 samples are far from the policy.
    thetas = np.array(thetas)
    thetas[:-300] *= 10.0
    rewards = -np.sum((thetas - 1.0) ** 2, axis=1)
    _, info = search.tell(state, cj.Batch(contexts, thetas, rewards))
    assert 300 <= int(info.num_fitted) + int(info.num_left_out) < size // 2


def test_the_diagnostics_begin_with_those_of_contextual_reps():
    assert SurrogateInfo._fields[: len(cj.CrepsInfo._fields)] == cj.CrepsInfo._fields
