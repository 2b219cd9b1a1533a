"""Start the command line, once the process is set up for jax."""

import contextlib
import os
import sys

from experiments.process import keep_interrupts, prepare

if __name__ == "__main__":
    prepare()
    keep_interrupts()
    from experiments.cli import INTERRUPTED, main

    code = main(sys.argv[1:])
    if code == INTERRUPTED:
        # Devices may still be at work, in Python if C steps the robot: to take Python down under it crashes.
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError):  # the reader of a pipe may be gone
                stream.flush()
        os._exit(code)
    sys.exit(code)
