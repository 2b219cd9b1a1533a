"""Read the command line, `python -m experiments list | run | plot | check`.

The settings of an experiment are options of `run`: tyro reads their class.
"""

import argparse
import dataclasses
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, arg, subcommand

from creps_jax.errors import UserError
from creps_jax.tools.command_line import answer, check_seed, say
from creps_jax.tools.process import import_mjx_quietly, join_processes
from experiments import registry

OVERVIEW = """\
Reproduce the figures and tables of the paper, and learn to walk.

  python -m experiments list                      the experiments by name
  python -m experiments run walk --preset quick   learn to walk, a few minutes
  python -m experiments run walk --robot nao_h25  learn it for the real NAO's figures
  python -m experiments run walk --resume         go on with the latest unfinished run
  python -m experiments run walk --help           all settings of an experiment
  python -m experiments run all                   the paper's Figures 5 to 9, half an hour
  python -m experiments plot walk                 draw the figures of the latest results again
  python -m experiments check                     hold the latest results against the paper

Results go to results/. What was learned is shown by `python -m creps_jax.tools play`.
"""

_ELSEWHERE = {"video": "play", "export": "export", "session": "session", "play": "play"}
"""Commands that people look for here, and what they are called in `creps_jax.tools`."""

# Options that are left out are described in words, not as "None".
_Name = Annotated[str, arg(metavar="NAME")]
_Names = Annotated[tuple[str, ...], arg(metavar="[NAME ...]", help_behavior_hint="")]
_Text = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
_Integer = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
_File = Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="")]


@dataclasses.dataclass(frozen=True)
class List:
    """List the experiments by name."""


@dataclasses.dataclass(frozen=True)
class Run:
    """Run an experiment; `run NAME --help` shows its settings, which are options too.

    Attributes:
        name: The experiment, or "all" for the paper's Figures 5 to 9.
        preset: Settings to begin with; each experiment's first preset by default.
        config: The manifest.json of an earlier run, whose settings and seed to begin with instead.
        seed: Seed of all random numbers; 0 by default.
        out: Result folder; a new one in results/ by default.
        resume: Go on with the run in the folder --out, or with the latest unfinished one.
        distributed: This is one of several processes, on one host or many, that share the run; see
            docs/several_machines.md.
    """

    name: Positional[_Name]
    preset: _Text = None
    config: _File = None
    seed: _Integer = None
    out: _File = None
    resume: bool = False
    distributed: bool = False


@dataclasses.dataclass(frozen=True)
class Plot:
    """Draw the figures of results again.

    Attributes:
        name: The experiment.
        folder: Result folder; the latest finished one by default.
    """

    name: Positional[_Name]
    folder: _File = None


@dataclasses.dataclass(frozen=True)
class Check:
    """Hold the latest results against the paper's; exit code 1 if a claim fails.

    Attributes:
        names: The experiments; all by default.
    """

    names: Positional[_Names] = ()


Command = (
    Annotated[List, subcommand("list")]
    | Annotated[Run, subcommand("run")]
    | Annotated[Plot, subcommand("plot")]
    | Annotated[Check, subcommand("check")]
)


def main(arguments: Sequence[str]) -> int:
    """Do what the arguments ask for and return the exit code, see `command_line.answer`."""
    arguments = list(arguments)
    if not arguments or arguments in (["-h"], ["--help"], ["help"]):
        print(OVERVIEW, end="")
        return 0
    if arguments[0] in _ELSEWHERE:
        there = _ELSEWHERE[arguments[0]]
        return answer(lambda: _refuse(f"{arguments[0]} is a command of `python -m creps_jax.tools {there}`"))
    # What an experiment's settings are is known once it is named.
    if arguments[0] == "run" and len(arguments) > 1 and not arguments[1].startswith("-"):
        return answer(lambda: _run(arguments[1], arguments[2:]))
    command = _parse(Command, arguments)
    return answer(lambda: _HANDLERS[type(command)](command))


def _parse(kind: Any, arguments: Sequence[str], *, prog: str = "", default: Any = None) -> Any:
    return tyro.cli(
        kind,
        args=list(arguments),
        prog=f"python -m experiments{prog}",
        config=(FlagCreatePairsOff,),
        **({} if default is None else {"default": default}),
    )


def _refuse(why: str) -> int:
    raise UserError(why)


