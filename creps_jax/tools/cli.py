"""The command line `creps-jax play | drive | robot | export | session`, also `python -m creps_jax.tools`.

jax and MuJoCo are imported only when a command needs them: help and mistakes are printed at once.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg, subcommand

from creps_jax.tools.arguments import parse
from creps_jax.tools.command_line import answer, check_seed, say
from creps_jax.tools.process import import_mjx_quietly
from creps_jax.tools.session import commands
from creps_jax.tools.session.commands import SessionCommand

OVERVIEW = """\
Use a learned policy.

  creps-jax play --speed 0.3        show the parameters and a video of a walk at this speed
  creps-jax play                    show a video of walks at six speeds
  creps-jax drive                   steer a walk with the arrow keys (or --script commands.csv)
  creps-jax robot k1.toml           check the description of a robot, and try 18 standard gaits
  creps-jax export --to walk.c      write a policy (.onnx, .h), the whole walk (.c) or set-points (.csv, .npz)
  creps-jax session                 learn on a real robot, trial by trial

Without --policy, play and export load the latest learned policy, or else the policy of the package; play
prints its path. A session needs --policy or --define. Add --help to a command to list its options.
"""

# Defaults that are None are described in the help text.
_Text = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
_Number = Annotated[float | None, arg(metavar="M/S", help_behavior_hint="")]
_Seconds = Annotated[float | None, arg(metavar="S", help_behavior_hint="")]
_Speeds = Annotated[tuple[float, ...], arg(metavar="[M/S ...]", help_behavior_hint="")]
_File = Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="")]


@dataclasses.dataclass(frozen=True)
class Play:
    """Show walks of a policy: reached speeds, and a video with the walks side by side.

    Attributes:
        speed: Speeds in m/s; by default six speeds over the range of the policy.
        policy: Policy file; by default the latest learned policy, or else the shipped one.
        robot: Robot of the policy, nao, nao_h25, or the .toml file that describes it; by default the robot
            of the policy, or nao.
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
    """Write a policy, or the joint set-points of one of its walks, for other programs.

    Attributes:
        to: The file. A policy is written as an ONNX model (.onnx) or a C header (.h). The whole walk, with
            planner, kinematics and posture feedback, is written as C code (.c, and its header .h). A walk
            from standstill, without posture feedback, is written as a table (.csv) or arrays (.npz).
        policy: Policy file; by default the latest learned walking policy, or else the shipped one.
        robot: Robot of the policy, nao, nao_h25, or the .toml file that describes it; by default the robot
            of the policy, or nao.
        speed: Speed of the walk in m/s (.csv and .npz only).
        duration: Length of the walk in s (.csv and .npz only); 8 by default.
        period: Time between two set-points in s (.c, .csv and .npz only); 0.02 by default.
    """

    to: Annotated[Path, arg(metavar="FILE")]
    policy: _File = None
    robot: _Text = None
    speed: _Number = None
    duration: _Seconds = None
    period: _Seconds = None


@dataclasses.dataclass(frozen=True)
class Drive:
    """Drive a simulated robot: with the arrow keys in a window, or by a file of commands into a video.

    Attributes:
        script: CSV file of commands, with the columns time, vx, vy, turn (s, m/s, m/s, rad/s); by default a
            window opens, and the arrow keys change the command.
        policy: Policy file; by default the shipped policy that can be steered.
        robot: Robot of the policy, or the .toml file that describes it; by default the robot of the policy.
        video: The .mp4 file that a script makes.
        seed: Seed of the noise of a script; 0 by default.
    """

    script: _File = None
    policy: _File = None
    robot: _Text = None
    video: Path = Path("results/drive.mp4")
    seed: int = 0


@dataclasses.dataclass(frozen=True)
class RobotCommand:
    """Check the description of a robot, and try standard gaits before learning.

    Attributes:
        robot: The .toml file that describes the robot, or nao or nao_h25.
        seed: Seed of the noise; 0 by default.
    """

    robot: Annotated[str, Positional, arg(metavar="ROBOT")]
    seed: int = 0


Command = (
    Annotated[Play, subcommand("play")]
    | Annotated[Drive, subcommand("drive")]
    | Annotated[RobotCommand, subcommand("robot")]
    | Annotated[Export, subcommand("export")]
    | Annotated[SessionCommand, subcommand("session")]
)


def main(arguments: Sequence[str]) -> int:
    """Run the command of the arguments and return the exit code, see `command_line.answer`."""
    if not arguments or list(arguments) in (["-h"], ["--help"], ["help"]):
        print(OVERVIEW, end="")
        return 0
    return answer(lambda: _run(parse(Command, arguments, prog="creps-jax")))


def _run(command: Play | Drive | RobotCommand | Export | SessionCommand) -> int:
    return _HANDLERS[type(command)](command)


def _play(command: Play) -> int:
    check_seed(command.seed)
    import_mjx_quietly()
    from creps_jax.tools import play

    play.show(command.speed, command.policy, robot=command.robot, out=command.out, seed=command.seed, say=say)
    return 0


def _drive(command: Drive) -> int:
    check_seed(command.seed)
    import_mjx_quietly()
    from creps_jax.tools import drive

    policy = command.policy or drive.default_policy(command.robot)
    if command.script is None:
        from creps_jax.tools.drive_live import drive_live

        drive_live(policy, robot=command.robot, say=say)
    else:
        options = {"robot": command.robot, "seed": command.seed, "say": say}
        drive.drive_by_script(command.script, policy, command.video, **options)
    return 0


def _robot(command: RobotCommand) -> int:
    check_seed(command.seed)
    import_mjx_quietly()
    from creps_jax.tools import robot_check

    robot_check.show(command.robot, seed=command.seed, say=say)
    return 0


def _export(command: Export) -> int:
    from creps_jax.tools.export import export

    export(
        command.to,
        command.policy,
        robot=command.robot,
        speed=command.speed,
        duration=command.duration,
        period=command.period,
        say=say,
    )
    return 0


def _session(command: SessionCommand) -> int:
    commands.run(command, say=say)
    return 0


_HANDLERS = {
    Play: _play,
    Drive: _drive,
    RobotCommand: _robot,
    Export: _export,
    SessionCommand: _session,
}
