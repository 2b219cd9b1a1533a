"""A network learns what linear features cannot, within its bounds, in any units, and ignores bad samples."""

import copy
import pickle
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import creps_jax as cj
from creps_jax import checkpoints
from creps_jax.policies.base import WeightedSamples
from creps_jax.policies.network import Layer, NetworkGaussian, network_policy, start_network

LOW, HIGH = (-1.0, 0.0), (1.0, 4.0)
KIND = network_policy(LOW, HIGH, steps=20)
BOUNDS = KIND.fit.mean_kl_bound, KIND.fit.cov_kl_bound


def bent_task(scale=1.0):
    """Return a task whose best parameters are bends of two contexts."""

    def rollout(key, context, theta):
        x, y = context[0], 0.5 * context[1] - 1.0
        best = jnp.stack([jnp.sin(3.0 * x * y), jnp.abs(x + y)])
        return cj.PlainOutcome(-jnp.sum((theta / scale - best) ** 2), jnp.zeros(0))

    return cj.Task(cj.uniform_contexts(LOW, HIGH), rollout, 2, 2, worst_reward=-1e9)


def grid_regret(task, algorithm, state):
    grid = cj.context_grid(LOW, HIGH, 7)
    return -float(cj.evaluate(jax.random.key(0), task, grid, algorithm.mean(state, grid)).reward.mean())


@pytest.fixture(scope="module")
def problem():
    """Return a state that is not the same for all contexts, and samples whose weights prefer some of them."""
    keys = jax.random.split(jax.random.key(3), 4)
    state = start_network(keys[0], KIND.features, 3, hidden=(8, 6), std=(0.1, 1.0, 20.0))
    state = state._replace(coef=jax.random.normal(keys[1], state.coef.shape) * jnp.array([[0.1, 1.0, 20.0]]))
    contexts = jax.random.uniform(keys[2], (80, 2), minval=jnp.array(LOW), maxval=jnp.array(HIGH))
    features = KIND.features(contexts)
    theta = KIND.sample(keys[3], state, features)
    weights = jax.nn.softmax(2.0 * theta[:, 1] + 10.0 * theta[:, 0] * contexts[:, 0])
    return state, WeightedSamples(features, theta, weights, jnp.ones(80, bool))


def test_the_first_state_is_the_same_for_every_context(key):
    features = network_policy(LOW, HIGH).features
    state = start_network(key, features, 3, hidden=(8, 4), mean=(1.0, 2.0, 3.0), std=0.5)
    assert [layer.weight.shape for layer in state.layers] == [(2, 8), (8, 4)]
    means = KIND.mean(state, features(cj.context_grid(LOW, HIGH, 5)))
    np.testing.assert_allclose(means, np.tile([1.0, 2.0, 3.0], (25, 1)), rtol=1e-6)
    np.testing.assert_array_equal(state.cov_chol, 0.5 * np.eye(3))
    same = start_network(key, features, 3, hidden=(8, 4), mean=(1.0, 2.0, 3.0), std=0.5)
    jax.tree.map(np.testing.assert_array_equal, state, same)


def test_features_are_polynomials_of_the_scaled_context():
    np.testing.assert_allclose(KIND.features(jnp.array([1.0, 1.0])), [1, 1, -0.5, 1, -0.5, 0.25], rtol=1e-6)
    large = network_policy(-3e38, 3e38).features
    np.testing.assert_allclose(large(jnp.array([3e38])), [1.0, 1.0, 1.0], rtol=1e-5)


def test_a_network_learns_what_linear_features_cannot(key):
    task = bent_task()
    settings = {"iterations": 40, "samples": 40}
    linear = cj.linear_features(2)
    algorithm = cj.creps(linear, m_step=cj.bounded_ml(), archive_size=200)
    state, _ = cj.train(key, task, algorithm, cj.start_policy(linear, 2), **settings)
    of_linear = grid_regret(task, algorithm, state)
    kind = network_policy(LOW, HIGH, steps=50)
    algorithm = cj.creps(kind, archive_size=200)
    start = start_network(key, kind.features, 2)
    state, log = cj.train(key, task, algorithm, start, **settings)
    assert log.info.is_updated[5:].all()
    assert grid_regret(task, algorithm, state) < 0.15 * of_linear
    # Importance weights need the log density.
    algorithm = cj.creps(kind, archive_size=200, importance=cj.Importance())
    state, _ = cj.train(key, task, algorithm, start, **settings)
    assert grid_regret(task, algorithm, state) < 0.3 * of_linear


def parts(new, old, samples):
    """Return the mean's and the covariance's part of the relative entropy, by the book, in float64."""
    inverse = np.linalg.inv(np.asarray(old.cov_chol, float))
    shift = np.asarray(KIND.mean(new, samples.features) - KIND.mean(old, samples.features), float)
    squares = np.sum((shift @ inverse.T) ** 2, axis=1)[np.asarray(samples.is_valid)]
    change = inverse @ np.asarray(new.cov_chol, float)
    change = change @ change.T
    return 0.5 * squares.mean(), 0.5 * (np.trace(change) - len(change) - np.linalg.slogdet(change)[1])


