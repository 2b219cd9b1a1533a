"""Result folders: arrays, figures, tables, and a manifest with settings, seed and versions."""

import contextlib
import dataclasses
import datetime
import importlib.metadata
import platform
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.files import package_version
from creps_jax.tools.process import usable_cores

ARRAYS = "arrays.npz"
MANIFEST = "manifest.json"
_CHECKOUT = Path(__file__).parents[2]

_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "scipy", "matplotlib")


def new_folder(parent: Path, name: str) -> Path:
    """Make a new folder `parent/name`, or `name-2`, `name-3`, ... if it exists already.

    Raises:
        UserError: if the folder cannot be made.
    """
    try:
        parent.mkdir(parents=True, exist_ok=True)
        for number in range(1, 1000):
            folder = parent / (name if number == 1 else f"{name}-{number}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir()
                return folder
    except OSError as error:
        raise UserError(f"cannot make a result folder in {parent}: {error.strerror or error}") from error
    raise UserError(f"cannot make a result folder in {parent}: too many are named {name}")


def stamp() -> str:
    """Return the local time as a folder name; names sort by time."""
    return datetime.datetime.now().strftime("%Y%m%d-%H%M%S")


def latest_folder(
    experiment: str, *, status: str | None = None, robot: str | None = None, root: Path | None = None
) -> Path | None:
    """Return the newest result folder of an experiment, with this status and robot if they are given."""
    parent = (root or default_root()) / experiment
    found = []
    for path in parent.glob(f"*/{MANIFEST}"):
        with contextlib.suppress(UserError):
            manifest = load_manifest(path.parent)
            if status in (None, manifest.get("status")) and robot in (None, robot_of(manifest)):
                found.append((str(manifest.get("started")), path.parent))
    return max(found)[1] if found else None


def robot_of(manifest: Mapping[str, Any]) -> str:
    """Return the robot of a result: the NAO if the settings have none."""
    settings = manifest.get("settings")
    return str(settings.get("robot", "nao")) if isinstance(settings, Mapping) else "nao"


def default_root() -> Path:
    """Return the default folder of result folders: `results/` in the working folder."""
    return Path("results")


def make_manifest(experiment: str, preset: str, settings: Any, seed: int) -> dict[str, Any]:
    """Return the manifest of a run: settings, seed, commit, versions and processor."""
    return {
        "experiment": experiment,
        "preset": preset,
        "seed": seed,
        "settings": dataclasses.asdict(settings),
        "status": "running",
        "started": datetime.datetime.now().astimezone().isoformat(timespec="milliseconds"),
        "seconds": 0.0,
        "commit": git_commit(),
        "version": package_version(),
        "python": platform.python_version(),
        "packages": package_versions(),
        "system": platform.platform(),
        "processor": processor_name(),
        "cores": usable_cores(),
    }


def load_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of a result folder.

    Raises:
        UserError: if there is no manifest, or it is invalid.
    """
    if not (folder / MANIFEST).exists():
        raise UserError(f"{folder} is no result folder: it has no {MANIFEST}")
    return load_manifest_file(folder / MANIFEST)


def load_manifest_file(path: Path) -> dict[str, Any]:
    """Read a manifest.

    Raises:
        UserError: if the file does not exist, or is not a manifest.
    """
    manifest = files.load_json(path)
    if not isinstance(manifest, dict) or not isinstance(manifest.get("settings"), dict):
        raise UserError(f"{path} is no manifest of an experiment")
    return manifest


def git_commit() -> str | None:
    """Return the commit of the checkout, marked "-dirty" if files differ; None without a checkout."""
    if not (_CHECKOUT / "pyproject.toml").is_file():
        return None
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            cwd=_CHECKOUT, capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return described.stdout.strip() or None


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that affect the numbers."""
    versions = {}
    for name in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def processor_name() -> str:
    """Return the name of the processor."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


@contextlib.contextmanager
def complete(folder: Path) -> Iterator[None]:
    """Report an array that a result lacks, for example because another version wrote it.

    Raises:
        UserError: in place of a KeyError, with the file.
    """
    try:
        yield
    except KeyError as error:
        raise UserError(f"{folder / ARRAYS} lacks {error}: it is of another version or experiment") from error
