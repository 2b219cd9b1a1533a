"""Keep results in folders of whole files: arrays, figures, tables and a manifest of how they came about."""

import contextlib
import dataclasses
import datetime
import errno
import importlib.metadata
import json
import os
import platform
import subprocess
import tempfile
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from experiments.errors import UserError
from experiments.process import usable_cores

ROOT = Path(__file__).parents[1]
ARRAYS = "arrays.npz"
MANIFEST = "manifest.json"

_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "scipy", "matplotlib")


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file so that a reader finds either the old one or the new one, whole.

    The bytes go to a temporary name in the same folder, to the disk, and only then to the name.

    Args:
        path: where the file shall be; its folder is made if need be.
        write: gets the open file and writes to it.

    Raises:
        UserError: if the file cannot be written, a full disk for example; an earlier file stays.
    """
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".part", dir=path.parent)
        temporary = Path(name)
        with open(handle, "wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes files private; results are as readable as any other file.
        temporary.chmod(0o666 & ~umask())
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        reason = error.strerror or error
        raise UserError(
            f"cannot write {path}: {reason}; files that were there before are unharmed"
        ) from error
    finally:
        if temporary is not None:
            with contextlib.suppress(OSError):
                temporary.unlink()
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """See that the names in a folder, and not only what their files hold, last a loss of power.

    Raises:
        UserError: if the disk refuses.
    """
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        # Some network file systems know no such thing; there is nothing more to be done on them.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            reason = error.strerror or error
            raise UserError(f"what was written to {folder} may not last a loss of power: {reason}") from error


def save_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write named arrays to a compressed .npz file, atomically."""
    as_numpy = {name: np.asarray(value) for name, value in arrays.items()}
    write_atomically(path, lambda file: np.savez_compressed(file, allow_pickle=False, **as_numpy))


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read every array of an .npz file.

    Raises:
        UserError: if there is no such file, it is cut short, or it is no .npz file of plain arrays.
    """
    if not path.exists():
        raise UserError(f"no such file: {path}")
    if path.is_dir():
        raise UserError(f"{path} is a folder, expected an .npz file")
    try:
        # Opened here: a file that np.load refuses it would leave open.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or 'it is no whole .npz file'}") from error
    except (ValueError, TypeError, EOFError, NotImplementedError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"cannot read {path}: it is cut short, or no .npz file of plain arrays") from error


def save_text(path: Path, text: str) -> None:
    """Write a text file, atomically."""
    write_atomically(path, lambda file: file.write(text.encode()))


def save_json(path: Path, values: Any) -> None:
    """Write values as indented JSON, atomically."""
    save_text(path, json.dumps(values, indent=2, default=str) + "\n")


def load_json(path: Path) -> Any:
    """Read a JSON file.

    Raises:
        UserError: if there is none, it is cut short, it is no JSON, or it names a field twice.
    """
    try:
        return json.loads(path.read_text("utf-8"), object_pairs_hook=_without_repetition)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise UserError(f"cannot read {path}: it is cut short, or no JSON file ({error})") from error


def _without_repetition(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"the field {name!r} is there twice")
    return dict(pairs)


def save_figure(path: Path, figure: Any) -> None:
    """Write a matplotlib figure as PNG, atomically."""
    write_atomically(path, lambda file: figure.savefig(file, format="png"))


def new_folder(parent: Path, name: str) -> Path:
    """Make a new folder `parent/name`, or `name-2`, `name-3`, ... where that is taken.

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


def check_writable(folder: Path) -> None:
    """See that a folder can be made and written to, before work is done whose result goes there.

    Raises:
        UserError: if it cannot.
    """
    try:
        there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise UserError(f"cannot write to the folder {folder}: {error.strerror or error}") from error


def stamp() -> str:
    """Return the local time as a folder name, sorted as time goes."""
    return datetime.datetime.now().strftime("%Y%m%d-%H%M%S")


def latest_folder(
    experiment: str, *, status: str | None = None, robot: str | None = None, root: Path | None = None
) -> Path | None:
    """Find the newest result folder of an experiment, with a given status and robot if one is asked for."""
    parent = (root or default_root()) / experiment
    found = []
    for path in parent.glob(f"*/{MANIFEST}"):
        with contextlib.suppress(UserError):
            manifest = load_manifest(path.parent)
            if status in (None, manifest.get("status")) and robot in (None, robot_of(manifest)):
                found.append((str(manifest.get("started")), path.parent))
    return max(found)[1] if found else None


def robot_of(manifest: Mapping[str, Any]) -> str:
    """Return whose results a manifest tells of; those of experiments without a robot are the NAO's too."""
    settings = manifest.get("settings")
    return str(settings.get("robot", "nao")) if isinstance(settings, Mapping) else "nao"


def default_root() -> Path:
    """Return where result folders go unless told otherwise: `results/` in the working folder."""
    return Path("results")


def make_manifest(experiment: str, preset: str, settings: Any, seed: int) -> dict[str, Any]:
    """Say how results come about: settings, seed, commit, versions and processor."""
    return {
        "experiment": experiment,
        "preset": preset,
        "seed": seed,
        "settings": dataclasses.asdict(settings),
        "status": "running",
        "started": datetime.datetime.now().astimezone().isoformat(timespec="milliseconds"),
        "seconds": 0.0,
        "commit": git_commit(),
        "version": project_version(),
        "python": platform.python_version(),
        "packages": package_versions(),
        "system": platform.platform(),
        "processor": processor_name(),
        "cores": usable_cores(),
    }


def load_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of a result folder.

    Raises:
        UserError: if there is none, or it is no manifest.
    """
    path = folder / MANIFEST
    if not path.exists():
        raise UserError(f"{folder} is no result folder: it has no {MANIFEST}")
    manifest = load_json(path)
    if not isinstance(manifest, dict) or not isinstance(manifest.get("settings"), dict):
        raise UserError(f"{path} is no manifest of an experiment")
    return manifest


def git_commit() -> str | None:
    """Return the commit of the project, marked where files differ from it; None outside of git."""
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            cwd=ROOT, capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return None
    return described.stdout.strip() or None


def project_version() -> str:
    """Return the version of creps_jax, installed or not."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version("creps_jax")
    with contextlib.suppress(OSError, KeyError, tomllib.TOMLDecodeError):
        return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    return "unknown"


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that decide the numbers."""
    versions = {}
    for name in _PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


def processor_name() -> str:
    """Return the processor's name as the system tells it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def umask() -> int:
    """Return which permissions new files of this process do not get."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
