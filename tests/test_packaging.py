"""Hold the locked versions to the bounds that pyproject.toml declares."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
LOCK = (ROOT / "requirements.lock").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PYTHONS = ("3.11.9", "3.12.9", "3.13.9")


def locked(python: str) -> dict[str, Requirement]:
    """Return what a Python on Linux installs, by name; each one pinned, with hashes."""
    environment = {
        "python_version": python.rpartition(".")[0],
        "python_full_version": python,
        "sys_platform": "linux",
        "implementation_name": "cpython",
    }
    pins = {}
    for entry in re.split(r"\n(?=\S)", LOCK.strip()):
        pin, *hashes = entry.split(" \\\n")
        requirement = Requirement(pin)
        assert re.fullmatch(r"==[^,*]+", str(requirement.specifier)), pin
        assert hashes, pin
        assert all(re.fullmatch(r"    --hash=sha256:[0-9a-f]{64}", line) for line in hashes), pin
        if requirement.marker is None or requirement.marker.evaluate(environment):
            assert requirement.name not in pins, pin
            pins[requirement.name] = requirement
    return pins


@pytest.mark.parametrize("python", PYTHONS)
def test_one_lock_serves_every_python(python):
    pins = locked(python)
    project = PROJECT["project"]
    wanted = [*project["dependencies"], *PROJECT["build-system"]["requires"]]
    wanted += [entry for group in project["optional-dependencies"].values() for entry in group]
    for requirement in map(Requirement, wanted):
        if requirement.marker is None or requirement.marker.evaluate({"python_version": python[:4]}):
            version = str(pins[requirement.name].specifier).removeprefix("==")
            assert requirement.specifier.contains(version), requirement


def test_the_lock_names_no_place_to_download_from():
    assert not re.search(r"://|^-|index|find-links|#", LOCK, re.MULTILINE)