def _list(_: List) -> int:
    width = max(map(len, registry.DESCRIPTIONS))
    every = {**registry.DESCRIPTIONS, registry.ALL: f"run {', '.join(registry.FIGURES)} (Figures 5 to 9)"}
    for name, description in every.items():
        print(f"{name:{width}}  {description}")
    return 0


def _run(name: str, arguments: list[str]) -> int:
    if name == registry.ALL:
        return _run_all(arguments)
    registry.check_name(name)
    if any(word == "--speed" or word.startswith("--speed=") for word in arguments):
        raise UserError(
            "--speed is no setting of an experiment; to watch a walk: "
            "`python -m creps_jax.tools play --speed M/S`"
        )
    early = _early_options(arguments)
    if early.distributed:
        if early.out is None:
            raise UserError("processes that share a run need --out, a folder that all of them see")
        join_processes()
    import_mjx_quietly()
    from rich.console import Console

    from experiments import runner

    experiment = registry.load(name)
    folder = runner.folder_to_resume(name, early.out, early.robot) if early.resume else early.out
    default = runner.default_settings(
        experiment, name, preset=early.preset, config=early.config, out=folder, resume=early.resume
    )
    options, settings = _options_and_settings(experiment, name, arguments, default)
    check_seed(options.seed)
    request = runner.Request(
        name=name,
        preset=options.preset,
        config=options.config,
        seed=options.seed,
        settings=settings,
        out=folder,
        resume=options.resume,
    )
    # A run that is told to end saves what it has, as one that is interrupted does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    runner.run(request, console=Console(highlight=False, soft_wrap=True), say=say)
    return 0


def _early_options(arguments: list[str]) -> argparse.Namespace:
    """Read what decides which settings the others change; mistakes are left to the parser of them all."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    for name in ("config", "out"):
        parser.add_argument(f"--{name}", type=Path)
    for name in ("preset", "robot"):
        parser.add_argument(f"--{name}")
    for name in ("resume", "distributed"):
        parser.add_argument(f"--{name}", action="store_true")
    try:
        return parser.parse_known_args(arguments)[0]
    except argparse.ArgumentError:  # a value is missing
        return parser.parse_args([])


def _options_and_settings(
    experiment: registry.Experiment, name: str, arguments: list[str], default: Any
) -> tuple[Run, Any]:
    """Parse the options of a run together with the settings of its experiment."""
    fields = [(field.name, field.type, field) for field in dataclasses.fields(Run) if field.name != "name"]
    both = dataclasses.make_dataclass(
        "RunWithSettings",
        [
            *((field, kind, dataclasses.field(default=each.default)) for field, kind, each in fields),
            ("settings", Annotated[experiment.Settings, arg(name="")], dataclasses.field(default=default)),
        ],
        frozen=True,
    )
    attributes = (Run.__doc__ or "").partition("Attributes:")[2].partition("preset:")[2]
    both.__doc__ = f"{registry.DESCRIPTIONS[name]}\n\nAttributes:\n        preset:{attributes}"
    parsed = _parse(both, arguments, prog=f" run {name}")
    options = {field: getattr(parsed, field) for field, _, _ in fields}
    return Run(name, **options), parsed.settings


def _run_all(arguments: list[str]) -> int:
    early = _early_options(arguments)
    if early.resume or early.config is not None:
        raise UserError("--resume and --config go with one experiment, not with all")
    for name in registry.FIGURES:
        if early.preset is not None:
            registry.preset_settings(registry.load(name), early.preset)
        if early.out is not None and (early.out / name).exists():
            raise UserError(f"{early.out / name} is there already, name another folder")
    for name in registry.FIGURES:
        # The last of two equal options counts.
        out = [] if early.out is None else ["--out", str(early.out / name)]
        code = _run(name, [*arguments, *out])
        if code:
            return code
    return 0


def _plot(command: Plot) -> int:
    registry.check_name(command.name)
    import_mjx_quietly()
    from experiments import runner

    runner.plot(command.name, command.folder, say=say)
    return 0


def _check(command: Check) -> int:
    for name in command.names:
        registry.check_name(name)
    import_mjx_quietly()
    from experiments import runner

    return 0 if runner.check(command.names, say=say) else 1


def _named_by_option(command: Run) -> int:
    """Answer a `run` whose first word is no name: the name may come last."""
    del command
    raise UserError(f"the name of the experiment comes first: run {' | '.join(registry.DESCRIPTIONS)}")


_HANDLERS = {List: _list, Run: _named_by_option, Plot: _plot, Check: _check}
