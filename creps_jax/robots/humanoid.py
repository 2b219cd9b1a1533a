"""A humanoid whose leg kinematics are read from its MuJoCo model: each joint is an axis in space."""

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from creps_jax.robots.robot import Robot
from creps_jax.typing import Float

if TYPE_CHECKING:
    import mujoco

__all__ = ["Humanoid", "LegChain"]


class LegChain(NamedTuple):
    """The joint axes of a leg of k joints, from hip to ankle, in the frame of the trunk.

    Attributes:
        axes: Directions of the axes with all angles of the leg zero; unit vectors.
        points: A point on each axis, m.
        sole: Pose of the sole at these angles, m. The origin of the sole frame is in the lower face of the
            foot, straight below the ankle; its x axis points to the toes.
        lower: Lower limits of the angles, rad.
        upper: Upper limits, rad.
        weights: Weights of the pose's errors along x, y, z and about x, y, z of the sole, in the inverse
            kinematics.
    """

    axes: Float[np.ndarray, "k 3"]
    points: Float[np.ndarray, "k 3"]
    sole: Float[np.ndarray, "4 4"]
    lower: Float[np.ndarray, " k"]
    upper: Float[np.ndarray, " k"]
    weights: Float[np.ndarray, "6"]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Humanoid(Robot):
    """A humanoid that was read from its MuJoCo model, see `humanoid_from_mjcf`.

    It is equal only to itself: two of them may differ in their models alone.

    Attributes:
        left: Axes of the left leg.
        right: Axes of the right leg.
        model: The model in which it is simulated.
        film_model: The model with which it is drawn.
        speeds: Lowest and highest speed at which it is to walk, m/s.
        source: The arguments of `humanoid_from_mjcf` that made it.
    """

    left: LegChain
    right: LegChain
    model: "mujoco.MjModel"
    film_model: "mujoco.MjModel"
    speeds: tuple[float, float]
    source: dict[str, Any]

    def __eq__(self, other: object) -> bool:
        return self is other

    def __hash__(self) -> int:
        return id(self)
