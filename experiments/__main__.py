"""Start the command line `python -m experiments`."""

from creps_jax.tools.command_line import start

if __name__ == "__main__":
    from experiments.cli import main

    start(main)
