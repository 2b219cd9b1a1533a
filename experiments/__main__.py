"""Start the command line, once the process is set up for jax."""

import os
import sys

from experiments.process import prepare

if __name__ == "__main__":
    prepare()
    from experiments.cli import INTERRUPTED, main

    code = main(sys.argv[1:])
    if code == INTERRUPTED:
        # Devices may still be at work, in Python if C steps the robot: to take Python down under it crashes.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
