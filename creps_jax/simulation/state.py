"""The state of a simulated robot and the interface of a simulator, common to MJX and C MuJoCo."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np

from creps_jax.typing import Array, Float

__all__ = ["ControlStep", "Physics", "RobotState", "initial_state", "substep_shares"]


class RobotState(NamedTuple):
    """What MuJoCo needs to continue a simulation.

    Attributes:
        qpos: Generalised positions (free joint first: position, wxyz quaternion), m and rad.
        qvel: Generalised velocities, m/s and rad/s.
        qacc_warmstart: Acceleration with which the contact solver starts.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    qacc_warmstart: Float[Array, " nv"]


ControlStep = Callable[..., RobotState]
"""(state, set-points before, set-points after, their speeds) -> state one control step later.

An optional fifth argument, a `simulation.world.World`, replaces the world of the model. For a state of NaN,
which a batch holds for a robot that has fallen, the result may be any state.
"""

Physics = Callable[[mujoco.MjModel, int], ControlStep]
"""(model, number of physics steps in a control step) -> the control step for one robot."""


def initial_state(qpos: Float[Array, " nq"], num_velocities: int) -> RobotState:
    """Return the state at rest in given positions."""
    zeros = jnp.zeros(num_velocities, qpos.dtype)
    return RobotState(qpos, zeros, zeros)


def substep_shares(num_substeps: int) -> Float[np.ndarray, " n"]:
    """Return the share of a control step that has passed at the end of each of its physics steps."""
    return np.arange(1, num_substeps + 1) / num_substeps
