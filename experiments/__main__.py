"""Start the command line, once the process is set up for jax."""

import sys

from experiments.process import prepare

if __name__ == "__main__":
    prepare()
    from experiments.cli import main

    sys.exit(main(sys.argv[1:]))
