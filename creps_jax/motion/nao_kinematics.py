"""Relate the NAO's leg joints to the pose of its sole, both ways in closed form.

A sole frame lies in the lower face of the foot, straight below the ankle, x towards the toes. `joint_pos`
(6,) is (hip yaw-pitch, hip roll, hip pitch, knee, ankle pitch, ankle roll) with the signs of `nao_geometry`.
A side is `LEFT` or `RIGHT`, or any traced +1 / -1.

With Rx, Ry, Rz for rotations about fixed axes, s for the side and q1..q6 for the joints, the leg is::

    R_torso_thigh = Rx(45 s deg) Rz(-s q1) Rx(q2 - 45 s deg) Ry(-q3)
    R_torso_sole = R_torso_thigh Ry(-q4 - q5) Rx(q6)

because the hip yaw-pitch axis, (0, 1, -s) / sqrt 2, is the z axis turned by 45 degrees about x.
"""

from math import atan2, cos, hypot, pi, sqrt

import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from creps_jax import checks
from creps_jax.motion.nao_geometry import GEOMETRY, JOINT_LOWER, JOINT_UPPER, LEFT, RIGHT, leg_indices
from creps_jax.rotations import rigid_transform, rotation_x, rotation_y, rotation_z, safe_arctan2
from creps_jax.typing import Scalar, ScalarLike

__all__ = ["MAX_REACH", "MIN_REACH", "leg_fk", "leg_ik"]

_HIP_TILT = pi / 4.0

# The leg in its own plane: two straight links, and the bend between them at a knee angle of 0.
_THIGH = hypot(GEOMETRY.thigh_forward, GEOMETRY.thigh_down)
_SHANK = GEOMETRY.shank_down
_BEND_AT_ZERO = atan2(GEOMETRY.thigh_forward, GEOMETRY.thigh_down)


def _link_distance(bend: float) -> float:
    """Return the distance of hip and ankle pitch axis when thigh and shank make this angle."""
    return sqrt(_THIGH**2 + _SHANK**2 + 2.0 * _THIGH * _SHANK * cos(bend))


_KNEE = leg_indices(LEFT).start + 3
MIN_REACH: float = _link_distance(_BEND_AT_ZERO - JOINT_LOWER[_KNEE])
"""Distance (m) of the hip and the ankle pitch axis with the knee at its lower limit, fully bent."""

MAX_REACH: float = _link_distance(_BEND_AT_ZERO - JOINT_UPPER[_KNEE])
"""Distance (m) of the hip and the ankle pitch axis with the knee at its upper limit, stretched."""

# Within this height (m) of the plane through the ankle roll axis and the foot's y axis, the roll angle runs
# through 0 from one side of the plane to the other, where the exact one would jump by half a turn. Only a
# folded leg brings the hip so near.
_ROLL_FOLD = 0.003

_TINY = 1e-8


@checks.arguments
def leg_fk(joint_pos: Float[Array, "6"], side: ScalarLike) -> Float[Array, "4 4"]:
    """Return the pose of the sole in the torso frame, `T_torso_sole`.

    Args:
        joint_pos: the six joint angles of the leg (rad).
        side: `LEFT` (+1) or `RIGHT` (-1).

    Raises:
        ValueError: If there are not six finite angles, or `side` is neither side.
    """
    checks.finite("joint_pos", joint_pos)
    side = _checked_side(side, joint_pos.dtype)
    yaw_pitch, hip_roll, hip_pitch, knee, ankle_pitch, ankle_roll = joint_pos
    tilt = side * _HIP_TILT
    R_torso_thigh = (
        rotation_x(tilt)
        @ rotation_z(-side * yaw_pitch)
        @ rotation_x(hip_roll - tilt)
        @ rotation_y(-hip_pitch)
    )
    R_torso_shank = R_torso_thigh @ rotation_y(-knee)
    R_torso_ankle = R_torso_shank @ rotation_y(-ankle_pitch)
    R_torso_sole = R_torso_ankle @ rotation_x(ankle_roll)
    position = (
        _hip_position(side)
        + GEOMETRY.thigh_forward * R_torso_thigh[:, 0]
        - GEOMETRY.thigh_down * R_torso_thigh[:, 2]
        - GEOMETRY.shank_down * R_torso_shank[:, 2]
        - GEOMETRY.ankle_drop * R_torso_ankle[:, 2]
        - GEOMETRY.foot_down * R_torso_sole[:, 2]
    )
    return rigid_transform(R_torso_sole, position)


