"""Keep a session in a folder that is always consistent, and is used by one process at a time."""

import contextlib
import dataclasses
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.policies.feature_settings import upgraded
from creps_jax.tools import folder_lock
from creps_jax.tools.session import plain
from creps_jax.tools.session.settings import Settings
from creps_jax.tools.session.trials import FORMAT, Record

SETTINGS = "settings.json"
TRIALS = "trials.json"


def create(folder: Path, settings: Settings) -> None:
    """Make the folder of a new session: completely, or not at all.

    Raises:
        UserError: if the folder exists already, or cannot be written.
    """
    if folder.exists():
        raise UserError(f"{folder} is there already, name a new folder")
    temporary: Path | None = None
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        files.save_text(temporary / SETTINGS, plain.to_text(dataclasses.asdict(settings)) + "\n")
        save_record(temporary, Record(settings=settings.digest()))
        (temporary / folder_lock.LOCK).touch()
        temporary.chmod(0o777 & ~files.umask())
        temporary.rename(folder)
        temporary = None
    except OSError as error:
        raise UserError(f"cannot make {folder}: {error.strerror or error}") from error
    finally:
        if temporary is not None:
            shutil.rmtree(temporary, ignore_errors=True)
    files.sync_folder(folder.parent)


def open_settings(folder: Path) -> Settings:
    """Read the settings of a session.

    Raises:
        UserError: if the folder holds no session.
    """
    if not (folder / SETTINGS).exists():
        raise UserError(f"{folder} holds no robot session: it has no {SETTINGS} (session new makes one)")
    values = upgraded(files.load_json(folder / SETTINGS))
    return plain.read(Settings, values, folder / SETTINGS)


def load_record(folder: Path, settings: Settings) -> Record:
    """Read the trials of a session; the file is never changed.

    Raises:
        UserError: if the file is missing, cut short, foreign, or was written with other settings.
    """
    path = folder / TRIALS
    values = files.load_json(path)
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise UserError(f"{path} holds no trials of a robot session (its format is not {FORMAT!r})")
    record = plain.read(Record, values, path)
    if not record.trials:
        # Until the first trial, users may edit the settings.
        return dataclasses.replace(record, settings=settings.digest())
    if record.settings != settings.digest():
        raise UserError(
            f"{folder / SETTINGS} is not what the trials were asked for with: put back what was changed, "
            "or begin a new session"
        )
    wanted = settings.context_names, settings.parameter_names, len(settings.parameters)
    for trial in record.trials:
        if (tuple(trial.context), tuple(trial.parameters), len(trial.theta)) != wanted:
            raise UserError(f"{path}: trial {trial.id} has other variables than {SETTINGS}")
    return record


def save_record(folder: Path, record: Record) -> None:
    """Write the trials of a session, atomically.

    Raises:
        UserError: if they cannot be written; the file then stays unchanged.
    """
    files.save_text(folder / TRIALS, plain.to_text(dataclasses.asdict(record)) + "\n")


@contextlib.contextmanager
def locked(folder: Path, *, wait: float) -> Iterator[None]:
    """Keep other processes from changing a session.

    Args:
        folder: the folder of the session.
        wait: seconds to wait for other processes.

    Raises:
        UserError: if another process still uses the folder after this time, or it cannot be locked.
    """
    with contextlib.ExitStack() as stack:
        try:
            stack.enter_context(folder_lock.locked(folder, wait=wait))
            # Files of processes that were killed while they wrote.
            for leftover in folder.glob(f".{TRIALS}.*.part"):
                leftover.unlink(missing_ok=True)
        except OSError as error:
            raise UserError(f"cannot lock {folder}: {error.strerror or error}") from error
        yield
