"""Decide settings, seed and result folder of a run: of a new one, or of one to resume."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.policies.feature_settings import Features, as_in_earlier_versions, upgraded
from creps_jax.tools import results
from creps_jax.tools.command_line import check_seed
from creps_jax.tools.session import plain
from experiments import registry

_MOST = {"iterations": 1_000_000, "trials": 1_000}
"""Upper limits of settings: more does not fit in memory."""


@dataclasses.dataclass(frozen=True)
class Request:
    """What to run.

    Attributes:
        name: the experiment.
        settings: all its settings, see `default_settings`.
        preset: name of the preset that the settings are based on; None is the experiment's first preset, or
            the preset of the run to resume.
        config: manifest that the settings are based on, instead of a preset.
        seed: seed of the random key; None is the seed of `config` or of the run to resume, or else 0.
        out: the result folder; None is a new one.
        resume: whether to resume the run in `out`, see `folder_to_resume`.
    """

    name: str
    settings: Any
    preset: str | None = None
    config: Path | None = None
    seed: int | None = None
    out: Path | None = None
    resume: bool = False


def default_settings(
    experiment: registry.Experiment,
    name: str,
    *,
    preset: str | None = None,
    config: Path | None = None,
    out: Path | None = None,
    resume: bool = False,
) -> Any:
    """Return the settings that a run begins with, before any of them is changed.

    They come from the run to resume, from a manifest, or from a preset, by default the first one.

    Raises:
        UserError: if the source does not exist, or more than one is given.
    """
    if config is not None and (preset is not None or resume):
        raise UserError("--config names all settings of a run: it does not go with --preset and --resume")
    if resume:
        folder = folder_to_resume(name, out)
        return settings_of(experiment, folder, results.load_manifest(folder))
    if config is not None:
        manifest = results.load_manifest_file(config)
        if manifest.get("experiment") != name:
            raise UserError(f"{config} is of {manifest.get('experiment')!r}, expected {name!r}")
        return settings_of(experiment, config, manifest)
    if preset is None:
        return next(iter(experiment.SETTINGS.values()))
    registry.check_preset(name, preset)
    return experiment.SETTINGS[preset]


def folder_to_resume(name: str, out: Path | None, robot: str | None = None) -> Path:
    """Return the folder of a run to resume: `out`, or the folder of the latest unfinished run.

    Args:
        name: the experiment.
        out: the folder; None looks for one.
        robot: the robot of the run; None is any robot.

    Raises:
        UserError: if no run is unfinished.
    """
    if out is not None:
        return out
    found = [
        results.latest_folder(name, status=status, robot=robot)
        for status in ("running", "interrupted", "failed")
    ]
    folder = max((path for path in found if path is not None), default=None, key=lambda path: path.name)
    if folder is None:
        asked = "" if robot is None else f" with the robot {robot}"
        raise UserError(f"there is no unfinished run of {name}{asked} in {results.default_root()}")
    return folder


def started(experiment: registry.Experiment, request: Request) -> tuple[Any, Path, dict[str, Any]]:
    """Return settings, an empty result folder and a manifest for a new run."""
    settings, seed = resolved(request)
    preset = request.preset or ("config" if request.config else next(iter(experiment.SETTINGS)))
    folder = request.out
    if folder is None:
        folder = results.new_folder(results.default_root() / request.name, f"{results.stamp()}-{preset}")
    elif (folder / results.MANIFEST).exists():
        raise UserError(f"{folder} holds a run already: add --resume to resume it, or name another folder")
    elif folder.exists() and not folder.is_dir():
        raise UserError(f"{folder} is a file, expected a folder")
    elif folder.exists() and (foreign := [p.name for p in folder.iterdir() if not p.name.startswith(".")]):
        # What is there might have the names of what a run writes.
        raise UserError(f"{folder} holds other files, such as {min(foreign)}: name a new folder")
    else:
        files.check_writable(folder)
    return settings, folder, results.make_manifest(request.name, preset, settings, seed)


def resolved(request: Request) -> tuple[Any, int]:
    """Return settings and seed of a new run.

    Settings that depend on the machine or on defaults get their values here, so that a run that is resumed on
    another machine or by another version has the same settings.
    """
    seed = request.seed
    _check_counts(request.settings)
    if seed is None and request.config is not None:
        seed = results.load_manifest_file(request.config).get("seed")
        if not isinstance(seed, int):
            raise UserError(f"{request.config} must have a whole number as seed, got {seed!r}")
        check_seed(seed)
    return resolved_settings(request.settings), seed or 0


def resolved_settings(settings: Any) -> Any:
    """Return settings with a value in place of each "auto" and None that stands for one."""
    return settings.resolved() if hasattr(settings, "resolved") else settings


def resumed(experiment: registry.Experiment, request: Request) -> tuple[Any, Path, dict[str, Any]]:
    """Return settings, folder and manifest of a run to resume."""
    folder = folder_to_resume(request.name, request.out)
    manifest = results.load_manifest(folder)
    for field, kind in (("seed", int), ("seconds", float | int)):
        if not isinstance(manifest.get(field), kind):
            raise UserError(
                f"{folder} has no {field} in its manifest, expected a number: it cannot be resumed"
            )
    before = settings_of(experiment, folder, manifest)
    asked = {"experiment": request.name, "preset": request.preset, "seed": request.seed}
    there = {field: manifest.get(field) for field in asked}
    names = [field.name for field in dataclasses.fields(before) if field.name != "iterations"]
    asked |= {name: getattr(request.settings, name) for name in names}
    there |= {name: getattr(before, name) for name in names}
    for field, value in asked.items():
        if value is not None and value != there[field]:
            raise UserError(f"{folder} has {field} {there[field]!r}, not {value!r}; leave it out to resume")
    _check_counts(request.settings)
    manifest["settings"] = dataclasses.asdict(request.settings)
    return request.settings, folder, manifest


def settings_of(experiment: registry.Experiment, path: Path, manifest: Mapping[str, Any]) -> Any:
    """Return the settings that a manifest holds."""
    try:
        return plain.read(experiment.Settings, upgraded(manifest["settings"]), "settings")
    except UserError as error:
        raise UserError(f"cannot use the settings of {path}: {error}") from error


def _check_counts(settings: Any) -> None:
    """Refuse counts below 1, and counts for which a run has not enough memory."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            _check_counts(value)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, int) and not isinstance(number, bool):
                if number < 1:
                    raise UserError(f"{field.name} must be at least 1, got {value}")
                if number > _MOST.get(field.name, number):
                    raise UserError(f"{field.name} must be at most {_MOST[field.name]}, got {value}")


def identity(name: str, settings: Any, seed: int) -> dict[str, Any]:
    """Return what identifies the checkpoints of a run: everything except the number of iterations."""
    same = {key: value for key, value in dataclasses.asdict(settings).items() if key != "iterations"}
    if isinstance(getattr(settings, "features", None), Features):
        same["features"] = as_in_earlier_versions(same["features"])
    return {"experiment": name, "seed": seed, "settings": same}
