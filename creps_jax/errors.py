"""Errors that a user can correct, in one line."""

import difflib
from collections.abc import Iterable

__all__ = ["UserError", "suggest"]


class UserError(ValueError):
    """A mistake that the user can correct: a file, a name or a setting. Commands print only its message."""


def suggest(name: str, known: Iterable[str], likely: Iterable[str] = ()) -> str:
    """Return the end of an error about an unknown name: the nearest known name, and all known names.

    A `likely` name is suggested before other known names.
    """
    known = list(known)
    near = difflib.get_close_matches(name, list(likely), n=1) or difflib.get_close_matches(name, known, n=1)
    hint = f", did you mean {near[0]!r}?" if near else ","
    return f"{hint} choose from: {', '.join(known)}"
