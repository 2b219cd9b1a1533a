"""Drive a simulated robot live: MuJoCo's viewer shows it, the arrow keys change the command."""

import os
import sys
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax.errors import UserError
from creps_jax.robots.humanoid import Humanoid
from creps_jax.simulation import c
from creps_jax.simulation.models import model_path
from creps_jax.tasks.closed_loop import (
    CONTROL_PERIOD,
    WalkNoise,
    WalkState,
    advance,
    begin,
    is_fallen,
    make_setup,
)
from creps_jax.tasks.steering import moved
from creps_jax.tools.drive import AVERAGED, in_words
from creps_jax.tools.play import load_walking_policy, robot_of
from creps_jax.walking.controller import Walker
from creps_jax.walking.gaits import command_range, learned_walker


class Command:
    """The command that keys change, a step at a time, between the lowest and the highest of a policy."""

    steps = (0.05, 0.05, 0.2)

    def __init__(self, low: np.ndarray, high: np.ndarray) -> None:
        self.value = np.zeros(3, np.float32)
        self._low, self._high = low, high

    def press(self, key: int) -> None:
        """Change the command by a key of GLFW: arrows, comma and full stop, space."""
        axis, sign = _KEYS.get(key, (None, 0))
        if axis is not None:
            wanted = np.round(self.value[axis] + sign * self.steps[axis], 3)
            self.value[axis] = np.clip(wanted, self._low[axis], self._high[axis])
        elif key == _SPACE:
            self.value[:] = 0.0


# Numbers of keys in GLFW: what MuJoCo's viewer reports.
_SPACE = 32
_KEYS = {265: (0, 1), 264: (0, -1), 44: (1, 1), 46: (1, -1), 263: (2, 1), 262: (2, -1)}
_HELP = "up, down: forward speed\nleft, right: turn\ncomma, full stop: sideways\nspace: stop"


def drive_live(policy: Path, *, robot: str | None = None, say: Callable[[str], None]) -> None:
    """Open MuJoCo's viewer and drive a robot with the arrow keys, until the window is closed.

    Args:
        policy: the policy file.
        robot: name of the robot, or the file that describes it; None is the robot of the policy.
        say: prints one line.

    Raises:
        UserError: if the policy cannot be driven, or there is no screen.
    """
    learned = load_walking_policy(policy, robot, can_steer=True)
    who = robot_of(learned, robot)
    walker = learned_walker(learned, robot=who)
    say(f"policy: {policy}")
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise UserError(
            "there is no screen to open a window on; drive by a file: creps-jax drive --script commands.csv"
        )
    import mujoco.viewer

    is_read = isinstance(who, Humanoid)
    model = who.film_model if is_read else mujoco.MjModel.from_xml_path(str(model_path(who)))
    data = mujoco.MjData(model)
    command, live = Command(*command_range(learned)), LiveRobot(walker)
    with mujoco.viewer.launch_passive(
        model, data, key_callback=command.press, show_left_ui=False, show_right_ui=False
    ) as viewer:
        viewer.cam.distance, viewer.cam.elevation, viewer.cam.azimuth = 1.6 * who.size, -15.0, 135.0
        next_at = time.monotonic()
        while viewer.is_running():
            qpos, reached = live.step(command.value)
            data.qpos[:] = qpos
            mujoco.mj_forward(model, data)
            viewer.cam.lookat[:] = (*qpos[:2], 0.25 * who.size)
            fell = "\nfell: starts again" if live.has_fallen else ""
            text = f"{in_words(command.value)}\n{in_words(reached)}{fell}"
            viewer.set_texts(
                [
                    (None, mujoco.mjtGridPos.mjGRID_TOPLEFT, "asked vx, vy, turn\nreached", text),
                    (None, mujoco.mjtGridPos.mjGRID_BOTTOMLEFT, _HELP, ""),
                ]
            )
            viewer.sync()
            next_at = max(next_at + CONTROL_PERIOD, time.monotonic() - CONTROL_PERIOD)
            time.sleep(max(0.0, next_at - time.monotonic()))


class LiveRobot:
    """A simulated robot that is driven one control step at a time; after a fall it starts again."""

    def __init__(self, walker: Walker):
        # The noise is drawn for one control step, and is zero.
        setup = make_setup(
            walker.robot, None, CONTROL_PERIOD, WalkNoise(0.0, 0.0, 0.0), (), c.make_control_step
        )
        begun = jax.jit(lambda: begin(setup, walker, jax.random.key(0), jnp.zeros(0)))()
        self._walk, self._first = begun

        def step(state: WalkState, command: jax.Array) -> tuple[WalkState, jax.Array]:
            state = advance(setup, walker, self._walk, jnp.int32(0), state, command)
            return state, is_fallen(setup, self._walk, state)

        self._step = jax.jit(step)
        self._restart()

    def _restart(self) -> None:
        self._state, self.has_fallen = self._first, False
        self._seen: deque[np.ndarray] = deque(maxlen=round(AVERAGED / CONTROL_PERIOD))

    def step(self, command: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Walk on by one control step; return the positions, and the mean speed of a second."""
        if self.has_fallen:
            self._restart()
        before = np.asarray(self._state.robot.qpos)
        self._state, has_fallen = self._step(self._state, jnp.asarray(command))
        self.has_fallen = bool(has_fallen)
        qpos = np.asarray(self._state.robot.qpos)
        self._seen.append(np.asarray(moved(jnp.asarray(before), jnp.asarray(qpos))) / CONTROL_PERIOD)
        return qpos, np.mean(self._seen, axis=0)
