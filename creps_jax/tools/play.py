"""Record, show and film walks of a policy."""

import math
import os.path
import shlex
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.files import policies_folder
from creps_jax.policies.learned import Learned, load
from creps_jax.robots.humanoid import Humanoid
from creps_jax.robots.robot import NAO, Robot
from creps_jax.simulation import c
from creps_jax.simulation.models import model_path
from creps_jax.tasks.closed_loop import CONTROL_PERIOD
from creps_jax.tasks.conditions import slope
from creps_jax.tasks.walking import record_walk
from creps_jax.tools import results
from creps_jax.tools.robots import ROBOTS, find_robot, is_spec, robot_id
from creps_jax.tools.video import Clip, VideoError, write_video
from creps_jax.walking.params import PARAM_NAMES, STEERED_PARAM_NAMES
from creps_jax.walking.posture import Balance

POLICY = "policy.npz"
START_UP = 2.0
_MOST_WALKS = 24
_FILMED = 6


def show(
    speeds: Sequence[float],
    path: Path | None,
    *,
    robot: str | None = None,
    out: Path,
    seed: int,
    say: Callable[[str], None],
) -> None:
    """Show walks at several speeds: reached speeds, the parameters of a single walk, and a video.

    Args:
        speeds: asked speeds, m/s; if empty, six speeds over the range of the policy.
        path: policy file; None is the latest learned policy of the robot, or else the shipped one.
        robot: name of the robot, or the file that describes it; None is the robot of the policy, or without a
            policy the NAO.
        out: the video, an .mp4 file.
        seed: seed of the noise.
        say: prints one line.

    Raises:
        UserError: if the policy does not exist, is unreadable or of another robot, if a speed is outside its
            range or there are too many, or if the video cannot be written.
    """
    if out.suffix != ".mp4" or out.is_dir():
        raise UserError(f"a video must be an .mp4 file, got {out}")
    if len(speeds) > _MOST_WALKS:
        raise UserError(f"a video must show at most {_MOST_WALKS} walks, got {len(speeds)} speeds")
    files.check_writable(out.parent)
    path = path or default_policy(robot)
    policy = load_walking_policy(path, robot)
    speeds = speeds or filmed_speeds(policy)
    thetas = [policy.theta(speed) for speed in speeds]
    say(f"policy: {path}")
    if len(thetas) == 1:
        space = policy.parameters
        for name, unit, value in zip(space.names, space.units, thetas[0], strict=True):
            say(f"  {name.replace('_', ' '):16}{value:8.4f} {unit}".rstrip())
    who = robot_of(policy, robot)
    clips = record(policy, speeds, seed=seed, robot=who)
    for clip in clips:
        say(str(clip.caption))
    save_film(clips, out, say, robot=who)


def filmed_speeds(policy: Learned) -> list[float]:
    """Return six speeds over the range of a policy, m/s."""
    speeds = np.linspace(policy.contexts.low[0], policy.contexts.high[0], _FILMED)
    return [round(float(speed), 6) for speed in speeds]


def record(
    policy: Learned,
    speeds: Sequence[float],
    *,
    seed: int,
    robot: Robot | None = None,
    duration: float = 8.0,
    slopes: Sequence[float] | None = None,
) -> list[Clip]:
    """Record a walk at each speed, captioned with asked and reached speed.

    Args:
        policy: a policy of which the context is speed, or speed and slope.
        speeds: asked speeds, m/s.
        seed: seed of the noise.
        robot: the robot; None is the robot that the policy names.
        duration: length of the walks, s.
        slopes: slope of each walk, deg, for a policy with a slope in its context.

    Raises:
        UserError: if there is no speed, or a context is outside the range of the policy.
    """
    if not speeds:
        raise UserError("name at least one speed")
    ways = np.zeros((len(speeds), 0)) if slopes is None else np.array(slopes, float)[:, None]
    thetas = jnp.stack(
        [jnp.asarray(policy.theta(speed, *way)) for speed, way in zip(speeds, ways, strict=True)]
    )
    # MJX would take longer to compile than a few walks take in C MuJoCo.
    settings = {"duration": duration, "balance": balance_of(policy), "physics": c.make_control_step}
    settings |= {"robot": robot or robot_of(policy), "com": policy.task.get("com", "one_step")}
    if slopes is not None:
        settings["conditions"] = (slope(policy.contexts.low[1], policy.contexts.high[1]),)
    walk = jax.jit(jax.vmap(lambda key, theta, way: record_walk(key, theta, values=way, **settings)))
    keys = jax.random.split(jax.random.key(seed), len(speeds))
    walks = walk(keys, thetas, jnp.asarray(ways, jnp.float32))
    qpos, fallen = np.asarray(walks.qpos), np.asarray(walks.has_fallen)
    clips = []
    for index, speed in enumerate(speeds):
        start = round(START_UP / CONTROL_PERIOD) - 1
        reached = (qpos[index, -1, 0] - qpos[index, start, 0]) / (duration - START_UP)
        verdict = "fell" if fallen[index, -1] else f"reached {reached:.2f} m/s"
        rise = 0.0 if slopes is None else slopes[index]
        where = "" if slopes is None else f"slope {rise:g}°, "
        clips.append(Clip(f"{where}asked {speed:.2f} m/s, {verdict}", qpos[index], CONTROL_PERIOD, rise))
    return clips