@pytest.mark.parametrize("bounds", [(0.3, 0.02), (0.1, 0.1), (1e-3, 1e-3)])
def test_the_change_is_within_its_bounds(problem, bounds):
    old, samples = problem
    kind = network_policy(LOW, HIGH, mean_kl_bound=bounds[0], cov_kl_bound=bounds[1])
    new = jax.jit(kind.fit)(old, samples)
    mean_kl, cov_kl = parts(new, old, samples)
    assert 0.8 * bounds[0] < mean_kl < 1.01 * bounds[0]
    assert cov_kl == pytest.approx(bounds[1], rel=0.01)
    assert kind.kl(new, old, samples.features).mean() == pytest.approx(mean_kl + cov_kl, rel=1e-3)
    better = samples.weights @ (
        kind.log_prob(new, *samples[:2]) - kind.log_prob(old, samples.features, samples.theta)
    )
    assert better > 0


def test_the_loss_of_entropy_is_within_its_bound(problem):
    old, samples = problem
    kind = network_policy(LOW, HIGH, steps=20, cov_kl_bound=5.0, entropy_loss_bound=0.01)
    new = kind.fit(old, samples)
    assert float(kind.entropy(old) - kind.entropy(new)) < 0.0101


def test_densities_and_samples_are_those_of_a_gaussian(problem, key):
    state, samples = problem
    x, theta = samples.features[:3], samples.theta[:3]
    cov = np.asarray(state.cov_chol @ state.cov_chol.T, float)
    means = np.asarray(KIND.mean(state, x), float)
    noise = np.asarray(theta, float) - means
    expected = -0.5 * np.einsum("ni,ij,nj->n", noise, np.linalg.inv(cov), noise)
    expected -= 0.5 * (np.linalg.slogdet(cov)[1] + 3 * np.log(2 * np.pi))
    np.testing.assert_allclose(KIND.log_prob(state, x, theta), expected, rtol=1e-4)
    np.testing.assert_allclose(KIND.noise(state, x, theta) @ state.cov_chol.T, noise, rtol=1e-3, atol=1e-4)
    draws = KIND.sample(key, state, jnp.tile(x[:1], (20_000, 1)))
    spread = np.sqrt(np.diag(cov))
    np.testing.assert_allclose((draws.mean(0) - means[0]) / spread, 0.0, atol=0.03)
    np.testing.assert_allclose(draws.std(0) / spread, 1.0, rtol=0.03)


def test_samples_without_weight_may_hold_anything(problem):
    old, samples = problem
    weights = samples.weights.at[::4].set(0.0)
    clean = samples._replace(weights=weights, is_valid=jnp.arange(80) % 4 > 0)
    spoilt = clean._replace(
        features=clean.features.at[::4].set(jnp.nan), theta=clean.theta.at[::4].set(jnp.inf)
    )
    expected = KIND.fit(old, clean)
    jax.tree.map(np.testing.assert_array_equal, KIND.fit(old, spoilt), expected)
    nothing = KIND.fit(old, samples._replace(weights=jnp.zeros(80)))
    jax.tree.map(np.testing.assert_array_equal, nothing, old)


def test_failed_rollouts_are_ignored(key):
    algorithm = cj.creps(KIND, archive_size=60)
    contexts = jax.random.uniform(key, (60, 2), minval=jnp.array(LOW), maxval=jnp.array(HIGH))
    state = algorithm.init(start_network(key, KIND.features, 2, hidden=8))
    theta = algorithm.ask(key, state, contexts)
    reward = np.array(-jnp.sum(theta**2, axis=1))
    reward[::5] = np.nan
    new, info = algorithm.tell(state, cj.Batch(contexts, theta, reward))
    spoilt = np.where(np.arange(60)[:, None] % 5 == 0, np.nan, np.asarray(theta))
    same, _ = algorithm.tell(state, cj.Batch(contexts, spoilt, reward))
    assert info.num_valid == 48 and info.is_updated
    jax.tree.map(np.testing.assert_array_equal, new.policy, same.policy)


def test_the_fit_does_not_depend_on_the_units_of_the_parameters(problem):
    old, samples = problem
    units = jnp.array([1e-3, 1.0, 1e4])
    new = KIND.fit(old, samples)
    scaled = old._replace(coef=old.coef * units[None], cov_chol=old.cov_chol * units[:, None])
    other = KIND.fit(scaled, samples._replace(theta=samples.theta * units[None]))
    spread = np.sqrt(np.diag(old.cov_chol @ old.cov_chol.T))
    for kind, factor in ((new, 1.0), (other, units[None])):
        means = KIND.mean(kind, samples.features) / factor / spread[None]
        np.testing.assert_allclose(
            means, KIND.mean(new, samples.features) / spread[None], rtol=0.01, atol=0.02
        )


