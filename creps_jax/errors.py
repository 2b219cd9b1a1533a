"""Tell users what is wrong, in one line."""

import difflib
from collections.abc import Iterable

__all__ = ["UserError", "suggest"]


class UserError(ValueError):
    """A mistake that the user can correct: a file, a name or a setting. Commands print its message alone."""


def suggest(name: str, known: Iterable[str]) -> str:
    """Return how an error about an unknown name goes on: with the nearest one, and all of them."""
    known = list(known)
    near = difflib.get_close_matches(name, known, n=1)
    hint = f", did you mean {near[0]!r}?" if near else ","
    return f"{hint} choose from: {', '.join(known)}"
