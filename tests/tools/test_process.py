import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from creps_jax.tools import process

ROOT = Path(__file__).parents[2]


def prepared(tmp_path, **environment):
    """Prepare a process with the given environment and return what it then has."""
    code = (
        "import json, os; from creps_jax.tools.process import prepare; prepare(); prepare();"
        "print(json.dumps(dict(os.environ)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env={"HOME": str(tmp_path), "PATH": "", **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout)


def test_a_device_for_each_core_one_thread_each_and_a_cache(tmp_path):
    found = prepared(tmp_path)
    assert found["JAX_NUM_CPU_DEVICES"] == str(process.usable_cores())
    assert found["XLA_FLAGS"].split() == list(process.XLA_FLAGS)
    assert Path(found["JAX_COMPILATION_CACHE_DIR"]) == tmp_path / ".cache" / "creps_jax" / "jax"
    assert Path(found["JAX_COMPILATION_CACHE_DIR"]).is_dir()


def test_what_the_user_has_set_stays(tmp_path):
    wishes = {
        "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=true --xla_force_host_platform_device_count=3",
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "mine"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "7",
    }
    found = prepared(tmp_path, **wishes)
    assert set(found["XLA_FLAGS"].split()) >= set(wishes.pop("XLA_FLAGS").split())
    assert "--xla_cpu_multi_thread_eigen=false" not in found["XLA_FLAGS"]
    assert {name: found[name] for name in wishes} == wishes
    assert "JAX_NUM_CPU_DEVICES" not in found
    assert prepared(tmp_path, XLA_FLAGS="--foo=1")["XLA_FLAGS"].split() == ["--foo=1", *process.XLA_FLAGS]
    assert prepared(tmp_path, JAX_NUM_CPU_DEVICES="1")["JAX_NUM_CPU_DEVICES"] == "1"


def test_a_home_that_cannot_be_written_costs_only_the_cache(tmp_path):
    (tmp_path / "file").write_text("")
    assert "JAX_COMPILATION_CACHE_DIR" not in prepared(tmp_path, HOME=str(tmp_path / "file"))


def test_an_opengl_that_is_not_there_is_named():
    code = "from creps_jax.tools.process import import_mjx_quietly; import_mjx_quietly()"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env={**os.environ, "MUJOCO_GL": "bogus"},
        capture_output=True,
        text=True,
        check=False,
    )
    error = done.stderr.splitlines()[-1]
    assert error.endswith(
        "MUJOCO_GL must name an OpenGL that is installed here, egl as a rule, or be unset, got 'bogus'"
    )


class InterruptedInCallback:
    def __del__(self):
        raise KeyboardInterrupt


def test_an_interrupt_within_a_callback_is_not_lost(monkeypatch):
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process.keep_interrupts()
    try:
        with pytest.raises(KeyboardInterrupt):
            InterruptedInCallback()
            time.sleep(10.0)
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(
    ("arguments", "code", "out", "error"),
    [
        ([], 0, "python -m experiments run walk", ""),
        (["--help"], 0, "python -m experiments check", ""),
        (["list"], 0, "fig05_sinus", ""),
        (["list"], 0, "presets: quick, humanoid, paper, author, best", ""),
        (["run", "wlak"], 2, "", "error: unknown experiment 'wlak', did you mean 'walk'?"),
        (["run", "walk", "--preset", "quik"], 2, "", "error: unknown preset 'quik', did you mean 'quick'?"),
        (
            ["run", "all", "--preset", "best"],
            2,
            "",
            "error: unknown preset 'best', choose from: paper,",
        ),
        (["plot", "wlak"], 2, "", "error: unknown experiment"),
        (["check", "wlak"], 2, "", "error: unknown experiment"),
        (
            ["run", "walk", "--speed", "0.3"],
            2,
            "",
            "error: --speed is not a setting of an experiment",
        ),
        (["run", "--preset", "quick", "walk"], 2, "", "error: the name of the experiment comes first"),
        (["video"], 2, "", "error: video is not a command here; use `python -m creps_jax.tools play`"),
        (["session", "ask", "arm"], 2, "", "error: session is not a command here; use `"),
    ],
)
def test_help_and_mistakes_are_answered_without_starting_jax(tmp_path, arguments, code, out, error):
    answered("experiments.cli", tmp_path, arguments, code, out, error)


@pytest.mark.parametrize(
    ("arguments", "code", "out", "error"),
    [
        ([], 0, "creps-jax play --speed", ""),
        (["play", "--help"], 0, "Policy file", ""),
        (["play", "--seed", "-1"], 2, "", "error: seed must be from 0"),
        (["export", "--to", "x.onx"], 2, "", "error: --to must end in .onnx, .h, .c, .csv, .npz, got x.onx"),
        (["export", "--to", "x"], 2, "", "error: --to must end in"),
        (["export", "--to", "x.csv"], 2, "", "error: x.csv would hold the joint set-points of a walk"),
        (["export", "--to", "x.h", "--speed", "0.3"], 2, "", "error: --speed goes with .csv and .npz: x.h"),
        (["export", "--to", "x.h", "--duration", "8"], 2, "", "error: --duration goes with .csv and .npz"),
        (["session", "tell", "--help"], 0, "The measurement failed", ""),
        (
            ["session", "tell", "nowhere", "1", "--reward", "-2"],
            2,
            "",
            "error: nowhere holds no robot session",
        ),
    ],
)
def test_the_tools_do_so_too(tmp_path, arguments, code, out, error):
    answered("creps_jax.tools.cli", tmp_path, arguments, code, out, error)


def answered(module, tmp_path, arguments, code, out, error):
    program = (
        f"import sys; from {module} import main; code = main(sys.argv[1:]);"
        "heavy = {'jax', 'mujoco', 'matplotlib'} & set(sys.modules); assert not heavy, heavy; sys.exit(code)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        cwd=ROOT,
        env={"HOME": str(tmp_path), "PATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, out in done.stdout, error in done.stderr) == (code, True, True), done
    assert len(done.stderr.splitlines()) == (1 if error else 0)
