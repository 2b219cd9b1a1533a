"""Run an experiment into a result folder, go on with one, draw its figures again, check its claims."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.tools import folder_lock, plots, results
from creps_jax.tools.command_line import check_seed
from creps_jax.tools.session import plain
from creps_jax.tools.tables import to_markdown
from experiments import registry
from experiments.learning import Session

Say = Callable[[str], None]

_MOST = {"iterations": 1_000_000, "trials": 1_000}
"""What a run can hold in memory, by setting."""

_PAPERS_ROBOT = "nao"
"""Whose walks are held against the paper's."""


@dataclasses.dataclass(frozen=True)
class Request:
    """What to run.

    Attributes:
        name: the experiment.
        settings: all its settings, see `default_settings`.
        preset: the name of the preset that they began with; None is the experiment's first one, or of a run
            that is resumed its own.
        config: the manifest that they began with, in place of a preset.
        seed: seed of the random key; None is that of `config` or of the run that is resumed, or else 0.
        out: the result folder; None is a new one.
        resume: whether to go on with the run in `out`, see `folder_to_resume`.
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

    Those of the run to resume, or of a manifest, or of a preset, by default the experiment's first one.

    Raises:
        UserError: if there is none of these, or more than one is asked for.
    """
    if config is not None and (preset is not None or resume):
        raise UserError("--config names all settings of a run: it does not go with --preset and --resume")
    if resume:
        folder = folder_to_resume(name, out)
        return _settings_of(experiment, folder, results.load_manifest(folder))
    if config is not None:
        manifest = results.load_manifest_file(config)
        if manifest.get("experiment") != name:
            raise UserError(f"{config} is of {manifest.get('experiment')!r}, expected {name!r}")
        return _settings_of(experiment, config, manifest)
    return registry.preset_settings(experiment, preset or next(iter(experiment.SETTINGS)))


