"""Start the command `creps-jax`."""

from typing import Never

from creps_jax.tools.command_line import start


def main() -> Never:
    """Run the command line of this process."""
    # The packages of the extra `tools` may be missing.
    try:
        from creps_jax.tools.cli import main
    except ModuleNotFoundError as error:
        raise SystemExit(
            f"error: creps-jax needs the package {error.name}: pip install 'creps_jax[tools]'"
        ) from None
    start(main)


if __name__ == "__main__":
    main()
