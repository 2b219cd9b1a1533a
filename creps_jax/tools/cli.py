"""Read the command line, `creps-jax play | export | session`, also `python -m creps_jax.tools`.

Nothing heavy is imported before it is clear that it is needed: help and mistakes are answered at once.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import FlagCreatePairsOff, arg, subcommand

from creps_jax.tools.command_line import answer, check_seed, say
from creps_jax.tools.process import import_mjx_quietly
from creps_jax.tools.session import commands
from creps_jax.tools.session.commands import SessionCommand

OVERVIEW = """\
Use a learned policy.

  creps-jax play --speed 0.3        show a walk at this speed: its parameters and a video
  creps-jax play                    show walks at six speeds side by side
  creps-jax export --to walk.h      write a policy (.onnx, .h) or one of its walks (.csv, .npz)
  creps-jax session                 learn on a real robot, trial by trial

Without --policy, play and export take the policy that was learned last, or else the one that comes with the
package; play prints where it is. A session needs --policy or --define.
Add --help to any of these for all its options.
"""

# Options that are left out are described in words, not as "None".
_Text = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
_Number = Annotated[float | None, arg(metavar="M/S", help_behavior_hint="")]
_Seconds = Annotated[float | None, arg(metavar="S", help_behavior_hint="")]
_Speeds = Annotated[tuple[float, ...], arg(metavar="[M/S ...]", help_behavior_hint="")]
_File = Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="")]


@dataclasses.dataclass(frozen=True)
class Play:
    """Show walks of a policy: what they reach, and a video with the walks side by side.

    Attributes:
        speed: Speeds in m/s; six over the policy's range by default.
        policy: Policy file; the latest learned or else the shipped one by default.
        robot: Whose policy; nao by default, or the one of the file.
        out: The .mp4 file.
        seed: Seed of the noise; 0 by default.
    """

    speed: _Speeds = ()
    policy: _File = None
    robot: _Text = None
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
    Annotated[Play, subcommand("play")]
    | Annotated[Export, subcommand("export")]
    | Annotated[SessionCommand, subcommand("session")]
)


def main(arguments: Sequence[str]) -> int:
    """Do what the arguments ask for and return the exit code, see `command_line.answer`."""
    if not arguments or list(arguments) in (["-h"], ["--help"], ["help"]):
        print(OVERVIEW, end="")
        return 0
    command = tyro.cli(Command, args=list(arguments), prog="creps-jax", config=(FlagCreatePairsOff,))  # type: ignore[arg-type]
    return answer(lambda: _HANDLERS[type(command)](command))


def _play(command: Play) -> int:
    check_seed(command.seed)
    import_mjx_quietly()
    from creps_jax.tools import play

    play.show(command.speed, command.policy, robot=command.robot, out=command.out, seed=command.seed, say=say)
    return 0


def _export(command: Export) -> int:
    from creps_jax.tools.export import export

    export(
        command.to,
        command.policy,
        robot=command.robot,
        speed=command.speed,
        duration=command.duration,
        say=say,
    )
    return 0


def _session(command: SessionCommand) -> int:
    commands.run(command, say=say)
    return 0


_HANDLERS = {Play: _play, Export: _export, SessionCommand: _session}
