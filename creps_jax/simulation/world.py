"""What acts on a robot that its model does not settle: gravity, a payload, the friction of the floor."""

from typing import NamedTuple

import mujoco
import numpy as np

from creps_jax.typing import Array, Float, ScalarLike

__all__ = ["World", "changed_fields", "world_of"]

_LOADED_BODY = 1
"""MuJoCo's number of the first body of a robot, its torso; 0 is the world."""


class World(NamedTuple):
    """The world of one robot, for the length of a control step.

    Attributes:
        gravity: Acceleration of gravity in the frame of the floor, m/s^2.
        payload: Mass that is added at the centre of mass of the first body, kg; it has no extent.
        friction: How many times the model's coefficients sliding friction has.
    """

    gravity: Float[Array, "3"] | Float[np.ndarray, "3"]
    payload: ScalarLike = 0.0
    friction: ScalarLike = 1.0


def world_of(model: mujoco.MjModel) -> World:
    """Return the world that a model has itself."""
    return World(np.array(model.opt.gravity, np.float32))


def changed_fields(
    model: mujoco.MjModel, world: World
) -> dict[str, Float[Array, "..."] | Float[np.ndarray, "..."]]:
    """Return the fields of MuJoCo's model, by name, in which a world differs from it.

    The softness of contacts, which MuJoCo works out from the masses when it compiles a model, stays.
    """
    is_loaded = (np.arange(model.nbody) == _LOADED_BODY).astype(np.float32)
    is_sliding = np.array([[1.0, 0.0, 0.0]], np.float32)
    mass, friction = model.body_mass.astype(np.float32), model.geom_friction.astype(np.float32)
    return {
        "opt.gravity": world.gravity,
        "body_mass": mass + world.payload * is_loaded,
        "geom_friction": friction * (1.0 + (world.friction - 1.0) * is_sliding),
    }