def test_trials_are_single_searches_and_a_saved_state_resumes_exactly(key, tmp_path):
    task, algorithm = bent_task(), cj.creps(KIND, archive_size=80)
    start = start_network(key, KIND.features, 2, hidden=(8, 8))
    keys = jax.random.split(key, 2)
    settings = {"samples": 20}
    whole, log = cj.train(keys[1], task, algorithm, start, iterations=6, **settings)
    again, _ = cj.train(keys[1], task, algorithm, start, iterations=6, **settings)
    jax.tree.map(np.testing.assert_array_equal, whole, again)
    states, logs = cj.train_trials(keys, task, algorithm, start, iterations=6, **settings)
    # Rounding differs, and training enlarges the difference.
    np.testing.assert_allclose(logs.mean_reward[1], log.mean_reward, rtol=1e-3)
    grid = cj.context_grid(LOW, HIGH, 3)
    second = jax.tree.map(lambda leaf: leaf[1], states.policy)
    np.testing.assert_allclose(algorithm.mean(second, grid), algorithm.mean(whole, grid), atol=0.02)

    half, _ = cj.train(keys[1], task, algorithm, start, iterations=3, **settings)
    path, run = tmp_path / "state.npz", {"seed": 1}
    checkpoints.save_checkpoint(path, checkpoints.Checkpoint(half, {}), run=run)
    template = algorithm.init(start)
    half = checkpoints.load_checkpoint(path, template, run=run).state
    resumed, _ = cj.train(keys[1], task, algorithm, half, iterations=3, **settings)
    jax.tree.map(np.testing.assert_array_equal, resumed, whole)


def test_policies_of_equal_settings_are_equal_and_can_be_copied():
    make = partial(network_policy, LOW, HIGH)
    policy = make()
    for same in (make(), copy.deepcopy(policy), pickle.loads(pickle.dumps(policy))):
        assert same == policy and hash(same) == hash(policy)
    assert policy != make(steps=3) and policy != network_policy(LOW, (1.0, 5.0))


STATE = start_network(jax.random.key(0), KIND.features, 2, hidden=4)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"layers": ()}, r"policy\.layers must be a tuple of layers, got \(\)"),
        ({"layers": (3,)}, r"policy\.layers\[0\] must be of type Layer, got 3"),
        (
            {"layers": (Layer(jnp.ones((3, 4)), jnp.ones(4)),)},
            r"weight must have shape \(2, o\), got \(3, 4\)",
        ),
        ({"layers": (Layer(jnp.ones((2, 4)), jnp.ones(3)),)}, r"bias must have shape \(4,\), got \(3,\)"),
        ({"coef": jnp.ones((4, 2))}, r"policy\.coef must have shape \(5, d\), got \(4, 2\)"),
        ({"coef": jnp.full((5, 2), jnp.nan)}, r"policy\.coef must be finite, got nan"),
        ({"cov_chol": jnp.ones((3, 3))}, r"policy\.cov_chol must have shape \(2, 2\), got \(3, 3\)"),
        ({"cov_chol": jnp.ones((2, 2))}, r"policy\.cov_chol must be lower triangular, got 1\.0 above"),
        ({"cov_chol": jnp.diag(jnp.array([1.0, 0.0]))}, r"diagonal of policy\.cov_chol must be .*above 0"),
    ],
)
def test_a_state_that_does_not_fit_is_named(changes, match):
    with pytest.raises(ValueError, match=match):
        cj.creps(KIND, archive_size=40).init(STATE._replace(**changes))


def test_another_kind_of_state_is_named():
    with pytest.raises(ValueError, match="policy must be of type NetworkGaussian, got LinearGaussian"):
        cj.creps(KIND, archive_size=40).init(cj.start_policy(KIND.features, 2))


@pytest.mark.parametrize(
    ("hidden", "match"),
    [
        (0, "hidden must be a number of units from 1 to 10000, or one for each layer, got 0"),
        ((), r"or one for each layer, got \(\)"),
        ((8, 0), r"or one for each layer, got \(8, 0\)"),
        (10**6, "or one for each layer, got 1000000"),
    ],
)
def test_layers_without_units_are_refused(key, hidden, match):
    with pytest.raises(ValueError, match=match):
        start_network(key, KIND.features, 2, hidden=hidden)


def test_bounds_that_are_not_above_zero_are_refused():
    for name in ("learning_rate", "mean_kl_bound", "cov_kl_bound", "entropy_loss_bound"):
        with pytest.raises(ValueError, match=f"{name} must be finite and above 0, got 0.0"):
            network_policy(LOW, HIGH, **{name: 0.0})
    with pytest.raises(ValueError, match="steps must be at least 1, got 0"):
        network_policy(LOW, HIGH, steps=0)


def test_double_precision_is_kept(problem):
    with jax.enable_x64(True):
        old, samples = jax.tree.map(
            lambda leaf: jnp.asarray(np.asarray(leaf, float)) if leaf.dtype == jnp.float32 else leaf, problem
        )
        new = KIND.fit(old, samples)
        assert {leaf.dtype for leaf in jax.tree.leaves(new)} == {np.dtype(float)}
    assert isinstance(new, NetworkGaussian)
