"""Keep a folder to one process at a time."""

import contextlib
import fcntl
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from experiments.errors import UserError

LOCK = ".lock"
_PAUSE = 0.05


@contextlib.contextmanager
def locked(folder: Path, *, wait: float) -> Iterator[None]:
    """Keep other processes that ask for the lock out of a folder; a process that dies gives it back.

    Args:
        folder: a folder that is there.
        wait: seconds to wait for others.

    Raises:
        UserError: if another process still has it then.
        OSError: if the folder cannot be locked.
    """
    deadline = time.monotonic() + wait
    with (folder / LOCK).open("a") as handle:
        while not _try_lock(handle):
            if time.monotonic() >= deadline:
                raise UserError(f"{folder} is in use by another process, try again when it is done")
            time.sleep(_PAUSE)
        yield


def _try_lock(handle: TextIO) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
