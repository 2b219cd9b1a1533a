"""Let only one process at a time use a folder."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import filelock

from creps_jax.errors import UserError

LOCK = ".lock"
_PAUSE = 0.05


@contextlib.contextmanager
def locked(folder: Path, *, wait: float) -> Iterator[None]:
    """Hold the lock of a folder; a killed process releases it.

    Args:
        folder: an existing folder.
        wait: seconds to wait for other processes.

    Raises:
        UserError: if another process still holds the lock after that time.
        OSError: if the folder cannot be locked.
    """
    lock = filelock.FileLock(folder / LOCK, timeout=wait)
    try:
        lock.acquire(poll_interval=_PAUSE)
    except filelock.Timeout:
        raise UserError(f"{folder} is in use by another process, try again when it has ended") from None
    except NotImplementedError as error:
        raise OSError(f"the file system of {folder} has no locks") from error
    try:
        yield
    finally:
        lock.release()
