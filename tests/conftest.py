"""Prepare the process before jax starts, hold the library to its declared types, and share fixtures."""

import contextlib
import io
import os
from importlib.metadata import version

from creps_jax.tools.process import prepare

# Two CPU devices, so that sharding is exercised everywhere. Compiling what is small is faster than its cache,
# and tests compile much and run it little: with fewer optimisations the whole takes a third less time.
os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
if version("jaxlib").startswith("0.9."):
    # Without the new code generator, which users have, jaxlib compiles in half the time. It ends the process
    # where it does not know a flag, as later versions do this one.
    os.environ["XLA_FLAGS"] = f"--xla_cpu_use_fusion_emitters=false {os.environ.get('XLA_FLAGS', '')}"
prepare()

import jax
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Every annotated function of the library is checked against the shapes and types it promises; the tools take
# what people type, and answer mistakes themselves.
ROOMS = ("numerics", "policies", "robots", "search", "simulation", "tasks", "walking")
MODULES = ("checks", "contexts", "keys", "rollouts", "training")
install_import_hook([f"creps_jax.{name}" for name in (*ROOMS, *MODULES)], "beartype.beartype")

# Importing MJX writes to stdout that Warp is missing; do it once here, where doctests cannot see it.
with contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx  # noqa: F401


# The files that take longest, the longest first: workers that begin with them end together.
LONG_FILES = (
    "test_training.py",
    "test_walking.py",
    "test_comparison.py",
    "test_dual.py",
    "test_walk.py",
    "test_documents.py",
    "test_creps.py",
    "test_fit.py",
    "test_several_processes.py",
    "test_bad_input.py",
    "test_protocols.py",
    "test_kills.py",
    "test_control_step.py",
    "test_sine.py",
)


def pytest_collection_modifyitems(items):
    """Put the tests of long files first, in the order of the list."""
    order = {name: index for index, name in enumerate(LONG_FILES)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


@contextlib.contextmanager
def relaxed():
    """Allow implicit dtype and rank promotion, which MJX relies on."""
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        yield


@pytest.fixture
def relaxed_promotion():
    """Run the whole test with implicit promotion allowed, as code that calls MJX needs."""
    with relaxed():
        yield


@pytest.fixture(autouse=True, scope="module")
def few_compiled_programs():
    """Drop compiled programs after each file of tests.

    A program takes a dozen memory maps or more, of which Linux gives a process 65,530: of the thousands of
    programs of all tests, the last ones ended in a segmentation fault.
    """
    yield
    jax.clear_caches()


@pytest.fixture(scope="module")
def compiled_as_for_users():
    """Compile with all optimisations: from the first test of a file that asks for it on."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    jax.clear_caches()
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture
def key() -> jax.Array:
    """Return the key that tests without a seed of their own start from."""
    return jax.random.key(0)
