"""Read the description of a robot from a TOML file: the model, and the arguments of `humanoid_from_mjcf`."""

import contextlib
import importlib.util
import inspect
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path, PureWindowsPath
from typing import Any

from creps_jax import checks
from creps_jax.errors import UserError, suggest
from creps_jax.robots.humanoid import Humanoid

__all__ = ["humanoid_from_toml"]


def humanoid_from_toml(path: Path | str) -> Humanoid:
    """Read a humanoid from a TOML file.

    The key `model` names the MJCF file: a path, relative to the TOML file, or `package:path` for a file of an
    installed Python package. The other keys are the arguments of `humanoid_from_mjcf`.

    Args:
        path: The TOML file.

    Raises:
        ValueError: If the file cannot be read, has a key that is unknown, missing or in a table, or the robot
            cannot be made of it, see `humanoid_from_mjcf`.
    """
    # MuJoCo is imported only where a robot is read.
    from creps_jax.robots.mjcf import humanoid_from_mjcf

    checks.instance("path", path, str, Path)
    path = Path(path)
    values = _described(path)
    parameters = inspect.signature(humanoid_from_mjcf).parameters
    known = ["model", *(name for name in parameters if name != "path")]
    for key in values:
        if key not in known:
            raise UserError(f"{path} has an unknown key {key!r}{suggest(key, known)}")
    _check_no_table_has_a_key(path, values, known)
    required = ["model", *(n for n, p in parameters.items() if p.default is p.empty and n != "path")]
    if missing := [key for key in required if key not in values]:
        raise UserError(f"{path} must have the keys {', '.join(required)}; missing: {', '.join(missing)}")
    model = _model_path(path, values.pop("model"))
    values.setdefault("name", path.stem)
    try:
        return humanoid_from_mjcf(model, **values)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error


def _check_no_table_has_a_key(path: Path, values: Mapping[str, Any], known: Sequence[str]) -> None:
    """Check that no key of the description is in a table: in TOML, the lines below `[held]` belong to it."""
    tables = {name: value for name, value in values.items() if isinstance(value, Mapping)}
    for table, entries in tables.items():
        if late := [key for key in entries if key in known and key not in values]:
            raise UserError(
                f"{path} must have its keys before its tables, got {', '.join(late)} in the table [{table}]"
            )


def model_file(path: Path) -> Path:
    """Return the model file that a description names.

    Raises:
        ValueError: If the description cannot be read, or names no model.
    """
    return _model_path(path, _described(path).get("model"))


def _described(path: Path) -> dict[str, Any]:
    try:
        # Some editors begin a file with a byte order mark.
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        # The text of an OSError has the path again.
        why = error.strerror if isinstance(error, OSError) else error
        raise UserError(f"the robot must be described by a TOML file, cannot read {path}: {why}") from error


def _model_path(spec: Path, model: Any) -> Path:
    """Return the path of a model file that is named relative to the description, or within a package."""
    if not isinstance(model, str):
        raise UserError(f"model in {spec} must be a path, or package:path, got {model!r}")
    package, colon, inside = model.partition(":")
    if not colon or PureWindowsPath(model).is_absolute():
        return spec.parent / model
    folders = None
    # Python raises for a module without a file, such as `__main__`.
    with contextlib.suppress(ValueError):
        found = importlib.util.find_spec(package) if package.isidentifier() else None
        folders = None if found is None else found.submodule_search_locations
    if not folders:
        raise UserError(
            f"model in {spec} must be in an installed package, got {model!r}: there is no package {package!r}"
            "; install it, or name the path of the file (a file in a subpackage is package:folder/file)"
        )
    return Path(next(iter(folders))) / inside
