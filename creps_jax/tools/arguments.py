"""Parse the arguments of a command; refuse what cannot be parsed in one line.

tyro parses. Its error messages are boxes of many lines: if it refuses the arguments, they are compared with
the fields of the command's class, to find the first mistake.
"""

import contextlib
import dataclasses
import difflib
import io
import math
import types
import typing
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import tyro

from creps_jax.errors import UserError, suggest

_NOUNS = {float: "a number", int: "a whole number", Path: "a path", str: "text"}


class _Argument(NamedTuple):
    """An argument of a command: "--kl-bound", or "NAME" for a positional one.

    Attributes:
        name: as users write it, or, of a positional argument, as the help shows it.
        kinds: types that a value may have; bool is a flag, which has no value.
        is_optional: whether "None" is a value, too.
        is_list: whether it takes any number of values.
        is_required: whether it has no default.
    """

    name: str
    kinds: tuple[type, ...]
    is_optional: bool
    is_list: bool
    is_required: bool

    @property
    def expected(self) -> str:
        """What a value must be."""
        return " or ".join(_NOUNS.get(kind, kind.__name__) for kind in self.kinds)

    @property
    def is_flag(self) -> bool:
        """Whether it has no value."""
        return self.kinds == (bool,)

    def accepts(self, value: str) -> bool:
        """Return whether a value has the right type."""
        if self.is_optional and value == "None":
            return True
        for kind in self.kinds:
            with contextlib.suppress(ValueError):
                kind(value)
                return True
        return False


