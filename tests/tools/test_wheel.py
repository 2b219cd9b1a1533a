"""Build the wheel, and use it in an empty folder, without the checkout."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """Return a folder with nothing but the package, as pip would install it."""
    folder = tmp_path_factory.mktemp("installed")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True, timeout=300)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


@pytest.fixture
def run(installed, tmp_path):
    """Return a function that runs Python in an empty folder, where only the installed package is found."""
    environment = {**os.environ, "PYTHONPATH": str(installed), "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}

    def command(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=540,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    return command


def test_the_package_is_imported_and_its_policies_are_loaded(run, installed):
    code = (
        "import creps_jax as cj; print(cj.__file__); print(cj.__version__);"
        "from creps_jax.files import policies_folder;"
        "print(cj.load(policies_folder() / 'walk.npz')(0.3)['step_length'])"
    )
    place, version, length = run("-c", code).splitlines()
    assert Path(place).is_relative_to(installed)
    assert version != "unknown" and 0.0 < float(length) < 0.2


def test_the_tools_play_export_and_open_sessions(run, tmp_path, installed):
    tools = ("-m", "creps_jax.tools")
    assert "asked 0.30 m/s, reached 0.3" in run(*tools, "play", "--speed", "0.3")
    run(*tools, "export", "--to", "walk.h")
    run(*tools, "export", "--to", "walk.onnx")
    run(*tools, "export", "--to", "walk.csv", "--speed", "0.2", "--duration", "1")
    policy = installed / "creps_jax" / "models" / "nao" / "policies" / "walk.npz"
    run(*tools, "session", "new", "arm", "--policy", str(policy))
    assert "trial" in run(*tools, "session", "ask", "arm")
    assert {"walk.h", "walk.onnx", "walk.csv", "arm"} <= {path.name for path in tmp_path.iterdir()}


def test_the_wheel_has_the_command_and_all_that_it_needs(installed):
    (metadata,) = installed.glob("*.dist-info")
    assert "creps-jax = creps_jax.tools.__main__:main" in (metadata / "entry_points.txt").read_text()
    names = {path.name for path in (installed / "creps_jax" / "models" / "nao").iterdir()}
    assert {"nao.xml", "policies"} <= names
    assert not (installed / "experiments").exists() and not (installed / "tests").exists()