@checks.arguments
def leg_ik(T_torso_sole: Float[Array, "4 4"], side: ScalarLike) -> Float[Array, "6"]:
    """Return the joint angles that bring the sole to a pose in the torso frame, the inverse of `leg_fk`.

    The solution is exact for every pose within the joint limits (but see `_ROLL_FOLD`). A pose too far from
    the hip, or too near, keeps its foot orientation, and the leg is held at its reach on the line from the
    ankle pitch axis to the hip. The knee stays within its limits; the other angles are not clipped.

    Angles and gradients are finite for any pose. The angles are continuous through the reach; jumps are left
    where they are not determined, beyond the joint limits: the hip at the ankle, the hip straight below the
    foot's ankle, and the hip yaw-pitch axis in line with the pitch axis (hip roll 45 degrees inward).

    Args:
        T_torso_sole: wanted pose of the sole in the torso frame (m).
        side: `LEFT` (+1) or `RIGHT` (-1).

    Raises:
        ValueError: If the pose is no finite matrix (4, 4), or `side` is neither side.
    """
    checks.finite("T_torso_sole", T_torso_sole)
    side = _checked_side(side, T_torso_sole.dtype)
    R_torso_sole, position = T_torso_sole[:3, :3], T_torso_sole[:3, 3]

    # The pitch joints move the hip within the xz plane of the ankle; the roll turns the hip into that plane.
    hip_x, hip_y, hip_z = R_torso_sole.T @ (_hip_position(side) - position)
    hip_z = hip_z - GEOMETRY.foot_down
    height = jnp.maximum(jnp.abs(hip_z), _ROLL_FOLD)
    ankle_roll = jnp.arctan2(hip_y * jnp.clip(hip_z / _ROLL_FOLD, -1.0, 1.0), height)
    hip_z_in_plane = jnp.cos(ankle_roll) * hip_z + jnp.sin(ankle_roll) * hip_y
    knee, ankle_pitch = _solve_plane(hip_x, hip_z_in_plane - GEOMETRY.ankle_drop)

    R_torso_thigh = R_torso_sole @ rotation_x(-ankle_roll) @ rotation_y(knee + ankle_pitch)
    hip = _solve_hip(R_torso_thigh, side)
    return jnp.stack([*hip, knee, ankle_pitch, ankle_roll])


def _solve_plane(hip_x: Scalar, hip_z: Scalar) -> tuple[Scalar, Scalar]:
    """Return knee and ankle pitch from the hip's place before and above the ankle pitch axis.

    The knee bends one way only, which picks one of the two triangles. The distance is first clipped to the
    reach; this also keeps the law of cosines away from the ends of arccos, where its gradient is infinite.
    """
    distance = jnp.clip(jnp.sqrt(jnp.maximum(hip_x**2 + hip_z**2, _TINY)), MIN_REACH, MAX_REACH)
    bend = jnp.arccos((distance**2 - _THIGH**2 - _SHANK**2) / (2.0 * _THIGH * _SHANK))
    shank_to_hip = jnp.arctan2(_THIGH * jnp.sin(bend), _SHANK + _THIGH * jnp.cos(bend))
    return _BEND_AT_ZERO - bend, safe_arctan2(hip_x, hip_z) + shank_to_hip


def _solve_hip(R_torso_thigh: Float[Array, "3 3"], side: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return hip yaw-pitch, roll and pitch of a thigh orientation.

    ``Rx(-45 s deg) R_torso_thigh`` is ``Rz(first) Rx(second) Ry(third)``. The first angle may be
    undetermined; the other two are read after it has been taken out, which is always well conditioned.
    """
    tilt = side * _HIP_TILT
    rotation = rotation_x(-tilt) @ R_torso_thigh
    first = safe_arctan2(-rotation[0, 1], rotation[1, 1])
    c, s = jnp.cos(first), jnp.sin(first)
    second = jnp.arctan2(rotation[2, 1], c * rotation[1, 1] - s * rotation[0, 1])
    third = jnp.arctan2(c * rotation[0, 2] + s * rotation[1, 2], c * rotation[0, 0] + s * rotation[1, 0])
    return -side * first, second + tilt, -third


def _checked_side(side: ScalarLike, dtype: jnp.dtype) -> Array:
    if not isinstance(side, Tracer) and side not in (LEFT, RIGHT):
        raise ValueError(f"side must be LEFT ({LEFT}) or RIGHT ({RIGHT}), got {side!r}")
    return jnp.asarray(side, dtype)


def _hip_position(side: Scalar) -> Float[Array, "3"]:
    """Return the point in the torso frame where the three hip axes meet (m)."""
    return jnp.stack(
        [jnp.full_like(side, GEOMETRY.hip_x), side * GEOMETRY.hip_y, jnp.full_like(side, GEOMETRY.hip_z)]
    )
