"""Read the command line, `python -m experiments list | run | plot | check | video | export | session`.

Nothing heavy is imported before it is clear that it is needed: help and mistakes are answered at once.
"""

import dataclasses
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, arg, subcommand

from experiments import registry
from experiments.errors import UserError
from experiments.process import import_mjx_quietly, join_processes
from experiments.session import commands
from experiments.session.commands import SessionCommand

OVERVIEW = """\
Learn, plot and check what the project can do.

  python -m experiments list                      the experiments by name
  python -m experiments run walk --preset quick   learn to walk, a few minutes
  python -m experiments run walk --speed 0.3      show the learned walk at a speed, in m/s
  python -m experiments run walk --robot nao_h25  learn it for the real NAO's figures
  python -m experiments run walk --resume         go on with the latest unfinished run
  python -m experiments run all                   the paper's Figures 5 to 9, half an hour
  python -m experiments plot walk                 draw the figures of the latest results again
  python -m experiments check                     hold the latest results against the paper
  python -m experiments video                     film a policy at several speeds
  python -m experiments export --to walk.h        write a policy (.onnx, .h) or a walk (.csv, .npz)
  python -m experiments session                   learn on a real robot, trial by trial

Results go to results/. Add --help to any of these for all its options.
"""


INTERRUPTED = 130
"""The exit code of a command that Ctrl-C ended."""

# Options that are left out are described in words, not as "None".
_Name = Annotated[str, arg(metavar="NAME")]
_Names = Annotated[tuple[str, ...], arg(metavar="[NAME ...]", help_behavior_hint="")]
_Text = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
_Integer = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
_Number = Annotated[float | None, arg(metavar="M/S", help_behavior_hint="")]
_Seconds = Annotated[float | None, arg(metavar="S", help_behavior_hint="")]
_Speeds = Annotated[tuple[float, ...], arg(metavar="[M/S ...]", help_behavior_hint="")]
_File = Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="")]


@dataclasses.dataclass(frozen=True)
class List:
    """List the experiments by name."""


@dataclasses.dataclass(frozen=True)
class Run:
    """Run an experiment; `python -m experiments list` names them.

    Attributes:
        name: The experiment, or "all" for the paper's Figures 5 to 9.
        preset: How thoroughly: quick, paper or best; each experiment's first one by default.
        iterations: Iterations of learning, in place of the preset's.
        trials: Trials with random keys of their own, in place of the preset's.
        seed: Seed of all random numbers; 0 by default.
        out: Result folder; a new one in results/ by default.
        resume: Go on with the run in the folder --out, or with the latest unfinished one.
        robot: Who walks: nao, or nao_h25, the real NAO's figures (walk only); nao by default.
        physics: What steps the robot: mjx, c, or auto: c on a CPU, elsewhere mjx (walks only).
        distributed: This is one of several processes, on one host or many, that share the run; see
            docs/several_machines.md.
        speed: Learn nothing and show one walk at this speed in m/s (walk only).
        policy: Policy file for --speed; the latest learned or else the shipped one by default.
    """

    name: Positional[_Name]
    preset: _Text = None
    iterations: _Integer = None
    trials: _Integer = None
    seed: _Integer = None
    out: _File = None
    resume: bool = False
    robot: _Text = None
    physics: _Text = None
    distributed: bool = False
    speed: _Number = None
    policy: _File = None


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


@dataclasses.dataclass(frozen=True)
class Video:
    """Film a walking policy at several speeds, side by side.

    Attributes:
        policy: Policy file; the latest learned or else the shipped one by default.
        robot: Whose policy; nao by default, or the one of the file.
        speeds: Speeds in m/s; six over the policy's range by default.
        out: The .mp4 file.
        seed: Seed of the noise; 0 by default.
    """

    policy: _File = None
    robot: _Text = None
    speeds: _Speeds = ()
    out: Path = Path("results/walk.mp4")
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class Export:
    """Write a policy, or the joint set-points of one of its walks, for use elsewhere.

    Attributes:
        to: The file. The policy becomes an ONNX model (.onnx) or a C header (.h); a walk, played from
            standstill and without posture feedback, becomes a table (.csv) or arrays (.npz).
        policy: Policy file; the latest learned or else the shipped one of walking by default.
        robot: Whose policy; nao by default, or the one of the file.
        speed: Speed of the walk in m/s (.csv and .npz only).
        duration: Length of the walk in s (.csv and .npz only); 8 by default.
    """

    to: Annotated[Path, arg(metavar="FILE")]
    policy: _File = None
    robot: _Text = None
    speed: _Number = None
    duration: _Seconds = None


