"""What a robot's simulation carries from one control step to the next, whoever steps it."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from creps_jax import checks
from creps_jax.typing import Array, Float

__all__ = ["ControlStep", "RobotState", "initial_state", "substep_shares"]


class RobotState(NamedTuple):
    """All that MuJoCo carries from one step to the next.

    Attributes:
        qpos: Generalised positions (free joint first: position, wxyz quaternion), m and rad.
        qvel: Generalised velocities, m/s and rad/s.
        qacc_warmstart: Acceleration from which the contact solver starts.
    """

    qpos: Float[Array, " nq"]
    qvel: Float[Array, " nv"]
    qacc_warmstart: Float[Array, " nv"]


ControlStep = Callable[..., RobotState]
"""(state, set-points before, set-points after, their speeds) -> state one control step later.

A fifth argument, a `physics.world.World`, takes the place of the model's own world. A state of NaN, such as
a batch has where a robot has fallen, gives any state.
"""


@checks.arguments
def initial_state(qpos: Float[Array, " nq"], num_velocities: int) -> RobotState:
    """Return the state at rest in a position."""
    zeros = jnp.zeros(num_velocities, qpos.dtype)
    return RobotState(qpos, zeros, zeros)


@checks.arguments
def substep_shares(num_substeps: int) -> Float[np.ndarray, " n"]:
    """Return which share of the way from one set-point to the next each physics step of a control step has.

    Raises:
        ValueError: If there is no substep.
    """
    return np.arange(1, num_substeps + 1) / num_substeps
