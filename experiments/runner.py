"""Run an experiment, resume it, and draw its figures again."""

import contextlib
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
from creps_jax.tools.tables import save_table
from experiments import claims, registry
from experiments.learning import Session
from experiments.request import Request, identity, resolved, resumed, started

Say = Callable[[str], None]


def run(request: Request, *, console: Console | None, say: Say) -> Path:
    """Run an experiment and fill its result folder.

    Args:
        request: what to run.
        console: where progress is shown; None shows nothing.
        say: prints one line.

    Returns:
        The result folder.

    Raises:
        UserError: for a mistake in the request, or a folder that cannot be used.
        KeyboardInterrupt: once the run is saved; the last line printed says how to resume it.
    """
    registry.check_name(request.name)
    experiment = registry.load(request.name)
    if jax.process_count() > 1 and request.out is None:
        raise UserError("processes that share a run need --out, a folder that all of them see")
    if jax.process_index() > 0:
        return _assist(experiment, request)
    settings, folder, manifest = (resumed if request.resume else started)(experiment, request)
    with _locked(folder):
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
    """Run or resume in a folder that no other process uses, and keep its manifest up to date."""
    name = manifest["experiment"]
    say(f"results go to {folder}")
    before, begin = manifest["seconds"], time.monotonic()

    def update(status: str) -> None:
        manifest.update(status=status, seconds=round(before + time.monotonic() - begin, 1))
        files.save_json(folder / results.MANIFEST, manifest)

    manifest["devices"] = [str(device) for device in jax.local_devices()]
    update("running")
    try:
        session = Session(folder, identity(name, settings, manifest["seed"]), console)
        arrays = experiment.run(settings, jax.random.key(manifest["seed"]), session)
        files.save_arrays(folder / results.ARRAYS, arrays)
        _draw(experiment, arrays, folder, say)
        if (table := getattr(experiment, "table", None)) is not None:
            save_table(table(arrays), folder, say)
        if (finish := getattr(experiment, "finish", None)) is not None:
            finish(settings, arrays, folder, say)
    except KeyboardInterrupt:
        update("interrupted")
        say(f"stopped; to resume: python -m experiments run {name} --resume --out {folder}")
        raise
    except Exception as error:
        update("failed")
        has_begun = any(folder.glob("checkpoint-*.npz"))
        if isinstance(error, ValueError) and before == 0.0 and not has_begun:
            # Settings were refused: without a folder, `--resume` still finds the last unfinished run.
            (folder / results.MANIFEST).unlink()
            with contextlib.suppress(OSError):
                (folder / folder_lock.LOCK).unlink(missing_ok=True)
                folder.rmdir()
        raise
    update("finished")
    if results.robot_of(manifest) == registry.PAPER_ROBOT:
        claims.save(experiment, manifest, arrays, folder)
    say(f"finished in {manifest['seconds']:.0f} s: {folder}")
    return folder


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep a second process from resuming a run that is still running, if the file system has locks."""
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        # Some shared file systems have no locks.
        with contextlib.suppress(OSError):
            stack.enter_context(folder_lock.locked(folder, wait=0.0))
            # Removed before it is released: the folder then holds nothing but results.
            stack.callback((folder / folder_lock.LOCK).unlink, missing_ok=True)
        yield


def _assist(experiment: registry.Experiment, request: Request) -> Path:
    """Share the run of the first process, the only one that writes files and prints."""
    if request.resume:
        settings, folder, manifest = resumed(experiment, request)
        seed = manifest["seed"]
    else:
        # The first process makes the folder, at the same time: it may exist already.
        (settings, seed), folder = resolved(request), None
    session = Session(folder, identity(request.name, settings, seed), is_keeper=False)
    experiment.run(settings, jax.random.key(seed), session)
    return request.out or Path()


def plot(name: str, folder: Path | None, *, say: Say) -> Path:
    """Draw the figures of a result folder again, by default of the latest one, and return the folder.

    Raises:
        UserError: if there are no results, or they belong to another experiment.
    """
    experiment = registry.load(name)
    folder = folder or _latest_finished(name)
    found = results.load_manifest(folder).get("experiment")
    if found != name:
        raise UserError(f"{folder} must hold results of {name}, got {found}")
    with results.complete(folder):
        _draw(experiment, files.load_arrays(folder / results.ARRAYS), folder, say)
    return folder


def _draw(experiment: registry.Experiment, arrays: Mapping[str, np.ndarray], folder: Path, say: Say) -> None:
    for name, figure in experiment.plot(arrays).items():
        plots.save_figure(folder / f"{name}.png", figure)
        say(f"figure: {folder / name}.png")


def _latest_finished(name: str) -> Path:
    folder = results.latest_folder(name, status="finished")
    if folder is None:
        raise UserError(f"there are no results of {name} in {results.default_root()}; run it first")
    return folder