Command = (
    Annotated[List, subcommand("list")]
    | Annotated[Run, subcommand("run")]
    | Annotated[Plot, subcommand("plot")]
    | Annotated[Check, subcommand("check")]
    | Annotated[Video, subcommand("video")]
    | Annotated[Export, subcommand("export")]
    | Annotated[SessionCommand, subcommand("session")]
)


def main(arguments: Sequence[str]) -> int:
    """Do what the arguments ask for and return the exit code: 2 for a mistake, 130 for an interrupt.

    What the file system refuses is told in one line as well, wherever it turns up.
    """
    if not arguments or list(arguments) in (["-h"], ["--help"], ["help"]):
        print(OVERVIEW, end="")
        return 0
    command = tyro.cli(
        Command, args=list(arguments), prog="python -m experiments", config=(FlagCreatePairsOff,)
    )  # type: ignore[arg-type]
    try:
        _check_seed(getattr(command, "seed", None))
        return _HANDLERS[type(command)](command)
    except (UserError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return INTERRUPTED


def _say(line: str) -> None:
    print(line, flush=True)


def _check_seed(seed: int | None) -> None:
    if seed is not None and not 0 <= seed < 2**32:
        raise UserError(f"seed must be from 0 to {2**32 - 1}, got {seed}")


def _list(_: List) -> int:
    width = max(map(len, registry.DESCRIPTIONS))
    every = {**registry.DESCRIPTIONS, registry.ALL: f"run {', '.join(registry.FIGURES)} (Figures 5 to 9)"}
    for name, description in every.items():
        print(f"{name:{width}}  {description}")
    return 0


def _run(command: Run) -> int:
    if command.name == registry.ALL:
        return _run_all(command)
    registry.check_name(command.name)
    if command.robot is not None and command.name != "walk":
        raise UserError(f"--robot goes with walk, not with {command.name}")
    if command.speed is not None:
        return _show(command, command.speed)
    if command.policy is not None:
        raise UserError("--policy goes with --speed")
    if command.distributed:
        join_processes()
    import_mjx_quietly()
    from rich.console import Console

    from experiments import runner

    asked = {name: getattr(command, name) for name in ("iterations", "trials", "robot", "physics")}
    request = runner.Request(
        name=command.name,
        preset=command.preset,
        seed=command.seed,
        overrides={name: value for name, value in asked.items() if value is not None},
        out=command.out,
        resume=command.resume,
    )
    # A run that is told to end saves what it has, as one that is interrupted does.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    runner.run(request, console=Console(highlight=False, soft_wrap=True), say=_say)
    return 0


def _run_all(command: Run) -> int:
    if command.resume or command.speed is not None:
        raise UserError("--resume and --speed go with one experiment, not with all")
    for name in registry.FIGURES:
        if command.preset is not None:
            registry.preset_settings(registry.load(name), command.preset)
        if command.out is not None and (command.out / name).exists():
            raise UserError(f"{command.out / name} is there already, name another folder")
    for name in registry.FIGURES:
        _run(dataclasses.replace(command, name=name, out=command.out and command.out / name))
    return 0


def _show(command: Run, speed: float) -> int:
    if command.name != "walk":
        raise UserError(f"--speed goes with walk, not with {command.name}")
    learning = {name: getattr(command, name) for name in ("preset", "iterations", "trials", "physics")}
    for name, value in {**learning, "resume": command.resume or None}.items():
        if value is not None:
            raise UserError(f"--{name} does not go with --speed, which learns nothing")
    import_mjx_quietly()
    from experiments import walking_policy

    walking_policy.show(
        speed, command.policy, robot=command.robot, out=command.out, seed=command.seed or 0, say=_say
    )
    return 0


def _plot(command: Plot) -> int:
    registry.check_name(command.name)
    import_mjx_quietly()
    from experiments import runner

    runner.plot(command.name, command.folder, say=_say)
    return 0


def _check(command: Check) -> int:
    for name in command.names:
        registry.check_name(name)
    import_mjx_quietly()
    from experiments import runner

    return 0 if runner.check(command.names, say=_say) else 1


def _video(command: Video) -> int:
    import_mjx_quietly()
    from experiments import walking_policy

    walking_policy.film(
        command.speeds, command.policy, robot=command.robot, out=command.out, seed=command.seed, say=_say
    )
    return 0


def _export(command: Export) -> int:
    from experiments.export import export

    export(
        command.to,
        command.policy,
        robot=command.robot,
        speed=command.speed,
        duration=command.duration,
        say=_say,
    )
    return 0


def _session(command: SessionCommand) -> int:
    commands.run(command, say=_say)
    return 0


_HANDLERS = {
    List: _list,
    Run: _run,
    Plot: _plot,
    Check: _check,
    Video: _video,
    Export: _export,
    SessionCommand: _session,
}
