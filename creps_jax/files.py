"""Read and write files of arrays, text and JSON; a file is written completely or not at all."""

import contextlib
import errno
import importlib.metadata
import json
import os
import tempfile
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from creps_jax.errors import UserError


def package_version() -> str:
    """Return the version of creps_jax, of the installed package or of the checkout."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return importlib.metadata.version("creps_jax")
    with contextlib.suppress(OSError, KeyError, tomllib.TOMLDecodeError):
        project = Path(__file__).parents[1] / "pyproject.toml"
        return tomllib.loads(project.read_text())["project"]["version"]
    return "unknown"


def models_folder() -> Path:
    """Return the folder of the robots' models and policies, in the checkout or in the installed package."""
    package = Path(__file__).resolve().parent
    installed = package / "models"
    return installed if installed.is_dir() else package.parent / "models"


def policies_folder(robot: str = "nao") -> Path:
    """Return the folder of the shipped policies of a robot."""
    return models_folder() / robot / "policies"


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file atomically: a reader finds the complete old file or the complete new one.

    The bytes are written to a temporary file in the same folder, and synced to the disk; then the file is
    renamed.

    Args:
        path: the file; its folder is made if it does not exist.
        write: function that writes to the open file.

    Raises:
        UserError: if the file cannot be written, for example on a full disk; an earlier file is kept.
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
        # mkstemp makes private files; results get the usual permissions.
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
    """Sync the names of the files in a folder to the disk, so that a loss of power does not remove them.

    Raises:
        UserError: if the disk reports an error.
    """
    try:
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        # Some network file systems do not support this.
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            reason = error.strerror or error
            raise UserError(f"what was written to {folder} may not last a loss of power: {reason}") from error


def save_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write named arrays to a compressed .npz file, atomically."""
    as_numpy = {name: np.asarray(value) for name, value in arrays.items()}
    write_atomically(path, lambda file: np.savez_compressed(file, allow_pickle=False, **as_numpy))


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an .npz file.

    Raises:
        UserError: if the file does not exist, is cut short, or is not an .npz file of plain arrays.
    """
    if not path.exists():
        raise UserError(f"no such file: {path}")
    if path.is_dir():
        raise UserError(f"{path} is a folder, expected an .npz file")
    try:
        # Opened here, as np.load does not close a file that it refuses.
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
        UserError: if the file does not exist, is cut short, is not JSON, or has a field twice.
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


def check_writable(folder: Path) -> None:
    """Check that a folder can be made and written to, before the work whose result it gets.

    Raises:
        UserError: if it cannot.
    """
    try:
        there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise UserError(f"cannot write to the folder {folder}: {error.strerror or error}") from error


def umask() -> int:
    """Return the permissions that new files of this process do not get."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
