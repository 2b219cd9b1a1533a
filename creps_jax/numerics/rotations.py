"""Turn between rotation matrices, roll-pitch-yaw angles and quaternions, and invert rigid transforms.

Conventions, used everywhere in the library:

- Frames are right-handed with x forward, y left and z up. Angles are in radians.
- ``R_a_b`` (3, 3) turns the coordinates of a vector in frame b into its coordinates in frame a, and
  ``T_a_b`` (4, 4) does the same for points, so that ``T_a_c = T_a_b @ T_b_c``.
- ``rpy`` is (roll, pitch, yaw) with ``R = Rz(yaw) @ Ry(pitch) @ Rx(roll)``. Positive pitch leans forward,
  positive roll leans to the right, positive yaw turns to the left.
- Quaternions are (w, x, y, z) and need not be of unit length.

Values and gradients are finite at gimbal lock and for a zero quaternion too.
"""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from creps_jax import checks
from creps_jax.typing import ScalarLike

__all__ = [
    "matrix_to_rpy",
    "quat_to_matrix",
    "quat_to_rpy",
    "rigid_transform",
    "rotation_x",
    "rotation_y",
    "rotation_z",
    "rpy_to_matrix",
    "rpy_to_quat",
    "safe_arctan2",
    "wrapped",
]

_TINY = 1e-12


@checks.arguments
def safe_arctan2(y: Float[Array, "*b"], x: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Return the angle of the point (x, y), and 0 with a zero gradient at the origin."""
    if y.shape != x.shape:
        raise ValueError(f"y and x must have the same shape, got {y.shape} and {x.shape}")
    is_origin = x * x + y * y < _TINY
    return jnp.where(is_origin, 0.0, jnp.arctan2(jnp.where(is_origin, 0.0, y), jnp.where(is_origin, 1.0, x)))


@checks.arguments
def rotation_x(angle: ScalarLike) -> Float[Array, "3 3"]:
    """Return the rotation by `angle` (rad) about the x axis."""
    c, s, zero, one = _rotation_entries(angle)
    return jnp.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3)


@checks.arguments
def rotation_y(angle: ScalarLike) -> Float[Array, "3 3"]:
    """Return the rotation by `angle` (rad) about the y axis."""
    c, s, zero, one = _rotation_entries(angle)
    return jnp.stack([c, zero, s, zero, one, zero, -s, zero, c]).reshape(3, 3)


@checks.arguments
def rotation_z(angle: ScalarLike) -> Float[Array, "3 3"]:
    """Return the rotation by `angle` (rad) about the z axis."""
    c, s, zero, one = _rotation_entries(angle)
    return jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)


@checks.arguments
def rpy_to_matrix(rpy: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return ``Rz(yaw) @ Ry(pitch) @ Rx(roll)``."""
    roll, pitch, yaw = rpy
    return rotation_z(yaw) @ rotation_y(pitch) @ rotation_x(roll)


@checks.arguments
def matrix_to_rpy(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Return (roll, pitch, yaw) with pitch in [-pi/2, pi/2], the inverse of `rpy_to_matrix`.

    The roll comes first and the yaw is the one that goes with it, so that `rpy_to_matrix` gives the matrix
    back near gimbal lock as well, where roll and yaw alone are not determined. At the lock itself the roll
    is 0.
    """
    roll = safe_arctan2(rotation[2, 1], rotation[2, 2])
    c, s = jnp.cos(roll), jnp.sin(roll)
    pitch = jnp.arctan2(-rotation[2, 0], c * rotation[2, 2] + s * rotation[2, 1])
    # The middle column of R @ Rx(-roll) = Rz(yaw) @ Ry(pitch) is (-sin yaw, cos yaw, 0).
    yaw = safe_arctan2(s * rotation[0, 2] - c * rotation[0, 1], c * rotation[1, 1] - s * rotation[1, 2])
    return jnp.stack([roll, pitch, yaw])


@checks.arguments
def quat_to_matrix(quat: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Return the rotation matrix of a (w, x, y, z) quaternion of any length; the identity for length 0."""
    squared_length = quat @ quat
    is_zero = squared_length < _TINY
    identity = jnp.zeros_like(quat).at[0].set(1.0)
    w, x, y, z = jnp.where(is_zero, identity, quat)
    scale = 2.0 / jnp.where(is_zero, 1.0, squared_length)
    return jnp.eye(3, dtype=quat.dtype) + scale * jnp.stack([
        -(y * y + z * z), x * y - w * z, x * z + w * y,
        x * y + w * z, -(x * x + z * z), y * z - w * x,
        x * z - w * y, y * z + w * x, -(x * x + y * y),
    ]).reshape(3, 3)  # fmt: skip


@checks.arguments
def quat_to_rpy(quat: Float[Array, "4"]) -> Float[Array, "3"]:
    """Return (roll, pitch, yaw) of a (w, x, y, z) quaternion of any length."""
    return matrix_to_rpy(quat_to_matrix(quat))


@checks.arguments
def rpy_to_quat(rpy: Float[Array, "3"]) -> Float[Array, "4"]:
    """Return the unit (w, x, y, z) quaternion of ``Rz(yaw) @ Ry(pitch) @ Rx(roll)``."""
    (cr, cp, cy), (sr, sp, sy) = jnp.cos(rpy / 2.0), jnp.sin(rpy / 2.0)
    return jnp.stack([
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    ])  # fmt: skip


@checks.arguments
def rigid_transform(rotation: Float[Array, "3 3"], position: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """Return the (4, 4) transform with this rotation and translation."""
    bottom = jnp.zeros((1, 4), rotation.dtype).at[0, 3].set(1.0)
    return jnp.concatenate([jnp.concatenate([rotation, position[:, None]], axis=1), bottom])


def _rotation_entries(angle: ScalarLike) -> tuple[Float[Array, ""], ...]:
    """Return the cosine and sine of `angle`, and zero and one of the same type."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return cosine, sine, jnp.zeros_like(cosine), jnp.ones_like(cosine)


def wrapped(angle: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """Return an angle, rad, as the equal one from -pi to pi; one in this range is returned to the bit."""
    turns = jnp.round(angle / (2.0 * math.pi))
    return angle - 2.0 * math.pi * turns
