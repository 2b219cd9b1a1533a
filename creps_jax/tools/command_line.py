"""Start a command line, report mistakes in one line, and end the process with an exit code."""

import contextlib
import errno
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Never

from creps_jax.errors import UserError
from creps_jax.tools.process import keep_interrupts, prepare

INTERRUPTED = 130
"""The exit code of a command that Ctrl-C ended."""
BROKEN_PIPE = 141
"""The exit code of a command whose output nobody reads any more."""


def say(line: str) -> None:
    """Print a line at once, also into a pipe."""
    print(line, flush=True)


def answer(command: Callable[[], int | None]) -> int:
    """Run a command and return its exit code: 2 after a mistake, which is reported in one line."""
    try:
        code = command()
        sys.stdout.flush()
        return code or 0
    except UserError as error:
        return _refuse(str(error))
    except BrokenPipeError:
        # The reader of the pipe has ended: as programs do that the system ends for this, say nothing.
        _drop_output()
        return BROKEN_PIPE
    except OSError as error:
        return _refuse(_reason(error))
    except ValueError as error:
        # A ValueError of the library, such as a setting out of its range, is a mistake; another one is a bug.
        if not _is_refused_by_the_library(error):
            raise
        return _refuse(str(error))
    except KeyboardInterrupt:
        return INTERRUPTED


def _refuse(message: str) -> int:
    print(f"error: {message}", file=sys.stderr)
    return 2


def _reason(error: OSError) -> str:
    """Return a sentence with the file and the reason of an error of the system."""
    reason = error.strerror or str(error)
    if error.filename is not None:
        return f"cannot use {error.filename}: {reason}"
    if error.errno == errno.ENOSPC:
        _drop_output()
        return f"cannot write to the standard output: {reason}"
    return reason


def _drop_output() -> None:
    """Drop text that is not printed yet: Python would try to print it again at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _is_refused_by_the_library(error: ValueError) -> bool:
    traceback = error.__traceback__
    while traceback is not None and traceback.tb_next is not None:
        traceback = traceback.tb_next
    if traceback is None:
        return False
    place, tools = Path(traceback.tb_frame.f_code.co_filename), Path(__file__).parent
    return place.is_relative_to(tools.parent) and not place.is_relative_to(tools)


def check_seed(seed: int | None) -> None:
    """Refuse a seed that jax cannot make a key from.

    Raises:
        UserError: if it is below zero or too large.
    """
    if seed is not None and not 0 <= seed < 2**32:
        raise UserError(f"seed must be from 0 to {2**32 - 1}, got {seed}")


def start(main: Callable[[Sequence[str]], int]) -> Never:
    """Set the process up for jax, run a command line, and end with its exit code."""
    prepare()
    keep_interrupts()
    code = main(sys.argv[1:])
    if code == INTERRUPTED:
        # Devices may still run callbacks in Python, if C steps the robot: ending Python normally would crash.
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):  # the reader of a pipe may be gone
                stream.flush()
        os._exit(code)
    sys.exit(code)
