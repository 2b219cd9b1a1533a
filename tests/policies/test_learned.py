import dataclasses

import numpy as np
import pytest

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.policies.learned import Features, SavedPolicy, load_policy, save_policy


def make_policy(**changes) -> SavedPolicy:
    rng = np.random.default_rng(0)
    policy = SavedPolicy(
        coef=rng.normal(size=(4, 2)).astype(np.float32),
        cov_chol=np.eye(2, dtype=np.float32),
        features=Features("rbf", 4),
        context_names=("speed",),
        context_units=("m/s",),
        context_low=(0.1,),
        context_high=(0.6,),
        param_names=("a", "b"),
        param_units=("m", ""),
        param_low=(0.0, -1.0),
        param_high=(2.0, 1.0),
        constraint="sigmoid",
        task={"name": "walk", "balance": {"heading_gain": 0.5}},
    )
    return dataclasses.replace(policy, **changes)


def rbf_mean(policy: SavedPolicy, context: float) -> np.ndarray:
    centres = np.linspace(policy.context_low[0], policy.context_high[0], policy.features.num_centers)
    width = (policy.context_high[0] - policy.context_low[0]) / policy.features.num_centers
    weights = np.exp(-((context - centres) ** 2) / (2 * width**2))
    return weights / weights.sum() @ policy.coef


def test_a_policy_comes_back_as_it_was_saved(tmp_path):
    policy = make_policy()
    save_policy(tmp_path / "policy.npz", policy)
    loaded = load_policy(tmp_path / "policy.npz")
    for field in dataclasses.fields(SavedPolicy):
        np.testing.assert_array_equal(getattr(loaded, field.name), getattr(policy, field.name))


@pytest.mark.parametrize("context", [0.1, 0.37, 0.6, float(np.float32(0.6)), np.float32(0.1)])
def test_theta_is_the_squashed_mean(context):
    policy = make_policy()
    low, high = np.array(policy.param_low), np.array(policy.param_high)
    expected = low + (high - low) / (1 + np.exp(-rbf_mean(policy, context)))
    np.testing.assert_allclose(policy.theta(context), expected, rtol=1e-5)


def test_theta_of_other_constraints_and_features():
    linear = make_policy(
        coef=np.array([[1.0, -3.0], [10.0, 0.0]]), features=Features("linear"), constraint="none"
    )
    np.testing.assert_allclose(linear.theta(0.5), [6.0, -3.0], rtol=1e-6)
    clipped = dataclasses.replace(linear, constraint="penalty")
    np.testing.assert_allclose(clipped.theta(0.5), [2.0, -1.0], rtol=1e-6)


@pytest.mark.parametrize("context", [0.09, 0.7, -1.0, float("nan"), float("inf")])
def test_a_context_outside_the_learned_range_is_refused(context):
    with pytest.raises(ValueError, match=r"learned range, 0\.1 to 0\.6 m/s, got"):
        make_policy().theta(context)


@pytest.mark.parametrize("context", ["fast", None, [0.1, 0.2]])
def test_a_context_that_is_no_number_is_refused(context):
    with pytest.raises(UserError, match="expected a number for each of speed, got"):
        make_policy().theta(context)


def test_several_context_variables_each_have_a_range():
    policy = make_policy(
        context_names=("speed", "slope"),
        context_units=("m/s", "deg"),
        context_low=(0.1, -5.0),
        context_high=(0.6, 5.0),
        features=Features("linear"),
        coef=np.array([[1.0, 0.0], [2.0, 0.0], [0.1, 1.0]]),
        constraint="none",
    )
    np.testing.assert_allclose(policy.theta(0.5, -3.0), [1.7, -3.0], rtol=1e-6)
    with pytest.raises(UserError, match=r"slope must be within the learned range, -5 to 5 deg, got 6"):
        policy.theta(0.5, 6.0)
    with pytest.raises(UserError, match=r"a number for each of speed, slope, got \(0\.5,\)"):
        policy.theta(0.5)


@pytest.mark.parametrize(
    "changes",
    [
        {"coef": np.full((4, 2), np.nan)},
        {"cov_chol": np.full((2, 2), np.inf)},
        {"coef": np.zeros((3, 2))},
        {"cov_chol": np.zeros((3, 3))},
        {"param_units": ("m",)},
        {"constraint": "hope"},
        {"features": Features("cubic")},
        {"context_high": (float("nan"),)},
        {"context_units": ()},
    ],
)
def test_what_is_no_policy_is_neither_saved_nor_loaded(tmp_path, changes, monkeypatch):
    path = tmp_path / "policy.npz"
    with pytest.raises(UserError):
        save_policy(path, make_policy(**changes))
    assert not path.exists()
    monkeypatch.setattr("creps_jax.policies.learned._check", lambda *_: None)
    save_policy(path, make_policy(**changes))
    monkeypatch.undo()
    with pytest.raises(UserError) as caught:
        load_policy(path)
    assert "\n" not in str(caught.value)


def test_a_policy_file_is_named_as_what_it_is(tmp_path):
    save_policy(str(tmp_path / "policy.npz"), make_policy())
    load_policy(str(tmp_path / "policy.npz"))
    for path in (tmp_path / "policy.onnx", tmp_path / "policy"):
        with pytest.raises(UserError, match=r"must be named \.npz, got .*policy"):
            save_policy(path, make_policy())
    with pytest.raises(UserError, match=r"must be a SavedPolicy, got \{\}"):
        save_policy(tmp_path / "policy.npz", {})
    for use in (load_policy, lambda path: save_policy(path, make_policy())):
        with pytest.raises(UserError, match="path must be that of a file, got 5"):
            use(5)


def test_foreign_files_and_other_versions_are_refused(tmp_path):
    path = tmp_path / "policy.npz"
    files.save_arrays(path, {"coef": np.zeros((4, 2))})
    with pytest.raises(UserError, match="no policy file"):
        load_policy(path)
    save_policy(path, make_policy())
    whole = files.load_arrays(path)
    files.save_arrays(path, {**whole, "version": 1})
    with pytest.raises(UserError, match="version 1, expected 2"):
        load_policy(path)
    for name in whole.keys() - {"format", "version"}:
        files.save_arrays(path, {key: values for key, values in whole.items() if key != name})
        with pytest.raises(UserError, match="incomplete"):
            load_policy(path)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(UserError, match="cut short"):
        load_policy(path)