def save_film(clips: Sequence[Clip], path: Path, say: Callable[[str], None], *, robot: Robot) -> None:
    """Write a video, or print why it cannot be made: a result is complete without it."""
    try:
        middle = len(clips[0].qpos) * clips[0].period / 2
        with tempfile.TemporaryDirectory(prefix="creps_jax-") as folder:
            model = _film_model(robot, Path(folder))
            write_video(path, model, clips, still_at=middle, size=robot.size)
        say(f"video: {path}")
    except VideoError as error:
        say(str(error))


def _film_model(robot: Robot, folder: Path) -> Path:
    """Return the file of the model with which a robot is drawn; a humanoid's is written into a folder."""
    if not isinstance(robot, Humanoid):
        return model_path(robot)
    mujoco.mj_saveModel(robot.film_model, str(folder / "model.mjb"), None)
    return folder / "model.mjb"


def default_policy(robot: str | None = None) -> Path:
    """Return the policy of a robot's latest finished run, or else its shipped policy.

    Args:
        robot: name of the robot, or the file that describes it; None is the NAO.

    Raises:
        UserError: if there is neither, or the robot is unknown.
    """
    robot = robot_id(robot or NAO.name)
    find_robot(robot)
    folder = results.latest_folder("walk", status="finished", robot=robot)
    if folder is not None and (folder / POLICY).exists():
        return folder / POLICY
    return shipped_policy(robot)


def shipped_policy(robot: str | None = None) -> Path:
    """Return the shipped policy of a robot, by default the NAO.

    Raises:
        UserError: if there is none, or the robot is unknown.
    """
    robot = robot or NAO.name
    find_robot(robot)
    shipped = policies_folder(robot) / "walk.npz"
    if is_spec(robot) or not shipped.exists():
        asked = "" if robot == NAO.name else f" --robot {shlex.quote(robot)}"
        # The command chooses the preset of a robot that a file describes.
        preset = "" if is_spec(robot) else " --preset quick"
        raise UserError(
            f"no policy has been learned yet in {Path.cwd() / 'results'}; name a file with --policy, or "
            f"learn one: python -m experiments run walk{asked}{preset}"
        )
    return shipped


def load_walking_policy(path: Path, robot: str | None = None, *, can_steer: bool = False) -> Learned:
    """Load a policy file and check that it is a walking policy.

    Args:
        path: the file.
        robot: name of the robot that the policy must have, or the file that describes it; None accepts any.
        can_steer: whether a policy of a steered walk is accepted as well.

    Raises:
        UserError: if it is another policy, unreadable, or of an unknown robot.
    """
    policy = load(path)
    if policy.parameters.names not in (PARAM_NAMES, STEERED_PARAM_NAMES)[: 1 + can_steer]:
        found = ", ".join(policy.parameters.names)
        raise UserError(f"{path} is no walking policy: its parameters are {found}")
    try:
        balance = balance_of(policy)
        is_finite = all(map(math.isfinite, balance)) and balance.filter_time >= 0.0  # type: ignore[arg-type]
    except (KeyError, TypeError):
        is_finite = False
    if not is_finite:
        wanted = ", ".join(Balance._fields)
        raise UserError(f"{path} must have the balance of its steps, {wanted}, got {policy.task}")
    try:
        robot_of(policy, robot)
    except UserError as error:
        raise UserError(f"{path}: {error}") from error
    return policy


def robot_of(policy: Learned, robot: str | None = None) -> Robot:
    """Return the robot that a policy was learned with; older files do not name it, and are the NAO's.

    Args:
        policy: the policy.
        robot: name of the robot that the policy must have, or the file that describes it; None is the robot
            that the policy names.

    Raises:
        UserError: if it is unknown or another one.
    """
    name, spec = str(policy.task.get("robot", NAO.name)), str(policy.task.get("spec", ""))
    if robot is None:
        if name not in ROBOTS and not (is_spec(spec) and os.path.isfile(spec)):
            where = f"described by {spec}, which is not there" if spec else f"not of {', '.join(ROBOTS)}"
            raise UserError(
                f"the policy is of the robot {name!r}, {where}: name the file that describes it with --robot"
            )
        robot = name if name in ROBOTS else spec
    found = find_robot(robot).robot
    if found.name != name:
        note = f"; its description may say name = {name!r}" if is_spec(robot) and name not in ROBOTS else ""
        raise UserError(f"the policy is of the robot {name}, not of {found.name}{note}")
    return found


def balance_of(policy: Learned) -> Balance:
    """Return the gains of the response to the measured orientation that a policy was learned with."""
    return Balance(**policy.task["balance"])
