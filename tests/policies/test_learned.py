import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import creps_jax as cj
from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.policies import features as feature_maps
from creps_jax.policies.features import (
    FeatureMap,
    kernel_features,
    linear_features,
    polynomial_features,
    quadratic_features,
    rbf_features,
    scaled_polynomial_features,
)
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.policies.learned import Learned, load, save
from creps_jax.policies.network import network_policy, start_network
from creps_jax.policies.space import Space

SPEED = Space(("speed",), (0.1,), (0.6,), ("m/s",))
WALK = Space(("a", "b"), (0.0, -1.0), (2.0, 1.0), ("m", ""), "sigmoid")
RBF = rbf_features(0.1, 0.6, 4)


def policy_of(features: FeatureMap, num_params: int = 2) -> LinearGaussian:
    coef = np.random.default_rng(0).normal(size=(features.size, num_params))
    return LinearGaussian(jnp.asarray(coef, jnp.float32), jnp.eye(num_params))


def make_policy(features: FeatureMap = RBF, contexts: Space = SPEED, parameters: Space = WALK) -> Learned:
    task = {"name": "walk", "balance": {"heading_gain": 0.5}}
    return Learned(policy_of(features, parameters.size), features, contexts, parameters, task)


def cubic(context):
    return jnp.concatenate([jnp.ones(1), context**3])


CUBIC = FeatureMap(cubic, 2, 1, name="cubic")
FEATURES = {
    "rbf": (RBF, SPEED),
    "wide rbf": (rbf_features(-1.0, 3.0, 3, bandwidth=0.5), SPEED),
    "linear": (linear_features(1), SPEED),
    "quadratic": (quadratic_features(1), SPEED),
    "polynomial": (polynomial_features(2, 3), Space(("speed", "slope"), (0.1, -5.0), (0.6, 5.0))),
    "rbf per axis": (rbf_features([0, 0], [1, 1], (2, 3)), Space(("x", "y"), (0.0, 0.0), (1.0, 1.0))),
    "scaled polynomial": (scaled_polynomial_features(0.0, 1.0, 3), SPEED),
    "kernel": (kernel_features(0.1, 0.6, 5), SPEED),
    "kernel per axis": (
        kernel_features([0, 0], [1, 1], 6, bandwidth=(0.3, 2.0)),
        Space(("x", "y"), (0.0, 0.0), (1.0, 1.0)),
    ),
    "own": (CUBIC, SPEED),
}


def assert_same(one: Learned, other: Learned) -> None:
    jax.tree.map(np.testing.assert_array_equal, one.policy, other.policy)
    for field in ("features", "contexts", "parameters", "task"):
        assert getattr(one, field) == getattr(other, field)


@pytest.mark.parametrize("name", FEATURES)
def test_a_policy_comes_back_as_it_was_saved(tmp_path, name):
    features, contexts = FEATURES[name]
    policy = make_policy(features, contexts)
    policy.save(tmp_path / "policy.npz")
    loaded = cj.load(tmp_path / "policy.npz", features=CUBIC if name == "own" else None)
    assert_same(loaded, policy)
    grid = cj.context_grid(contexts.low, contexts.high, 5)
    np.testing.assert_array_equal(loaded.features(grid), policy.features(grid))


KIND = network_policy((0.1, -5.0), (0.6, 5.0), steps=5)
PLACE = Space(("speed", "slope"), (0.1, -5.0), (0.6, 5.0), ("m/s", "deg"))


def make_network(hidden: int | tuple[int, ...] = (4, 4), parameters: Space = WALK) -> Learned:
    state = start_network(jax.random.key(0), KIND.features, 2, hidden=hidden)
    coef = jax.random.normal(jax.random.key(1), state.coef.shape)
    return Learned(state._replace(coef=coef), KIND.features, PLACE, parameters, {"name": "walk"})


@pytest.mark.parametrize("hidden", [1, 32, (4, 4), (5, 3, 2)])
def test_a_network_comes_back_as_it_was_saved(tmp_path, hidden):
    learned = make_network(hidden)
    learned.save(tmp_path / "policy.npz")
    loaded = cj.load(tmp_path / "policy.npz")
    assert_same(loaded, learned)
    assert loaded(0.3, 1.0) == learned(speed=0.3, slope=1.0)
    assert str(files.load_arrays(tmp_path / "policy.npz")["version"]) == "4"


