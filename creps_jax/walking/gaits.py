"""From theta, or from a learned policy, to the gait that a walker reads at each command."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from creps_jax import checks
from creps_jax.policies.learned import Learned
from creps_jax.robots.robot import NAO, ROBOTS, Robot
from creps_jax.typing import Array, Float
from creps_jax.walking.controller import Gait, Walker
from creps_jax.walking.params import PARAM_NAMES, params_from_theta
from creps_jax.walking.posture import Balance

__all__ = [
    "AHEAD",
    "COMMAND_NAMES",
    "COMMAND_UNITS",
    "command_context",
    "command_range",
    "is_steered",
    "learned_walker",
    "limited_command",
    "steered_gait",
    "straight_gait",
    "straight_walker",
]

COMMAND_NAMES = ("vx", "vy", "turn")
"""Names of the axes of a command."""
COMMAND_UNITS = ("m/s", "m/s", "rad/s")
"""Their units."""
AHEAD = (1.0, 0.0, 0.0)
"""Command of a `straight_walker` that is to walk: its parameters, not the command, say how fast."""
# What steps sideways (m, for a NAO) and turns (rad) are limited to, whatever theta says.
LARGEST_SIDE, LARGEST_TURN = 0.2, 1.0
# Acceleration of a command that is followed at once.
_AT_ONCE = (1e6, 1e6, 1e6)


@checks.arguments
def straight_gait(theta: Float[Array, "10"], *, robot: Robot = NAO) -> Gait:
    """Return the gait of the ten parameters, straight ahead."""
    params = params_from_theta(theta, robot=robot)
    zero = jnp.zeros_like(params.step_length)
    return Gait(params, jnp.stack([params.step_length, zero, zero]))


@checks.arguments
def straight_walker(theta: Float[Array, "10"], **settings: Any) -> Walker:
    """Make the walker of the paper: straight ahead from the first period on, each step solved for itself.

    Args:
        theta: Walking parameters in the paper's order and units.
        settings: Settings of `Walker`, such as `robot` and `period`.

    Returns:
        The walker. It walks at the command `AHEAD`.

    Raises:
        ValueError: If theta has not one entry for each parameter, or a setting is out of its range.
    """
    once: dict[str, Any] = {"acceleration": _AT_ONCE, "com": "one_step"}
    robot = settings.get("robot", NAO)
    return Walker(lambda _: straight_gait(theta, robot=robot), **(once | settings))


@checks.arguments
def steered_gait(theta: Float[Array, "12"], *, robot: Robot = NAO) -> Gait:
    """Return the gait of the ten parameters and a step's displacement to the left (m) and turn (rad)."""
    params = params_from_theta(theta[: len(PARAM_NAMES)], robot=robot)
    side = jnp.clip(theta[len(PARAM_NAMES)], -robot.size * LARGEST_SIDE, robot.size * LARGEST_SIDE)
    turn = jnp.clip(theta[len(PARAM_NAMES) + 1], -LARGEST_TURN, LARGEST_TURN)
    return Gait(params, jnp.stack([params.step_length, side, turn]))


def limited_command(
    command: Float[Array, "3"], low: Float[Array, "3"], high: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Move a command towards the middle of a box of commands, into the ellipsoid inside the box."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    offset = (command - middle) / half
    length = jnp.sqrt(jnp.maximum(jnp.sum(offset**2), 1e-12))
    return middle + half * offset / jnp.maximum(length, 1.0)


def learned_walker(learned: Learned, **settings: Any) -> Walker:
    """Make the walker of a learned walk.

    A policy for (vx, vy, turn) is asked for each command, limited to the ellipsoid inside its ranges. A
    policy for a speed alone is asked for the size of the forward speed; its step is scaled where the speed is
    out of its range, and steps to the side and turns are those of the command.

    Args:
        learned: A policy of `nao_walk` or `nao_steered_walk`. Conditions, such as a slope, are taken as zero,
            or as the end of their range next to zero.
        settings: Settings of `Walker`, such as `period`; the others are those of learning. A policy of a
            `Humanoid` needs it as `robot`.

    Raises:
        ValueError: If the policy is of another task, or a setting is out of its range.
    """
    checks.instance("learned", learned, Learned)
    names, task = learned.contexts.names, learned.task
    if names[:1] != ("speed",) and not is_steered(learned):
        expected = f"speed, or {', '.join(COMMAND_NAMES)}"
        raise ValueError(f"learned must be a walk whose contexts are {expected}, got {', '.join(names)}")
    name, robot = task.get("robot", NAO.name), settings.get("robot")
    if robot is None and name not in ROBOTS:
        raise ValueError(
            f"robot must be the Robot {name!r} with which learned was learned: make it by "
            f"humanoid_from_mjcf; the library has {', '.join(ROBOTS)}, got no robot"
        )
    robot = ROBOTS[name] if robot is None else robot
    if robot.name != name:
        raise ValueError(f"robot must be {name!r}, with which learned was learned, got {robot.name!r}")
    gait = _command_gait(learned, robot) if is_steered(learned) else _speed_gait(learned, robot)
    defaults = {
        "robot": robot,
        "balance": Balance(**task.get("balance", {})),
        "com": task.get("com", "one_step"),
    }
    if "acceleration" in task:
        defaults["acceleration"] = tuple(task["acceleration"])
    return Walker(gait, **(defaults | settings))


def is_steered(learned: Learned) -> bool:
    """Return whether the context of a policy begins with a command (vx, vy, turn rate)."""
    return learned.contexts.names[: len(COMMAND_NAMES)] == COMMAND_NAMES


def command_context(learned: Learned, command: Float[Array, "*c"]) -> Float[Array, " k"]:
    """Return the context of a command; conditions are as near to zero as their range allows.

    Args:
        learned: A learned walk.
        command: The speed (), or the command (3,), as the contexts of the policy begin.
    """
    rest = jnp.clip(0.0, jnp.asarray(learned.contexts.low), jnp.asarray(learned.contexts.high))
    return rest.astype(command.dtype).at[: command.size].set(command)


def command_range(learned: Learned) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Return the lowest and the highest command of a learned walk, m/s and rad/s.

    A policy for a speed limits the forward speed only: the other ends are infinite.
    """
    if is_steered(learned):
        low, high = learned.contexts.low[:3], learned.contexts.high[:3]
        return np.asarray(low, np.float32), np.asarray(high, np.float32)
    highest = np.array([learned.contexts.high[0], np.inf, np.inf], np.float32)
    return -highest, highest


def _command_gait(learned: Learned, robot: Robot) -> Callable[[Array], Gait]:
    low, high = command_range(learned)

    def gait(command: Float[Array, "3"]) -> Gait:
        ends = (jnp.asarray(end, command.dtype) for end in (low, high))
        context = command_context(learned, limited_command(command, *ends))
        return steered_gait(learned.thetas(context[None])[0], robot=robot)

    return gait


def _speed_gait(learned: Learned, robot: Robot) -> Callable[[Array], Gait]:
    low, high = learned.contexts.low[0], learned.contexts.high[0]

    def gait(command: Float[Array, "3"]) -> Gait:
        speed = jnp.clip(jnp.abs(command[0]), low, high)
        context = command_context(learned, speed)
        params = params_from_theta(learned.thetas(context[None])[0], robot=robot)
        ahead = params.step_length * jnp.clip(command[0] / speed, -1.0, 1.0)
        return Gait(params, jnp.stack([ahead, *(params.step_duration * command[1:])]))

    return gait
