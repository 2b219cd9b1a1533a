"""What all command lines share: how a process starts, ends, and answers mistakes."""

import contextlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Never

from creps_jax.errors import UserError
from creps_jax.tools.process import keep_interrupts, prepare

INTERRUPTED = 130
"""The exit code of a command that Ctrl-C ended."""


def say(line: str) -> None:
    """Print a line at once, also into a pipe."""
    print(line, flush=True)


def answer(command: Callable[[], int]) -> int:
    """Run a command and return its exit code: 2 for a mistake, which is told in one line, 130 for Ctrl-C."""
    try:
        return command()
    except (UserError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except ValueError as error:
        # What the library refuses, such as a setting out of its range, is a mistake; anything else is a bug.
        if not _is_refused_by_the_library(error):
            raise
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED


def _is_refused_by_the_library(error: ValueError) -> bool:
    traceback = error.__traceback__
    while traceback is not None and traceback.tb_next is not None:
        traceback = traceback.tb_next
    if traceback is None:
        return False
    place, tools = Path(traceback.tb_frame.f_code.co_filename), Path(__file__).parent
    return place.is_relative_to(tools.parent) and not place.is_relative_to(tools)


def check_seed(seed: int | None) -> None:
    """Refuse a seed that no key can be made from.

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
        # Devices may still be at work, in Python if C steps the robot: to take Python down under it crashes.
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):  # the reader of a pipe may be gone
                stream.flush()
        os._exit(code)
    sys.exit(code)