def folder_to_resume(name: str, out: Path | None, robot: str | None = None) -> Path:
    """Return the folder of a run to go on with: the named one, or that of the latest unfinished run.

    Args:
        name: the experiment.
        out: the named folder.
        robot: whose run; None is anyone's.

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


def run(request: Request, *, console: Console | None, say: Say) -> Path:
    """Run an experiment and fill its result folder.

    Args:
        request: what to run.
        console: where progress is shown; None shows nothing.
        say: told one line at a time what was done.

    Returns:
        The result folder.

    Raises:
        UserError: for a mistake in the request, or a folder that cannot be used.
        KeyboardInterrupt: once what is needed to go on is saved, and `say` was told how to.
    """
    registry.check_name(request.name)
    experiment = registry.load(request.name)
    if jax.process_count() > 1 and request.out is None:
        raise UserError("processes that share a run need --out, a folder that all of them see")
    if jax.process_index() > 0:
        return _help(experiment, request)
    settings, folder, manifest = (_resumed if request.resume else _started)(experiment, request)
    with _for_itself(folder):
        return _run(experiment, settings, folder, manifest, console=console, say=say)


def _run(
    experiment: registry.Experiment,
    settings: Any,
    folder: Path,
    manifest: dict[str, Any],
    *,
    console: Console | None,
    say: Say,
) -> Path:
    """Run, or go on, in a folder that no other process uses, and keep its manifest up to date."""
    name = manifest["experiment"]
    say(f"results go to {folder}")
    before, begin = manifest["seconds"], time.monotonic()

    def update(status: str) -> None:
        manifest.update(status=status, seconds=round(before + time.monotonic() - begin, 1))
        files.save_json(folder / results.MANIFEST, manifest)

    manifest["devices"] = [str(device) for device in jax.local_devices()]
    update("running")
    try:
        session = Session(folder, _identity(name, settings, manifest["seed"]), console)
        arrays = experiment.run(settings, jax.random.key(manifest["seed"]), session)
        files.save_arrays(folder / results.ARRAYS, arrays)
        _draw(experiment, arrays, folder, say)
        if hasattr(experiment, "finish"):
            experiment.finish(settings, arrays, folder, say)  # type: ignore[attr-defined]
    except KeyboardInterrupt:
        update("interrupted")
        say(f"stopped; to go on: python -m experiments run {name} --resume --out {folder}")
        raise
    except Exception as error:
        update("failed")
        has_begun = any(folder.glob("checkpoint-*.npz"))
        if isinstance(error, ValueError) and before == 0.0 and not has_begun:
            # Settings were refused: there is nothing to go on from, and no earlier run is to be hidden by it.
            (folder / results.MANIFEST).unlink()
            with contextlib.suppress(OSError):
                (folder / folder_lock.LOCK).unlink(missing_ok=True)
                folder.rmdir()
        raise
    update("finished")
    if results.robot_of(manifest) == _PAPERS_ROBOT:
        _save_claims(experiment, arrays, folder)
    say(f"finished in {manifest['seconds']:.0f} s: {folder}")
    return folder


@contextlib.contextmanager
def _for_itself(folder: Path) -> Iterator[None]:
    """Keep a second process from going on with a run that is still running, where folders can be locked."""
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        # Some shared file systems know no locks.
        with contextlib.suppress(OSError):
            stack.enter_context(folder_lock.locked(folder, wait=0.0))
            # While it is still held: a run leaves nothing but its results.
            stack.callback((folder / folder_lock.LOCK).unlink, missing_ok=True)
        yield


def _help(experiment: registry.Experiment, request: Request) -> Path:
    """Share the run of the first process, which alone writes and speaks."""
    if request.resume:
        settings, folder, manifest = _resumed(experiment, request)
        seed = manifest["seed"]
    else:
        # The first process makes the folder: whether it is there yet says nothing.
        (settings, seed), folder = _resolved(request), None
    session = Session(folder, _identity(request.name, settings, seed), is_keeper=False)
    experiment.run(settings, jax.random.key(seed), session)
    return request.out or Path()


def plot(name: str, folder: Path | None, *, say: Say) -> Path:
    """Draw the figures of a result folder again, by default of the latest one, and return the folder.

    Raises:
        UserError: if there are no results to draw, or they are those of another experiment.
    """
    experiment = registry.load(name)
    folder = folder or _latest_finished(name)
    found = results.load_manifest(folder).get("experiment")
    if found != name:
        raise UserError(f"{folder} holds results of {found}, expected those of {name}")
    with _whole_results(folder):
        _draw(experiment, files.load_arrays(folder / results.ARRAYS), folder, say)
    return folder


def check(names: tuple[str, ...], *, say: Say) -> bool:
    """Hold the claims of experiments against their latest results, and return whether all hold.

    An experiment without results makes no claim; it is named.
    """
    all_hold = True
    for name in names or tuple(registry.DESCRIPTIONS):
        registry.check_name(name)
        folder = results.latest_folder(name, status="finished", robot=_PAPERS_ROBOT)
        if folder is None:
            say(f"{name}: no results yet (python -m experiments run {name})\n")
            continue
        with _whole_results(folder):
            rows = claim_rows(registry.load(name), files.load_arrays(folder / results.ARRAYS))
        all_hold &= all(row["holds"] for row in rows)
        say(f"{name}: {folder}\n\n{_claims_table(rows)}")
    return all_hold


def claim_rows(experiment: registry.Experiment, arrays: Mapping[str, np.ndarray]) -> list[dict[str, Any]]:
    """Measure each claim of an experiment on its arrays."""
    rows = []
    for claim in experiment.CLAIMS:
        ours = float(claim.measure(arrays))
        rows.append({**claim._asdict(), "ours": ours, "holds": bool(claim.low <= ours <= claim.high)})
        del rows[-1]["measure"]
    return rows


def _started(experiment: registry.Experiment, request: Request) -> tuple[Any, Path, dict[str, Any]]:
    """Return settings, an empty result folder and a manifest for a run from the beginning."""
    settings, seed = _resolved(request)
    preset = request.preset or ("config" if request.config else next(iter(experiment.SETTINGS)))
    folder = request.out
    if folder is None:
        folder = results.new_folder(results.default_root() / request.name, f"{results.stamp()}-{preset}")
    elif (folder / results.MANIFEST).exists():
        raise UserError(
            f"{folder} holds a run already: add --resume to go on with it, or name another folder"
        )
    elif folder.exists() and not folder.is_dir():
        raise UserError(f"{folder} is a file, expected a folder")
    elif folder.exists() and (foreign := [p.name for p in folder.iterdir() if not p.name.startswith(".")]):
        # What is there might have the names of what a run writes.
        raise UserError(f"{folder} holds files of something else, {min(foreign)} for one: name a new folder")
    return settings, folder, results.make_manifest(request.name, preset, settings, seed)


def _resolved(request: Request) -> tuple[Any, int]:
    """Return settings and seed of a run from the beginning.

    What they leave to defaults or to the machine is decided here, so that the run, when it is resumed
    elsewhere or by another version, goes on with the same.
    """
    settings, seed = request.settings, request.seed
    _check_counts(settings)
    if seed is None and request.config is not None:
        seed = results.load_manifest_file(request.config).get("seed")
        if not isinstance(seed, int):
            raise UserError(f"{request.config} must have a whole number as seed, got {seed!r}")
        check_seed(seed)
    return settings.resolved() if hasattr(settings, "resolved") else settings, seed or 0


def _resumed(experiment: registry.Experiment, request: Request) -> tuple[Any, Path, dict[str, Any]]:
    """Return settings, folder and manifest of a run to go on with."""
    folder = folder_to_resume(request.name, request.out)
    manifest = results.load_manifest(folder)
    for field, kind in (("seed", int), ("seconds", float | int)):
        if not isinstance(manifest.get(field), kind):
            raise UserError(
                f"{folder} has no {field} in its manifest, expected a number: it cannot be resumed"
            )
    before = _settings_of(experiment, folder, manifest)
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


def _settings_of(experiment: registry.Experiment, path: Path, manifest: Mapping[str, Any]) -> Any:
    """Return the settings that a manifest holds."""
    try:
        return plain.read(experiment.Settings, manifest["settings"], "settings")
    except UserError as error:
        raise UserError(f"{path} was made with other settings than this version has: {error}") from error


def _check_counts(settings: Any) -> None:
    """Refuse numbers of something that are below 1, or more than a run can hold."""
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


def _identity(name: str, settings: Any, seed: int) -> dict[str, Any]:
    """Return what has to agree for a checkpoint to belong to a run: all but how long it goes on."""
    same = {key: value for key, value in dataclasses.asdict(settings).items() if key != "iterations"}
    # Checkpoints from before there was a choice of robots, or of a first policy, do not name one.
    for setting, default in (("robot", _PAPERS_ROBOT), ("start_policy", None)):
        if setting in same and same[setting] == default:
            del same[setting]
    return {"experiment": name, "seed": seed, "settings": same}


def _draw(experiment: registry.Experiment, arrays: Mapping[str, np.ndarray], folder: Path, say: Say) -> None:
    for name, figure in experiment.plot(arrays).items():
        plots.save_figure(folder / f"{name}.png", figure)
        say(f"figure: {folder / name}.png")


def _save_claims(experiment: registry.Experiment, arrays: Mapping[str, np.ndarray], folder: Path) -> None:
    if experiment.CLAIMS:
        files.save_text(folder / "claims.md", _claims_table(claim_rows(experiment, arrays)))


def _claims_table(rows: list[dict[str, Any]]) -> str:
    def number(value: float | None) -> str:
        return "-" if value is None or not np.isfinite(value) else f"{value:.4g}"

    columns = {
        "metric": [row["metric"] for row in rows],
        "paper": [number(row["paper"]) for row in rows],
        "ours": [number(row["ours"]) for row in rows],
        "at least": [number(row["low"]) for row in rows],
        "at most": [number(row["high"]) for row in rows],
        "holds": ["yes" if row["holds"] else "NO" for row in rows],
    }
    return to_markdown(columns)


@contextlib.contextmanager
def _whole_results(folder: Path) -> Iterator[None]:
    """Name arrays that results lack, of another version for example, as the user's to mend."""
    try:
        yield
    except KeyError as error:
        raise UserError(
            f"{folder / results.ARRAYS} lacks {error}: it is of another version or experiment"
        ) from error


def _latest_finished(name: str) -> Path:
    folder = results.latest_folder(name, status="finished")
    if folder is None:
        raise UserError(f"there are no results of {name} in {results.default_root()}; run it first")
    return folder
