"""Bad input of every kind to every public function gets a clear error, or a good result."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("examples", ["0", pytest.param("60", marks=pytest.mark.slow)], ids=["few", "many"])
def test_bad_input_is_named_or_borne(examples):
    """In a process of its own: the import hook of these tests would speak before the library does."""
    # Errors from within jax shall show. What is compiled is for one device, quickly, and not for speed.
    settings = {"TRACEBACK_FILTERING": "off", "NUM_CPU_DEVICES": "1", "DISABLE_MOST_OPTIMIZATIONS": "1"}
    environment = {**os.environ, **{f"JAX_{name}": value for name, value in settings.items()}}
    environment["BAD_INPUT_EXAMPLES"] = examples
    command = [sys.executable, "-m", "pytest", "--noconftest", "-q", "-p", "no:cacheprovider", "--tb=short"]
    done = subprocess.run(
        [*command, "tests/bad_input.py"],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=540,
    )
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]