def test_parameters_of_a_network_are_its_squashed_mean():
    learned = make_network()
    contexts = np.float32([[0.1, -5.0], [0.6, 5.0], [0.35, 0.0], [0.2, 3.0]])
    outputs = (contexts - np.float32([0.35, 0.0])) / np.float32([0.25, 5.0])
    for weight, bias in learned.policy.layers:
        outputs = np.tanh(outputs @ np.asarray(weight) + np.asarray(bias))
    means = np.column_stack([np.ones(4), outputs]) @ np.asarray(learned.policy.coef)
    expected = np.array(WALK.low) + np.subtract(WALK.high, WALK.low) / (1 + np.exp(-means))
    np.testing.assert_allclose(jax.jit(learned.thetas)(contexts), expected, rtol=1e-4, atol=1e-5)
    for context, mean, theta in zip(contexts.tolist(), means, expected, strict=True):
        np.testing.assert_allclose(learned.mean(*context), mean, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(learned.theta(*context), theta, rtol=1e-4, atol=1e-5)
        assert list(learned(context).values()) == learned.theta(context).tolist()
    assert learned.in_range(0.3, 5.0) and not learned.in_range(0.3, 5.1)
    with pytest.raises(ValueError, match=r"slope must be within its range, -5 to 5 deg, got 6"):
        learned(0.3, 6.0)


def test_a_search_with_a_network_gives_a_policy_that_can_be_saved(tmp_path, key):
    kind = network_policy((-1.5, -1.5), (-0.5, -0.5), steps=5)
    task, algorithm = cj.via_point_reaching(), cj.creps(kind, archive_size=60)
    start = start_network(key, kind.features, task.theta_dim, hidden=4)
    state, _ = cj.train(key, task, algorithm, start, iterations=3, samples=20)
    learned = cj.learned(task, algorithm, state, made_for={"name": "reaching"})
    learned.save(tmp_path / "reach.npz")
    loaded = cj.load(tmp_path / "reach.npz")
    assert_same(loaded, learned)
    contexts = cj.context_grid((-1.5, -1.5), (-0.5, -0.5), 3)
    expected = task.parameters.inside(algorithm.mean(state, contexts))
    np.testing.assert_allclose(loaded.thetas(contexts), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"num_layers": None}, "incomplete policy file: it has no 'num_layers'"),
        ({"num_layers": np.array(0)}, "num_layers must be a whole number of at least 1, got 0"),
        ({"num_layers": np.array(1.0)}, "num_layers must be a whole number of at least 1, got 1.0"),
        ({"num_layers": np.array([2])}, r"num_layers must be a whole number of at least 1, got \[2\]"),
        ({"num_layers": np.array(1)}, "the arrays of layers must be weight_0, bias_0, got bias_1"),
        ({"num_layers": np.array(2**40)}, "incomplete policy file: it has no 'weight_2'"),
        ({"weight_2": np.ones((4, 4))}, "the arrays of layers must be .*, bias_1, got weight_2"),
        ({"bias_x": np.ones(4)}, "the arrays of layers must be .*, bias_1, got bias_x"),
        ({"version": 3}, "the arrays of layers must be none, got bias_0"),
        ({"weight_1": None}, "incomplete policy file: it has no 'weight_1'"),
        ({"weight_0": np.ones((3, 4))}, r"layers\[0\]\.weight must have shape \(2, o\), got \(3, 4\)"),
        ({"weight_1": np.ones((4, 0))}, r"layers\[1\]\.weight must have shape \(4, o\), got \(4, 0\)"),
        ({"bias_1": np.ones(3)}, r"layers\[1\]\.bias must have shape \(4,\), got \(3,\)"),
        ({"bias_0": np.array(["a"] * 4)}, "bias_0 must be"),
        ({"weight_0": np.full((2, 4), np.nan)}, "weight must be finite, got nan"),
        ({"weight_0": np.full((2, 4), 1e300)}, "weight must be finite, got inf"),
        ({"coef": np.ones((4, 2))}, r"policy\.coef must have shape \(5, d\), got \(4, 2\)"),
        ({"cov_chol": -np.eye(2)}, "the diagonal of policy.cov_chol must be"),
        (
            {"features": json.dumps({"kind": "linear", "dim": 2})},
            "features of a network must be those of its network_policy",
        ),
    ],
)
def test_broken_arrays_of_a_network_are_named(tmp_path, changes, match):
    path = tmp_path / "policy.npz"
    make_network().save(path)
    arrays = {**files.load_arrays(path), **changes}
    files.save_arrays(path, {name: values for name, values in arrays.items() if values is not None})
    with pytest.raises(UserError, match=rf"policy\.npz.*{match}") as caught:
        load(path)
    assert "\n" not in str(caught.value)


