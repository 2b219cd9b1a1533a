"""Several processes share one run, and come to the numbers of one."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np

from creps_jax.files import load_arrays

ROOT = Path(__file__).parents[2]
DEADLINE = 300.0


def free_port():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def start(out, num_devices, *arguments, **environment):
    """Start the small experiment; its three trials cannot be shared by two devices: their rollouts are."""
    command = [sys.executable, "-m", "tests.experiments.tiny", "run", "tiny", "--trials", "3"]
    return subprocess.Popen(
        [*command, "--out", str(out), *arguments],
        env=os.environ | {"PYTHONPATH": str(ROOT), "JAX_NUM_CPU_DEVICES": str(num_devices)} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def test_two_processes_come_to_the_numbers_of_one(tmp_path):
    peers = {"JAX_COORDINATOR_ADDRESS": f"127.0.0.1:{free_port()}", "JAX_NUM_PROCESSES": "2"}
    both = [
        start(tmp_path / "two", 1, "--distributed", JAX_PROCESS_ID=str(number), **peers)
        for number in range(2)
    ]
    said = [process.communicate(timeout=DEADLINE)[0] for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    # One of them speaks and writes.
    assert "finished" in said[0] and "finished" not in said[1]
    alone = start(tmp_path / "one", 2)
    assert alone.communicate(timeout=DEADLINE)[0] and alone.returncode == 0
    one, two = (load_arrays(tmp_path / name / "arrays.npz") for name in ("one", "two"))
    assert one.keys() == two.keys() and one["coef"].shape[0] == 3
    for name, values in one.items():
        np.testing.assert_allclose(two[name], values, rtol=1e-5, atol=1e-6)


def test_a_process_without_peers_says_what_it_lacks(tmp_path):
    lonely = start(tmp_path / "none", 1, "--distributed")
    said = lonely.communicate(timeout=DEADLINE)[0]
    assert lonely.returncode == 2
    assert "error: cannot join the other processes" in said and "Traceback" not in said
    assert not (tmp_path / "none").exists()
