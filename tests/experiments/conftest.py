"""Make a small experiment known, and compile quickly."""

import sys
import types

import jax
import pytest

from experiments import registry
from tests.experiments import tiny as small


@pytest.fixture(autouse=True)
def compiled_quickly():
    """Compile in half the time what then runs slower: here experiments run for a few iterations."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """Make the experiment known as `tiny`, and work in an empty folder."""
    # Each test has a module of its own, to change as it likes.
    module = types.ModuleType("experiments.tiny")
    vars(module).update({name: value for name, value in vars(small).items() if not name.startswith("__")})
    monkeypatch.setitem(sys.modules, "experiments.tiny", module)
    monkeypatch.setitem(registry.DESCRIPTIONS, "tiny", "a small experiment")
    monkeypatch.chdir(tmp_path)
    return module