def test_fields_that_do_not_fit_a_network_are_refused():
    with pytest.raises(ValueError, match=r"must have a column of coef for each of c, got coef \(5, 2\)"):
        dataclasses.replace(make_network(), parameters=Space(("c",), (0.0,), (1.0,)))
    with pytest.raises(ValueError, match="features of a network must be those of its network_policy"):
        dataclasses.replace(make_network(), features=rbf_features((0.1, -5.0), (0.6, 5.0), 3))


def test_features_of_a_user_need_a_name_and_come_along(tmp_path):
    path = tmp_path / "policy.npz"
    with pytest.raises(ValueError, match=r"must have a name, FeatureMap\(\.\.\., name='mine'\)"):
        make_policy(FeatureMap(cubic, 2, 1)).save(path)
    make_policy(CUBIC).save(path)
    for wrong in (None, linear_features(1), FeatureMap(cubic, 2, 1, name="other")):
        with pytest.raises(
            ValueError, match="must be the FeatureMap named 'cubic', of 2 features of 1 context"
        ):
            load(path, features=wrong)


@pytest.mark.parametrize("context", [0.1, 0.37, 0.6, float(np.float32(0.6)), np.float32(0.1)])
def test_parameters_are_the_squashed_mean_by_name(context):
    policy = make_policy()
    centres, width = np.linspace(0.1, 0.6, 4), 0.5 / 4
    weights = np.exp(-((context - centres) ** 2) / (2 * width**2))
    mean = weights / weights.sum() @ np.asarray(policy.policy.coef)
    low, high = np.array(WALK.low), np.array(WALK.high)
    expected = low + (high - low) / (1 + np.exp(-mean))
    np.testing.assert_allclose(policy.theta(context), expected, rtol=1e-5)
    np.testing.assert_allclose(jax.jit(policy.thetas)(jnp.full((2, 1), context))[1], expected, rtol=1e-5)
    named = policy(context)
    assert list(named) == ["a", "b"] and all(type(value) is float for value in named.values())
    np.testing.assert_allclose(list(named.values()), expected, rtol=1e-5)


def test_a_context_is_given_by_numbers_a_sequence_or_names():
    contexts = Space(("x", "y"), (0.0, 0.0), (1.0, 1.0))
    policy = make_policy(linear_features(2), contexts)
    expected = policy(0.2, 0.7)
    for given in ([0.2, 0.7], (0.2, 0.7), np.array([0.2, 0.7])):
        assert policy(given) == expected and policy.in_range(given)
    assert policy(y=0.7, x=0.2) == expected
    assert policy.in_range(y=0.7, x=0.2) and not policy.in_range(y=1.7, x=0.2)
    for use in (policy.theta, policy.mean):
        np.testing.assert_array_equal(use(y=0.7, x=0.2), use(0.2, 0.7))
    for arguments, named in (((0.2,), {"y": 0.7}), ((), {"x": 0.2}), ((), {"x": 0.2, "y": 0.7, "z": 1.0})):
        for use in (policy, policy.theta, policy.mean, policy.in_range):
            with pytest.raises(ValueError, match="values must be a number for each of x, y, got"):
                use(*arguments, **named)


def test_bounds_are_held_unless_asked_otherwise():
    far = LinearGaussian(jnp.full((2, 1), 5.0), jnp.eye(1))
    bounded = Learned(far, linear_features(1), SPEED, Space(("b",), (-1.0,), (1.0,)))
    assert bounded(0.5) == {"b": 1.0}
    free = dataclasses.replace(bounded, parameters=dataclasses.replace(bounded.parameters, constraint="none"))
    assert free(0.5) == {"b": 7.5}


