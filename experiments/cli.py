"""The command line `python -m experiments list | run | plot | check`.

The settings of an experiment are options of `run`: tyro makes them from the fields of their class.
"""

import argparse
import dataclasses
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg, subcommand

from creps_jax.errors import UserError
from creps_jax.tools.arguments import parse
from creps_jax.tools.command_line import answer, check_seed, say
from creps_jax.tools.process import import_mjx_quietly, join_processes
from experiments import registry

OVERVIEW = """\
Reproduce the figures and tables of the paper, and learn to walk.

  python -m experiments list                      list the experiments and their presets
  python -m experiments run walk --preset quick   learn to walk, two minutes
  python -m experiments run walk --robot nao_h25  learn to walk with the model of the real NAO H25
  python -m experiments run walk --robot k1.toml  learn to walk with a humanoid that a file describes
  python -m experiments run walk --resume         resume the latest unfinished run
  python -m experiments run walk --help           show all settings of an experiment
  python -m experiments run all                   run the paper's Figures 5 to 9, half an hour
  python -m experiments plot walk                 draw the figures of the latest results again
  python -m experiments check                     compare the latest results with the paper's claims

Results go to results/. Show a learned walk with `python -m creps_jax.tools play`.
"""

PROGRAM = "python -m experiments"

_ELSEWHERE = {"video": "play", "export": "export", "session": "session", "play": "play"}
"""Commands of `creps_jax.tools`, by the names under which users look for them here."""

# Defaults that are None are described in the help text.
_Name = Annotated[str, arg(metavar="NAME")]
_Names = Annotated[tuple[str, ...], arg(metavar="[NAME ...]", help_behavior_hint="")]
_Text = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
_Integer = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
_File = Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="")]


@dataclasses.dataclass(frozen=True)
class List:
    """List the experiments with their presets."""


@dataclasses.dataclass(frozen=True)
class Run:
    """Run an experiment; `run NAME --help` shows its settings, which are options too.

    Attributes:
        name: The experiment, or "all" for the paper's Figures 5 to 9.
        preset: Settings preset; by default the first one of the experiment, or `humanoid` for a robot that a
            file describes.
        config: The manifest.json of an earlier run: start from its settings and seed instead of a preset.
        seed: Seed of all random numbers; 0 by default.
        out: Result folder; a new one in results/ by default.
        resume: Resume the run in the folder --out, or the latest unfinished run.
        distributed: This process shares the run with others, on one host or many; see
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
    """Draw the figures of a result again.

    Attributes:
        name: The experiment.
        folder: Result folder; the latest finished one by default.
    """

    name: Positional[_Name]
    folder: _File = None


@dataclasses.dataclass(frozen=True)
class Check:
    """Compare the latest results with the paper's claims; exit code 1 if a claim does not hold.

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
    """Run the command of the arguments and return the exit code, see `command_line.answer`."""
    arguments = list(arguments)
    if not arguments or arguments in (["-h"], ["--help"], ["help"]):
        print(OVERVIEW, end="")
        return 0
    if arguments[0] in _ELSEWHERE:
        there = _ELSEWHERE[arguments[0]]
        why = f"{arguments[0]} is not a command here; use `python -m creps_jax.tools {there}`"
        return answer(lambda: _refuse(why))
    # The options depend on the experiment.
    if arguments[0] == "run" and len(arguments) > 1 and not arguments[1].startswith("-"):
        return answer(lambda: _run(arguments[1], arguments[2:]))
    return answer(lambda: _do(parse(Command, arguments, prog=PROGRAM)))


def _do(command: List | Run | Plot | Check) -> int:
    return _HANDLERS[type(command)](command)


def _refuse(why: str) -> int:
    raise UserError(why)


def _list(_: List) -> int:
    width = max(map(len, registry.EXPERIMENTS))
    for name, entry in registry.EXPERIMENTS.items():
        print(f"{name:{width}}  {entry.description}; presets: {', '.join(entry.presets)}")
    print(f"{registry.ALL:{width}}  run {', '.join(registry.FIGURES)} (Figures 5 to 9)")
    print("The first preset of an experiment is its default.")
    return 0


def _run(name: str, arguments: list[str]) -> int:
    if name != registry.ALL:
        registry.check_name(name)
    if any(word == "--speed" or word.startswith("--speed=") for word in arguments):
        raise UserError(
            "--speed is not a setting of an experiment; to show a walk: "
            "`python -m creps_jax.tools play --speed M/S`"
        )
    early = _early_options(arguments)
    if early.distributed and early.out is None:
        raise UserError("processes that share a run need --out, a folder that all of them see")
    if name == registry.ALL:
        _check_all(early)
    elif early.preset is not None:
        registry.check_preset(name, early.preset)
    if early.distributed:
        join_processes()
    if name != registry.ALL:
        return _run_one(name, arguments)
    for each in registry.FIGURES:
        # The last of two equal options is used.
        out = [] if early.out is None else ["--out", str(early.out / each)]
        code = _run_one(each, [*arguments, *out])
        if code:
            return code
    return 0


def _run_one(name: str, arguments: list[str]) -> int:
    """Run an experiment; processes that share the run have been joined."""
    early = _early_options(arguments)
    import_mjx_quietly()
    from rich.console import Console

    from creps_jax.tools.robots import is_spec, robot_id
    from experiments import runner
    from experiments.request import Request, default_settings, folder_to_resume

    experiment = registry.load(name)
    robot = early.robot and robot_id(early.robot)
    folder = folder_to_resume(name, early.out, robot) if early.resume else early.out
    preset = early.preset
    if name == "walk" and is_spec(robot or "") and not (preset or early.config or early.resume):
        preset = "humanoid"
    default = default_settings(
        experiment, name, preset=preset, config=early.config, out=folder, resume=early.resume
    )
    options, settings = _options_and_settings(experiment, name, arguments, default)
    check_seed(options.seed)
    request = Request(
        name=name,
        preset=preset,
        config=options.config,
        seed=options.seed,
        settings=settings,
        out=folder,
        resume=options.resume,
    )
    # A run that gets SIGTERM saves its state, as after Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    runner.run(request, console=Console(highlight=False, soft_wrap=True), say=say)
    return 0


def _early_options(arguments: list[str]) -> argparse.Namespace:
    """Parse the options that decide on the default settings; `parse` reports the mistakes."""
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
    both.__doc__ = f"{registry.EXPERIMENTS[name].description}\n\nAttributes:\n        preset:{attributes}"
    parsed = parse(both, arguments, prog=f"{PROGRAM} run {name}")
    options = {field: getattr(parsed, field) for field, _, _ in fields}
    return Run(name, **options), parsed.settings


def _check_all(early: argparse.Namespace) -> None:
    """Check the options of a run of all figures."""
    if early.resume or early.config is not None:
        raise UserError("--resume and --config go with one experiment, not with all")
    for name in registry.FIGURES:
        if early.preset is not None:
            registry.check_preset(name, early.preset)
        if early.out is not None and (early.out / name).exists():
            raise UserError(f"{early.out / name} exists already, name another folder")


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
    from experiments import claims

    return 0 if claims.check(command.names, say=say) else 1


def _name_is_late(_: Run) -> int:
    """Refuse a `run` whose first word is not the name of the experiment."""
    raise UserError(f"the name of the experiment comes first: run {' | '.join(registry.EXPERIMENTS)}")


_HANDLERS = {List: _list, Run: _name_is_late, Plot: _plot, Check: _check}
