"""Hold every feature map, context sampler and task to what the library expects of one."""

import inspect
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import creps_jax
from creps_jax import tasks
from creps_jax.contexts import gaussian_contexts, uniform_contexts
from creps_jax.policies.features import linear_features, quadratic_features, rbf_features
from creps_jax.tasks import Outcome, average_repeats, penalised, sigmoid_constrained, sinus
from creps_jax.tasks.functions import sphere

FEATURE_MAPS = {
    "linear": lambda: linear_features(2),
    "quadratic": lambda: quadratic_features(3),
    "rbf": lambda: rbf_features(0.1, 0.6, 5),
    "rbf of two": lambda: rbf_features((0.0, -1.0), (1.0, 1.0), 3, bandwidth=0.2),
}
SAMPLERS = {
    "gaussian": lambda: gaussian_contexts(0.1, 0.6),
    "clipped gaussian": lambda: gaussian_contexts((0.1, 0.0), (0.6, 1.0), std=0.1, clip=True),
    "uniform": lambda: uniform_contexts((0.1, 0.0), (0.6, 1.0)),
}
TASKS = {
    "sinus": sinus,
    "sinus averaged": lambda: average_repeats(sinus(), 3),
    "sinus squashed": lambda: sigmoid_constrained(sinus(), -1.0, 1.0),
    "sinus penalised": lambda: penalised(sinus(), -1.0, 1.0, 10.0),
    "via_point_reaching": lambda: tasks.via_point_reaching(),
    "hole_reaching": lambda: tasks.hole_reaching(),
    "contextual_function": lambda: tasks.contextual_function(sphere, jnp.ones((4, 2))),
    "nao_walk": lambda: tasks.nao_walk(),
}
# A rollout of these takes long to compile: only its shapes and types are looked at.
SLOW_TASKS = {"nao_walk"}


@pytest.fixture(params=FEATURE_MAPS)
def feature_map(request):
    return FEATURE_MAPS[request.param]()


@pytest.fixture(params=SAMPLERS)
def sampler(request):
    return SAMPLERS[request.param]()


@pytest.fixture(params=TASKS)
def task(request, relaxed_promotion):
    return TASKS[request.param]()


def shape_and_type(value):
    return value.shape, value.dtype


def test_features_are_a_finite_vector_of_their_size(key, feature_map):
    contexts = jax.random.normal(key, (50, feature_map.context_dim)) * jnp.asarray([[1.0], [100.0]] * 25)
    features = jax.jit(jax.vmap(feature_map.apply))(contexts)
    assert shape_and_type(features) == ((50, feature_map.size), jnp.float32)
    assert jnp.isfinite(features).all()
    one_by_one = np.stack([feature_map.apply(context) for context in contexts[:5]])
    np.testing.assert_allclose(features[:5], one_by_one, rtol=1e-5, atol=1e-6)


def test_features_tell_contexts_apart(key, feature_map):
    contexts = jax.random.uniform(key, (30, feature_map.context_dim))
    features = np.asarray(jax.vmap(feature_map.apply)(contexts))
    distances = np.abs(features[:, None] - features[None]).max(-1)
    assert distances[~np.eye(30, dtype=bool)].min() > 0


def test_features_have_finite_gradients(feature_map):
    gradient = jax.jacobian(feature_map.apply)(jnp.full(feature_map.context_dim, 0.3))
    assert gradient.shape == (feature_map.size, feature_map.context_dim)
    assert jnp.isfinite(gradient).all()


def test_features_refuse_contexts_of_another_size(feature_map):
    with pytest.raises(ValueError, match=f"{feature_map.context_dim + 1}"):
        feature_map.apply(jnp.zeros(feature_map.context_dim + 1))


def check_sampler(sample_context, key):
    context = sample_context(key)
    assert context.ndim == 1 and context.dtype == jnp.float32
    keys = jax.random.split(key, 20)
    contexts = jax.jit(jax.vmap(sample_context))(keys)
    np.testing.assert_allclose(contexts, [sample_context(k) for k in keys], rtol=1e-6)
    assert jnp.isfinite(contexts).all()
    assert len(np.unique(contexts[:, 0])) > 10  # each key draws a context of its own
    np.testing.assert_array_equal(sample_context(key), context)  # the same key the same one
    # Keys of the old style work as well.
    assert shape_and_type(sample_context(jax.random.PRNGKey(0))) == shape_and_type(context)
    return context


def test_samplers_draw_finite_vectors(key, sampler):
    check_sampler(sampler, key)


def test_tasks_sample_contexts_of_their_size(key, task):
    assert check_sampler(task.sample_context, key).shape == (task.context_dim,)


def test_tasks_give_an_outcome_with_the_two_fields(key, task):
    context, theta = task.sample_context(key), jnp.zeros(task.theta_dim)
    outcome = jax.eval_shape(task.rollout, key, context, theta)
    assert isinstance(outcome, Outcome) and isinstance(outcome, tuple)
    assert shape_and_type(outcome.reward) == ((), jnp.float32)
    assert len(outcome.violation.shape) == 1 and outcome.violation.dtype == jnp.float32
    assert np.isfinite(task.worst_reward)
    for field in jax.tree.leaves(outcome):
        assert field.dtype in (jnp.float32, jnp.int32, jnp.bool_)


def test_rollouts_are_finite_and_repeatable(request, key, task):
    if request.node.callspec.params["task"] in SLOW_TASKS:
        pytest.skip("held by the task's own tests")
    contexts = jax.vmap(task.sample_context)(jax.random.split(key, 20))
    thetas = 2 * jax.random.normal(key, (20, task.theta_dim))
    rollouts = jax.jit(jax.vmap(task.rollout))
    batch = jax.random.split(key, 20), contexts, thetas
    outcome = rollouts(*batch)
    assert all(jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(outcome))
    assert (outcome.reward >= task.worst_reward).all() and (outcome.violation >= 0).all()
    jax.tree.map(np.testing.assert_array_equal, rollouts(*batch), outcome)


IMPORT_ORDERS = {
    "package": "import creps_jax; assert 'mujoco' not in sys.modules; from creps_jax.tasks import nao_walk",
    "module": "from creps_jax.tasks.walking import nao_walk as f; from creps_jax.tasks import nao_walk",
    "attribute": "from creps_jax import tasks; nao_walk = tasks.nao_walk; import creps_jax.tasks.walking",
}


@pytest.mark.parametrize("order", IMPORT_ORDERS)
def test_mujoco_is_imported_only_for_the_walking_task_which_stays_a_function(order):
    check = "assert tasks.nao_walk is nao_walk and callable(nao_walk) and 'mujoco' in sys.modules"
    code = f"import sys; {IMPORT_ORDERS[order]}; from creps_jax import tasks; {check}"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr


def test_the_library_has_at_most_sixty_names_besides_its_modules():
    names = [name for name in creps_jax.__all__ if not inspect.ismodule(getattr(creps_jax, name))]
    assert len(names) == len(set(names)) <= 60
