"""Mistakes in the arguments of both command lines: one line, with the nearest right name, and exit code 2."""

import dataclasses
from typing import Annotated

import pytest
from tyro.conf import Positional, arg, subcommand

from creps_jax.errors import UserError
from creps_jax.tools import cli
from creps_jax.tools.arguments import parse
from experiments import cli as experiments


@dataclasses.dataclass(frozen=True)
class Inner:
    kind: str = "rbf"
    num_centers: int = 5
    widths: int | tuple[int, ...] | None = None
    gain: float | None = None


@dataclasses.dataclass(frozen=True)
class Learn:
    """Learn.

    Attributes:
        name: Name.
        kl_bound: Bound.
    """

    name: Positional[Annotated[str, arg(metavar="NAME")]]
    kl_bound: float | None = 0.5
    sizes: tuple[int, ...] = (1, 2)
    resume: bool = False
    inner: Inner = Inner()
    iterations: int = 3

    def __post_init__(self):
        if self.iterations < 1:
            raise UserError(f"iterations must be at least 1, got {self.iterations}")


@dataclasses.dataclass(frozen=True)
class Save:
    """Save."""

    to: str


COMMANDS = Annotated[Learn, subcommand("learn")] | Annotated[Save, subcommand("save")]


def test_what_is_right_is_parsed():
    found = parse(COMMANDS, ["learn", "x", "--kl_bound", "-1e-3", "--sizes", "3", "4", "--resume"], prog="p")
    assert found == Learn("x", -1e-3, (3, 4), True)
    assert parse(COMMANDS, ["learn", "x", "--kl-bound", "None"], prog="p").kl_bound is None
    assert parse(Learn, ["x"], prog="p", default=Learn("y", 2.0)) == Learn("x", 2.0)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("learn x --kl_bond 1", "unknown option --kl_bond, did you mean --kl-bound? See `p learn --help`"),
        ("learn x --kl-bond=1", "unknown option --kl-bond, did you mean --kl-bound? See"),
        ("learn x --kind a", "unknown option --kind, did you mean --inner.kind? See"),
        ("learn x --zzzzz", "unknown option --zzzzz; see `p learn --help`"),
        ("learn x -k 1", "unknown option -k"),
        ("learn x --kl-bound abc", "--kl-bound must be a number, got 'abc'; see `p learn --help`"),
        ("learn x --kl-bound=abc", "--kl-bound must be a number, got 'abc'"),
        ("learn x --kl-bound", "--kl-bound must be a number, got no value"),
        ("learn x --kl-bound --resume", "--kl-bound must be a number, got no value"),
        ("learn x --inner.num-centers 2.5", "--inner.num-centers must be a whole number, got '2.5'"),
        ("learn x --inner.widths 5 3 --kl-bond 1", "unknown option --kl-bond, did you mean --kl-bound? See"),
        ("learn x --inner.widths None --kl-bond 1", "unknown option --kl-bond, did you mean --kl-bound? See"),
        ("learn x --inner.widths 5 a", "--inner.widths must be a whole number, got 'a'; see"),
        ("learn x --inner.gain a", "--inner.gain must be a number, got 'a'; see"),
        ("learn x --sizes 1 a", "--sizes must be a whole number, got 'a'"),
        ("learn x --resume=1", "--resume takes no value, got '1'"),
        ("learn x y", "unexpected argument 'y'"),
        ("learn --resume", "NAME is missing"),
        ("learn x --iterations 0", "iterations must be at least 1, got 0"),
        ("save", "--to is missing; see `p save --help`"),
        ("sav", "unknown command 'sav', did you mean 'save'? choose from: learn, save; see `p --help`"),
        ("--foo", "unknown option '--foo', choose from: learn, save; see"),
        ("", "a command must follow p: learn, save; see"),
    ],
)
def test_a_mistake_is_one_line(capsys, words, message):
    with pytest.raises(UserError) as caught:
        parse(COMMANDS, words.split(), prog="p")
    assert str(caught.value).startswith(message) and "--help`" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert capsys.readouterr() == ("", "")


def test_a_mistake_that_is_not_found_is_one_line_too(monkeypatch):
    monkeypatch.setattr("creps_jax.tools.arguments._mistake_in_options", lambda *_: None)
    with pytest.raises(UserError) as caught:
        parse(Learn, ["x", "--kl-bound"], prog="p")
    assert str(caught.value).startswith("Missing argument Missing value for argument '--kl-bound'")
    assert "\n" not in str(caught.value) and "│" not in str(caught.value)


@pytest.mark.parametrize(
    ("main", "words"),
    [
        (cli.main, "play"),
        (cli.main, "export"),
        (cli.main, "session"),
        *((cli.main, f"session {name}") for name in ("new", "ask", "tell", "status", "save")),
        *((experiments.main, name) for name in ("list", "run", "plot", "check")),
    ],
)
def test_every_command_refuses_an_unknown_option_in_one_line(capsys, main, words):
    assert main([*words.split(), "--sped", "1"]) == 2
    out, error = capsys.readouterr()
    name = "creps-jax" if main is cli.main else "python -m experiments"
    assert out == "" and len(error.splitlines()) == 1
    # `run` expects the name of an experiment first.
    assert ("unknown option" in error and f"`{name} {words} --help`" in error) or words == "run"
