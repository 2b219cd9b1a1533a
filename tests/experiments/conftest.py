"""A small experiment to run, with everything that a real one has."""

import dataclasses
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.creps import creps
from creps_jax.features import linear_features, quadratic_features
from creps_jax.policy import LinearGaussian
from creps_jax.tasks.sinus import sinus
from experiments import plots, registry
from experiments.learning import Plan, learn, trial_keys
from experiments.registry import Claim

# Made once: every run of the tests shares one compilation.
TASK = sinus(0.0, 1.0)
ALGORITHM = creps(linear_features(1), quadratic_features(1), archive_size=40)


@dataclasses.dataclass(frozen=True)
class Settings:
    iterations: int = 4
    trials: int = 2
    speeds: tuple[float, ...] = (0.1, 0.2)


def run(settings, key, session):
    plan = Plan(settings.iterations, samples=10)
    start = LinearGaussian(jnp.zeros((2, 1)), jnp.eye(1))
    keys = trial_keys(key, settings.trials)
    devices = jax.local_devices()[:1]
    _, log = learn(keys, TASK, ALGORITHM, start, plan, session=session, name="tiny", devices=devices)
    return {"reward": log["mean_reward"], "coef": log["coef"]}


def plot(arrays):
    episodes = np.arange(arrays["reward"].shape[1])
    return {"curve": plots.learning_curves({"tiny": {"samples": (episodes, arrays["reward"])}})}


@pytest.fixture(autouse=True)
def compiled_quickly():
    """Compile in half the time what then runs slower: here experiments run for a few iterations."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """Make the experiment known as `tiny`, and work in an empty folder."""
    module = types.ModuleType("experiments.tiny")
    claims = (Claim("last reward", -1.0, lambda arrays: arrays["reward"][:, -1].mean(), low=-10.0),)
    vars(module).update(Settings=Settings, run=run, plot=plot, CLAIMS=claims)
    module.SETTINGS = {"quick": Settings(), "long": Settings(iterations=6)}
    monkeypatch.setitem(sys.modules, "experiments.tiny", module)
    monkeypatch.setitem(registry.DESCRIPTIONS, "tiny", "a small experiment")
    monkeypatch.chdir(tmp_path)
    return module
