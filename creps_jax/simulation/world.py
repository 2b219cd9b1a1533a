"""The world of a robot, which can differ between the robots of a batch: gravity, payload and friction."""

from typing import NamedTuple

import mujoco
import numpy as np

from creps_jax.typing import Array, Float, ScalarLike

__all__ = ["World", "changed_fields", "world_of"]

_LOADED_BODY = 1
"""MuJoCo's index of the first body of a robot, the torso; 0 is the world."""


class World(NamedTuple):
    """The world of one robot during a control step.

    Attributes:
        gravity: Acceleration of gravity in the frame of the floor, m/s^2.
        payload: Point mass that is added at the centre of mass of the first body, kg.
        friction: Factor of the model's coefficients of sliding friction.
    """

    gravity: Float[Array, "3"] | Float[np.ndarray, "3"]
    payload: ScalarLike = 0.0
    friction: ScalarLike = 1.0


def world_of(model: mujoco.MjModel) -> World:
    """Return the world of a model itself: its gravity, no payload, its friction."""
    return World(np.array(model.opt.gravity, np.float32))


def changed_fields(
    model: mujoco.MjModel, world: World
) -> dict[str, Float[Array, "..."] | Float[np.ndarray, "..."]]:
    """Return the fields of MuJoCo's model that depend on the world, by name.

    The softness of contacts, which MuJoCo computes from the masses when it compiles a model, is not changed.
    """
    is_loaded = (np.arange(model.nbody) == _LOADED_BODY).astype(np.float32)
    is_sliding = np.array([[1.0, 0.0, 0.0]], np.float32)
    mass, friction = model.body_mass.astype(np.float32), model.geom_friction.astype(np.float32)
    return {
        "opt.gravity": world.gravity,
        "body_mass": mass + world.payload * is_loaded,
        "geom_friction": friction * (1.0 + (world.friction - 1.0) * is_sliding),
    }