def test_parameters_of_other_constraints():
    policy = LinearGaussian(jnp.array([[1.0, -3.0], [10.0, 0.0]]), jnp.eye(2))
    free = Learned(policy, linear_features(1), SPEED, dataclasses.replace(WALK, constraint="none"))
    np.testing.assert_allclose(free.theta(0.5), [6.0, -3.0], rtol=1e-6)
    clipped = dataclasses.replace(free, parameters=dataclasses.replace(WALK, constraint="clip"))
    np.testing.assert_allclose(clipped.theta(0.5), [2.0, -1.0], rtol=1e-6)


@pytest.mark.parametrize("context", [0.09, 0.7, -1.0, float("nan"), float("inf")])
def test_a_context_outside_the_learned_range_is_refused_and_can_be_asked_for(context):
    with pytest.raises(ValueError, match=r"speed must be within its range, 0\.1 to 0\.6 m/s, got"):
        make_policy()(context)
    assert not make_policy().in_range(context)
    assert make_policy().in_range(0.6)


@pytest.mark.parametrize("context", [("fast",), (None,), ([0.1, 0.2],), (), (0.1, 0.2)])
def test_a_context_that_is_no_number_is_refused(context):
    for use in (make_policy(), make_policy().in_range):
        with pytest.raises(ValueError, match="values must be a number for each of speed, got"):
            use(*context)


def test_several_context_variables_each_have_a_range():
    contexts = Space(("speed", "slope"), (0.1, -5.0), (0.6, 5.0), ("m/s", "deg"))
    coef = jnp.array([[1.0, 0.0], [2.0, 0.0], [0.1, 1.0]])
    parameters = dataclasses.replace(WALK, constraint="none")
    policy = Learned(LinearGaussian(coef, jnp.eye(2)), linear_features(2), contexts, parameters)
    np.testing.assert_allclose(policy.theta(0.5, -3.0), [1.7, -3.0], rtol=1e-6)
    with pytest.raises(ValueError, match=r"slope must be within its range, -5 to 5 deg, got 6"):
        policy.theta(0.5, 6.0)
    with pytest.raises(ValueError, match=r"a number for each of speed, slope, got \[0\.5\]"):
        policy.theta(0.5)


