"""Export a policy, or one of its walks, to programs without this package."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from creps_jax.errors import UserError
from creps_jax.tools.process import import_mjx_quietly

if TYPE_CHECKING:
    from creps_jax.policies.learned import Learned

_OF_POLICY = {".onnx": "ONNX model", ".h": "C header"}
_WHOLE_WALK = {".c": "C code of the walk"}
_OF_WALK = {".csv": "CSV table", ".npz": "NumPy arrays"}
_DURATION = 8.0
_PERIOD = 0.02
_SHORTEST_PERIOD, _LONGEST_PERIOD = 0.001, 0.1


def export(
    to: Path,
    policy: Path | None,
    *,
    robot: str | None = None,
    speed: float | None,
    duration: float | None,
    period: float | None = None,
    say: Callable[[str], None],
) -> None:
    """Write a policy as .onnx or .h (C), the whole walk as .c, or the set-points of a walk as .csv or .npz.

    Args:
        to: the file; its ending decides on the format. An existing file is overwritten.
        policy: policy file; None is the latest learned walking policy of the robot, or else the shipped one.
        robot: name of the robot, or the file that describes it; None is the robot of the policy, or without a
            policy the NAO.
        speed: speed of the walk, m/s; required for a walk, and only for a walk.
        duration: length of the walk, s; only for a walk, 8 by default.
        period: time between two set-points, s; only for a walk, 0.02 by default.
        say: prints one line.

    Raises:
        UserError: for a mistake in the request, an unreadable policy, or a file that cannot be written.
    """
    ending = to.suffix.lower()
    _check_request(to, ending, {"speed": speed, "duration": duration, "period": period})
    # The other imports take seconds: mistakes are reported before.
    path = policy or _default_policy(robot)
    if _are_the_same(to, path):
        raise UserError(f"--to {to} is the policy file itself, name another file")
    _check_header(to, ending)
    period = _PERIOD if period is None else period
    if ending in _WHOLE_WALK:
        import_mjx_quietly()
        from creps_jax.tools.export import walk_c
        from creps_jax.tools.play import load_walking_policy, robot_of

        learned = load_walking_policy(path, robot, can_steer=True)
        walk_c.save(to, learned, robot=robot_of(learned, robot), period=period)
    elif speed is not None:
        import_mjx_quietly()
        from creps_jax.tools.export import trajectory

        seconds = _DURATION if duration is None else duration
        walk = trajectory.plan(path, speed, seconds, robot=robot, period=period)
        falls_at = trajectory.time_of_fall(path, speed, seconds, robot=robot)
        if falls_at is not None:
            say(
                f"note: a simulated robot that plays this walk without feedback falls at {falls_at:.1f} s; "
                "a .c file has the feedback"
            )
        {".csv": trajectory.save_csv, ".npz": trajectory.save_npz}[ending](to, walk)
    else:
        from creps_jax.policies.learned import load
        from creps_jax.tools.export import c_header, onnx_model

        saved = load(path) if robot is None else _load_walking_policy(path, robot)
        {".onnx": onnx_model.save, ".h": c_header.save}[ending](to, saved)
    say(f"policy: {path}")
    say(f"{(_OF_POLICY | _OF_WALK | _WHOLE_WALK)[ending]}: {to}")


def _check_header(to: Path, ending: str) -> None:
    """Check that a header of a policy and the header of a whole walk do not overwrite each other."""
    other = to.with_suffix(".c" if ending == ".h" else ".h")
    if ending == ".h" and other.exists() and f'#include "{to.name}"' in other.read_text("utf-8", "ignore"):
        raise UserError(f"--to {to} is the name of the header of {other}, name another file")
    if ending in _WHOLE_WALK and other.exists() and not to.exists():
        raise UserError(f"--to {to} would overwrite {other} with the header of the walk, name another file")


def _check_request(to: Path, ending: str, options: dict[str, float | None]) -> None:
    """Refuse an unknown ending, options that it does not have, and a period out of its range."""
    endings = _OF_POLICY | _WHOLE_WALK | _OF_WALK
    if ending not in endings:
        raise UserError(f"--to must end in {', '.join(endings)}, got {to}")
    if ending in _OF_WALK and options["speed"] is None:
        raise UserError(f"{to} would hold the joint set-points of a walk, which need --speed, in m/s")
    for name, value in options.items():
        allowed = (*_OF_WALK, *_WHOLE_WALK) if name == "period" else tuple(_OF_WALK)
        if value is not None and ending not in allowed:
            what = "the walk at every command" if ending in _WHOLE_WALK else "the policy, for every context"
            raise UserError(f"--{name} goes with {' and '.join(allowed)}: {to} is {what}")
    period = options["period"]
    if period is not None and not _SHORTEST_PERIOD <= period <= _LONGEST_PERIOD:
        raise UserError(f"--period must be {_SHORTEST_PERIOD:g} to {_LONGEST_PERIOD:g} s, got {period}")


def _are_the_same(path: Path, other: Path) -> bool:
    try:
        return path.samefile(other)
    except OSError:
        return False


def _default_policy(robot: str | None) -> Path:
    import_mjx_quietly()
    from creps_jax.tools.play import default_policy

    return default_policy(robot)


def _load_walking_policy(path: Path, robot: str) -> "Learned":
    import_mjx_quietly()
    from creps_jax.tools.play import load_walking_policy

    return load_walking_policy(path, robot)
