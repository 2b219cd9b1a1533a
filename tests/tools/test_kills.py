"""Runs that are killed go on to the same numbers."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from creps_jax.files import load_arrays

ROOT = Path(__file__).parents[2]
DEADLINE = 300.0
RESUME = ("--resume",)


def start(cache, *arguments):
    """Start the small experiment in a process of its own."""
    environment = os.environ | {
        "PYTHONPATH": str(ROOT),
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_NUM_CPU_DEVICES": "1",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    command = [sys.executable, "-m", "tests.experiments.tiny", "run", "tiny", *arguments]
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)


def time_of(path):
    """Return when a file was last replaced; 0 if there is none."""
    return path.stat().st_mtime_ns if path.exists() else 0


@pytest.mark.parametrize(
    ("kills", "iterations"), [(1, 120), pytest.param(20, 2000, marks=pytest.mark.slow)], ids=["1", "20"]
)
def test_a_killed_run_goes_on_to_the_same_bits(tmp_path, kills, iterations):
    settings = ["--iterations", str(iterations)]
    assert start(tmp_path / "cache", *settings, "--out", str(tmp_path / "whole")).wait(DEADLINE) == 0
    whole = load_arrays(tmp_path / "whole" / "arrays.npz")
    rng = random.Random(0)
    part, checkpoint = tmp_path / "part", tmp_path / "part" / "checkpoint-tiny.npz"
    for _ in range(kills):
        before = time_of(checkpoint)
        with start(tmp_path / "cache", *settings, "--out", str(part), *RESUME[: part.exists()]) as process:
            while time_of(checkpoint) == before and process.poll() is None:
                time.sleep(0.01)
            time.sleep(rng.uniform(0.0, 0.2))
            process.kill()
        assert process.returncode == -signal.SIGKILL
        assert not (part / "arrays.npz").exists()
    with start(tmp_path / "cache", *settings, "--out", str(part), *RESUME) as process:
        process.communicate(timeout=DEADLINE)
    assert process.returncode == 0
    resumed = load_arrays(part / "arrays.npz")
    assert resumed.keys() == whole.keys()
    for name, values in whole.items():
        np.testing.assert_array_equal(resumed[name], values)