def parse(kind: Any, arguments: Sequence[str], *, prog: str, default: Any = None) -> Any:
    """Parse the arguments of a command.

    Args:
        kind: a dataclass, or a union of dataclasses: one for each command.
        arguments: the words after the name of the program.
        prog: name of the program, and of the command if it is known already.
        default: values of all options that are left out, in place of the defaults of the class.

    Raises:
        UserError: for the first mistake in the arguments.
        SystemExit: once help is printed.
    """
    defaults = {} if default is None else {"default": default}
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(
                kind, args=list(arguments), prog=prog, config=(tyro.conf.FlagCreatePairsOff,), **defaults
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        refused = _refused_by_class(stop)
    found, prog = _mistake(kind, list(arguments), prog)
    mistake = found or refused or _in_one_line(errors.getvalue())
    raise UserError(f"{mistake}{' See' if mistake.endswith('?') else '; see'} `{prog} --help`")


def _refused_by_class(stop: BaseException) -> str | None:
    """Return why a dataclass refused its values; None if none did."""
    error: BaseException | None = stop
    while error is not None and not isinstance(error, UserError):
        error = error.__context__
    return None if error is None else str(error)


def _mistake(kind: Any, words: list[str], prog: str) -> tuple[str | None, str]:
    """Return the first mistake, None if it is not found, and the command whose help tells more."""
    commands = _commands(kind)
    if not commands:
        return _mistake_in_options(_arguments(kind), words), prog
    if not words:
        return f"a command must follow {prog}: {', '.join(commands)}", prog
    if words[0] not in commands:
        what = "option" if words[0].startswith("-") else "command"
        return f"unknown {what} {words[0]!r}{suggest(words[0], commands)}", prog
    return _mistake(commands[words[0]], words[1:], f"{prog} {words[0]}")


def _mistake_in_options(arguments: Sequence[_Argument], words: list[str]) -> str | None:
    options = {argument.name: argument for argument in arguments if argument.name.startswith("--")}
    positional = [argument for argument in arguments if argument.name not in options]
    found = set()
    while words:
        word = words.pop(0)
        if not _is_option(word):
            if not positional:
                return f"unexpected argument {word!r}"
            argument, values = positional[0], [word]
            if not argument.is_list:
                positional.pop(0)
        else:
            name, equals, value = word.partition("=")
            argument = options.get("--" + name[2:].replace("_", "-"))
            if argument is None:
                return f"unknown option {name}{_nearest(name, options)}"
            values = [value] if equals else _take_values(argument, words)
            if argument.is_flag and equals:
                return f"{argument.name} takes no value, got {value!r}"
            if not (values or argument.is_flag or argument.is_list):
                return f"{argument.name} must be {argument.expected}, got no value"
        found.add(argument.name)
        for value in values:
            if not argument.accepts(value):
                return f"{argument.name} must be {argument.expected}, got {value!r}"
    missing = [each.name for each in arguments if each.is_required and each.name not in found]
    return f"{missing[0]} is missing" if missing else None


def _is_option(word: str) -> bool:
    """Return whether a word is an option, and not a value such as "-1" or "-inf"."""
    return word.startswith("--") or (word.startswith("-") and word[1:2].isalpha() and not _is_number(word))


def _is_number(word: str) -> bool:
    with contextlib.suppress(ValueError):
        float(word)
        return True
    return False


def _take_values(argument: _Argument, words: list[str]) -> list[str]:
    """Remove the values of an option from the words that follow it, and return them."""
    values: list[str] = []
    most = 0 if argument.is_flag else math.inf if argument.is_list else 1
    while len(values) < most and words and not _is_option(words[0]):
        values.append(words.pop(0))
    return values


def _nearest(name: str, options: Mapping[str, object]) -> str:
    """Return a question about the nearest option: one that has the name as a part, or else a similar one."""
    stem = name.lstrip("-").replace("_", "-")
    with_part = [known for known in options if stem in known]
    near = with_part or difflib.get_close_matches(f"--{stem}", options, n=1)
    return f", did you mean {near[0]}?" if near and stem else ""


def _arguments(kind: Any, prefix: str = "") -> list[_Argument]:
    """List the arguments that the fields of a dataclass make, as tyro names them."""
    arguments = []
    for field in dataclasses.fields(kind):
        plain, marks = _split(field.type)
        names = [mark.name for mark in marks if getattr(mark, "name", None) is not None]
        name = names[0] if names else field.name
        if dataclasses.is_dataclass(plain):
            arguments += _arguments(plain, f"{prefix}{name}." if name else prefix)
            continue
        members = typing.get_args(plain) if isinstance(plain, types.UnionType) else (plain,)
        values = [each for each in members if each is not types.NoneType]
        is_list = any(typing.get_origin(each) is tuple for each in values)
        kinds = dict.fromkeys(
            typing.get_args(each)[0] if typing.get_origin(each) is tuple else each for each in values
        )
        shown = f"--{prefix}{name}".replace("_", "-")
        if tyro.conf.Positional in marks:
            shown = next(mark.metavar for mark in marks if getattr(mark, "metavar", None))
        is_required = field.default is field.default_factory is dataclasses.MISSING
        is_optional = len(values) < len(members)
        arguments.append(_Argument(shown, tuple(kinds), is_optional, is_list, is_required))
    return arguments


def _commands(kind: Any) -> dict[str, Any]:
    """Return the dataclasses of the commands that `kind` is a choice of, by name."""
    plain, _ = _split(kind)
    if dataclasses.is_dataclass(plain):
        # A command that has commands of its own has nothing else.
        fields = dataclasses.fields(plain)
        return _commands(fields[0].type) if len(fields) == 1 and _is_choice(fields[0].type) else {}
    return {
        next(mark.name for mark in marks if getattr(mark, "name", None)): command
        for command, marks in map(_split, typing.get_args(plain))
    }


def _is_choice(kind: Any) -> bool:
    plain, _ = _split(kind)
    return any(dataclasses.is_dataclass(_split(each)[0]) for each in typing.get_args(plain))


def _split(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return a type without its annotations, and these."""
    marks: tuple[Any, ...] = ()
    while typing.get_origin(kind) is Annotated:
        marks, kind = (*marks, *kind.__metadata__), typing.get_args(kind)[0]
    return kind, marks


def _in_one_line(text: str) -> str:
    """Return what tyro prints in a box as one line."""
    return " ".join("".join(" " if "─" <= char <= "╿" else char for char in text).split())