def damaged(arrays: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Return policy files that no policy can be read from, by what is wrong."""
    changes = {
        "not finite": {"coef": np.full_like(arrays["coef"], np.nan)},
        "infinite": {"cov_chol": np.full_like(arrays["cov_chol"], np.inf)},
        "too few features": {"coef": arrays["coef"][:3]},
        "covariance": {"cov_chol": np.zeros((3, 3))},
        "too few units": {"param_units": np.array(["m"])},
        "constraint": {"constraint": "hope"},
        "kind": {"features": json.dumps({"kind": "cubic"})},
        "no json": {"features": "{"},
        "no object": {"features": "[1]"},
        "null": {"features": "null"},
        "spread of zero": {"cov_chol": np.zeros_like(arrays["cov_chol"])},
        "range": {"context_range": np.array([[0.1], [np.nan]])},
        "reversed": {"param_bounds": arrays["param_bounds"][::-1]},
        "no context": {"context_names": np.array([], "U1")},
        "equal names": {"param_names": np.array(["a", "a"])},
    }
    return {name: {**arrays, **change} for name, change in changes.items()}


def test_what_is_no_policy_is_not_loaded(tmp_path):
    path = tmp_path / "policy.npz"
    make_policy().save(path)
    for name, arrays in damaged(files.load_arrays(path)).items():
        files.save_arrays(path, arrays)
        with pytest.raises(UserError, match=r"policy\.npz") as caught:
            load(path)
        assert "\n" not in str(caught.value), name


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"policy": LinearGaussian(jnp.zeros((3, 2)), jnp.eye(2))}, r"coef \(4, d\)"),
        ({"policy": LinearGaussian(jnp.full((4, 2), jnp.nan), jnp.eye(2))}, "policy.coef must be finite"),
        ({"contexts": Space(("x", "y"), (0, 0), (1, 1))}, "features must be of the contexts x, y, got 1"),
    ],
)
def test_fields_that_do_not_fit_each_other_are_refused(changes, match):
    with pytest.raises(ValueError, match=match):
        dataclasses.replace(make_policy(), **changes)


def test_a_task_is_kept_as_json_has_it(tmp_path):
    policy = dataclasses.replace(make_policy(), task={"name": "walk", "tuple": (1, 2), 3: None})
    assert policy.task == {"name": "walk", "tuple": [1, 2], "3": None}
    policy.save(tmp_path / "p.npz")
    assert_same(load(tmp_path / "p.npz"), policy)
    with pytest.raises(ValueError, match="task must be plain values, as JSON has them"):
        dataclasses.replace(policy, task={"gain": np.float32(1.0)})


def test_features_that_do_not_fit_their_numbers_are_named():
    wrong = FeatureMap(lambda context: jnp.ones(3), 2, 1, name="wrong")
    with pytest.raises(ValueError, match=r"features must have shape \(2,\), got \(3,\)"):
        make_policy(wrong)(0.3)
    with pytest.raises(ValueError, match="features must be numbers, got nan"):
        make_policy(FeatureMap(lambda context: jnp.full(2, jnp.nan), 2, 1, name="nan"))(0.3)
    with pytest.raises(ValueError, match=r"contexts must have 1 variables along the last axis, got \(4, 3\)"):
        CUBIC(jnp.ones((4, 3)))


def test_library_features_with_other_fields_are_ones_own(tmp_path):
    scaled = RBF._replace(scale=(2.0,) * 4)
    with pytest.raises(ValueError, match="must have a name"):
        make_policy(scaled).save(tmp_path / "p.npz")
    make_policy(scaled._replace(name="scaled")).save(tmp_path / "p.npz")
    assert load(tmp_path / "p.npz", features=scaled._replace(name="scaled")).features.scale == (2.0,) * 4


def test_a_policy_file_is_named_as_what_it_is(tmp_path):
    save(str(tmp_path / "policy.npz"), make_policy())
    load(str(tmp_path / "policy.npz"))
    for path in (tmp_path / "policy.onnx", tmp_path / "policy"):
        with pytest.raises(UserError, match=r"must be named \.npz, got .*policy"):
            make_policy().save(path)


def test_foreign_files_and_other_versions_are_refused(tmp_path):
    path = tmp_path / "policy.npz"
    files.save_arrays(path, {"coef": np.zeros((4, 2))})
    with pytest.raises(UserError, match="must be a policy file of format 'creps_jax policy', got no format"):
        load(path)
    save(path, make_policy())
    whole = files.load_arrays(path)
    files.save_arrays(path, {**whole, "version": 1})
    with pytest.raises(UserError, match="must be a policy file of version 2, 3 or 4, got 1"):
        load(path)
    for name in whole.keys() - {"format", "version"}:
        files.save_arrays(path, {key: values for key, values in whole.items() if key != name})
        with pytest.raises(UserError, match="incomplete"):
            load(path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(UserError, match="cut short"):
        load(path)


@pytest.mark.parametrize("kind", ["rbf", "linear"])
def test_files_of_version_2_are_read(tmp_path, kind):
    path = tmp_path / "policy.npz"
    policy = make_policy(RBF if kind == "rbf" else linear_features(1))
    policy.save(path)
    settings = {"kind": kind, "num_centers": 4, "bandwidth": None}
    before = {"version": 2, "features": json.dumps(settings), "constraint": "penalty"}
    files.save_arrays(path, {**files.load_arrays(path), **before})
    clipped = dataclasses.replace(policy, parameters=dataclasses.replace(WALK, constraint="clip"))
    assert_same(load(path), clipped)


@pytest.mark.parametrize("robot", ["nao", "nao_h25"])
def test_the_policies_that_come_along_can_be_loaded(robot):
    for path in files.policies_folder(robot).glob("*.npz"):
        learned = cj.load(path)
        named = learned(*learned.contexts.low)
        steers = learned.contexts.names[0] == "vx"
        assert (-0.2 if steers else 0.0) <= named["step_length"] <= 0.2
        kind = feature_maps.describe(learned.features)["kind"]
        assert kind == ("polynomial" if steers else "rbf")
    assert isinstance(path, Path)
