"""Time one update and its parts, and how they grow: `python -m pytest experiments/benchmarks`.

Compiling is apart from running. One device does one thing at a time here; absolute times drift with what
else the machine does.
"""

import jax
import jax.numpy as jnp
import pytest

from creps_jax.policies.features import rbf_features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.search.archive import Batch
from creps_jax.search.creps import creps
from creps_jax.search.dual import sample_weights, solve_dual
from creps_jax.search.fit import WeightedSamples, bounded_ml, weighted_ml

# The size of the hole-reaching task.
SAMPLES, DIM, CENTERS = 2000, 18, 6
M_STEPS = {"weighted_ml": weighted_ml, "bounded_ml": bounded_ml()}
SIZES = [
    *[(samples, DIM, CENTERS, 1) for samples in (200, SAMPLES, 20_000)],
    *[(SAMPLES, dim, CENTERS, 1) for dim in (5, 50)],
    *[(SAMPLES, DIM, centers, 1) for centers in (2, 20)],
    *[(SAMPLES, DIM, CENTERS, trials) for trials in (4, 20)],
]


def make_problem(samples=SAMPLES, dim=DIM, centers=CENTERS):
    """Return features, an old policy and a batch of its samples with quadratic rewards."""
    features = rbf_features(1.4, 2.0, centers)
    context_key, theta_key = jax.random.split(jax.random.key(0))
    contexts = jax.random.uniform(context_key, (samples, 1), minval=1.4, maxval=2.0)
    theta = jax.random.normal(theta_key, (samples, dim))
    reward = -jnp.sum((theta - 0.5 * contexts) ** 2, axis=1)
    policy = LinearGaussian(jnp.zeros((centers, dim)), jnp.eye(dim))
    return features, policy, Batch(contexts, theta, reward)


def time_compiled(benchmark, function, *arguments):
    """Compile, then time what was compiled."""
    compiled = jax.jit(function).lower(*arguments).compile()
    benchmark(lambda: jax.block_until_ready(compiled(*arguments)))
    analysis = compiled.memory_analysis()
    if analysis is not None:
        benchmark.extra_info["temporary memory, MB"] = round(analysis.temp_size_in_bytes / 1e6, 3)


def test_dual(benchmark):
    """The dual alone."""
    features, _, batch = make_problem()
    baseline = jax.vmap(features.apply)(batch.context)
    time_compiled(benchmark, lambda r, f: solve_dual(r, f, kl_bound=0.5), batch.reward, baseline)


@pytest.mark.parametrize("name", M_STEPS)
def test_m_step(benchmark, name):
    """The fit of the policy alone."""
    features, policy, batch = make_problem()
    rows = jax.vmap(features.apply)(batch.context)
    weights = sample_weights(solve_dual(batch.reward, rows, kl_bound=0.5), batch.reward, rows)
    samples = WeightedSamples(rows, batch.theta, weights, jnp.ones(SAMPLES, bool))
    time_compiled(benchmark, lambda p, s: M_STEPS[name](p, s, ridge=1e-4), policy, samples)


@pytest.mark.parametrize("name", M_STEPS)
def test_update(benchmark, name):
    """The whole of `tell`."""
    features, policy, batch = make_problem()
    algorithm = creps(features, features, archive_size=SAMPLES, m_step=M_STEPS[name])
    time_compiled(benchmark, algorithm.tell, algorithm.init(policy), batch)


@pytest.mark.parametrize(("samples", "dim", "centers", "trials"), SIZES)
def test_growth(benchmark, samples, dim, centers, trials):
    """How an update grows with samples, parameters, RBFs and trials."""
    features, policy, batch = make_problem(samples, dim, centers)
    algorithm = creps(features, features, archive_size=samples)
    stack = lambda tree: jax.tree.map(lambda x: jnp.stack([x] * trials), tree)  # noqa: E731
    time_compiled(benchmark, jax.vmap(algorithm.tell), stack(algorithm.init(policy)), stack(batch))


@pytest.mark.parametrize("name", M_STEPS)
def test_compilation(benchmark, name):
    """Compiling an update, without the cache of compiled programs."""
    features, policy, batch = make_problem()
    algorithm = creps(features, features, archive_size=SAMPLES, m_step=M_STEPS[name])
    state = algorithm.init(policy)
    benchmark.pedantic(
        lambda: jax.jit(algorithm.tell).lower(state, batch).compile(), setup=jax.clear_caches, rounds=3
    )
