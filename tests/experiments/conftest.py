"""Make a small experiment known, and updates that compile quickly."""

import dataclasses
import sys
import types

import jax
import jax.numpy as jnp
import pytest

from creps_jax.search.archive import push
from creps_jax.search.creps import CrepsState, creps
from experiments import comparison, registry
from experiments.walking import learning as walk_learning
from tests.experiments import tiny as small


@pytest.fixture
def simple_updates(monkeypatch):
    """Let experiments take any new mean for an update: the real one takes seconds to compile, each time."""

    def make(*features, **settings):
        algorithm = creps(*features, **settings)

        def tell(state, batch):
            _, info = jax.eval_shape(algorithm.tell, state, batch)
            info = jax.tree.map(lambda leaf: jnp.ones(leaf.shape, leaf.dtype), info)
            best = batch.theta[jnp.argmax(batch.reward)]
            policy = state.policy._replace(coef=0.9 * state.policy.coef + 0.1 * best[None])
            return CrepsState(policy, push(state.archive, batch), state.iteration + 1, state.history), info

        return dataclasses.replace(algorithm, tell=tell)

    for module in (comparison, walk_learning):
        monkeypatch.setattr(module, "creps", make)


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """Make the experiment known as `tiny`, and work in an empty folder."""
    # Each test has a module of its own, to change as it likes.
    module = types.ModuleType("experiments.tiny")
    vars(module).update({name: value for name, value in vars(small).items() if not name.startswith("__")})
    monkeypatch.setitem(sys.modules, "experiments.tiny", module)
    monkeypatch.setitem(registry.EXPERIMENTS, "tiny", small.ENTRY)
    monkeypatch.chdir(tmp_path)
    return module
