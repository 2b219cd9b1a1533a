"""Forward and inverse kinematics of a NAO's leg in closed form.

The origin of the sole frame is in the lower face of the foot, straight below the ankle; its x axis points to
the toes. `joint_pos` (6,) is (hip yaw-pitch, hip roll, hip pitch, knee, ankle pitch, ankle roll) with the
signs of `nao_geometry`. A side is `LEFT` or `RIGHT`, or any traced +1 / -1.

With Rx, Ry, Rz for rotations about fixed axes, s for the side and q1..q6 for the joints, the leg is::

    R_torso_thigh = Rx(45 s deg) Rz(-s q1) Rx(q2 - 45 s deg) Ry(-q3)
    R_torso_sole = R_torso_thigh Ry(-q4 - q5) Rx(q6)

because the hip yaw-pitch axis, (0, 1, -s) / sqrt 2, is the z axis turned by 45 degrees about x.
"""

from math import atan2, cos, hypot, pi, sqrt
from typing import NamedTuple

import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from creps_jax import checks
from creps_jax.numerics.rotations import rigid_transform, rotation_x, rotation_y, rotation_z, safe_arctan2
from creps_jax.robots.nao_geometry import LEFT, RIGHT, NaoGeometry, leg_indices
from creps_jax.robots.robot import NAO, NaoRobot
from creps_jax.typing import Scalar, ScalarLike

__all__ = ["MAX_REACH", "MIN_REACH", "leg_fk", "leg_ik", "leg_reach"]

_HIP_TILT = pi / 4.0


class _Links(NamedTuple):
    """A leg in its plane: two straight links, and the angle between them at a knee angle of 0."""

    thigh: float
    shank: float
    bend_at_zero: float

    def distance(self, knee: float) -> float:
        """Return the distance between hip and ankle pitch axis at an angle of the knee."""
        bend = self.bend_at_zero - knee
        return sqrt(self.thigh**2 + self.shank**2 + 2.0 * self.thigh * self.shank * cos(bend))


def leg_links(robot: NaoRobot) -> _Links:
    """Return the links of a leg of a robot, m and rad."""
    forward, down = robot.geometry.thigh_forward, robot.geometry.thigh_down
    return _Links(hypot(forward, down), robot.geometry.shank_down, atan2(forward, down))


def leg_reach(robot: NaoRobot = NAO) -> tuple[float, float]:
    """Return the least and the largest distance (m) between a robot's hip and its ankle pitch axis.

    The distance is least with the knee at its lower limit, fully bent, and largest at its upper limit,
    stretched.
    """
    knee = leg_indices(LEFT).start + 3
    links = leg_links(robot)
    return links.distance(robot.joint_lower[knee]), links.distance(robot.joint_upper[knee])


MIN_REACH, MAX_REACH = leg_reach()
"""The least and the largest distance of `leg_reach` for the simulated NAO, m."""

# Within this height (m) of the plane through the ankle roll axis and the foot's y axis, the roll angle passes
# continuously through 0, where the exact angle jumps by half a turn. The hip is so near to this plane only if
# the leg is folded.
_ROLL_FOLD = 0.003

_TINY = 1e-8


@checks.arguments
def leg_fk(joint_pos: Float[Array, "6"], side: ScalarLike, *, robot: NaoRobot = NAO) -> Float[Array, "4 4"]:
    """Return the pose of the sole in the torso frame, `T_torso_sole`.

    Args:
        joint_pos: the six joint angles of the leg (rad).
        side: `LEFT` (+1) or `RIGHT` (-1).
        robot: the robot.

    Raises:
        ValueError: If there are not six finite angles, or `side` is neither `LEFT` nor `RIGHT`.
    """
    checks.finite("joint_pos", joint_pos)
    side = _checked_side(side, joint_pos.dtype)
    g = robot.geometry
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
        _hip_position(side, g)
        + g.thigh_forward * R_torso_thigh[:, 0]
        - g.thigh_down * R_torso_thigh[:, 2]
        - g.shank_down * R_torso_shank[:, 2]
        - g.ankle_drop * R_torso_ankle[:, 2]
        - g.foot_down * R_torso_sole[:, 2]
    )
    return rigid_transform(R_torso_sole, position)


@checks.arguments
def leg_ik(
    T_torso_sole: Float[Array, "4 4"],
    side: ScalarLike,
    *,
    robot: NaoRobot = NAO,
    yaw_pitch: ScalarLike | None = None,
) -> Float[Array, "6"]:
    """Return the joint angles for a pose of the sole in the torso frame, the inverse of `leg_fk`.

    The solution is exact for every pose within the joint limits, except for a folded leg whose hip is within
    3 mm of the foot's plane through the ankle roll axis (1 % of all postures within the limits). There the
    angles differ from those of the posture, and the error of the pose is up to 1 mm. If a pose is too far
    from the hip or too near, the foot keeps its orientation, and the leg is limited to its reach on the line
    from the ankle pitch axis to the hip. The knee stays within its limits; the other angles are not clipped.

    Angles and gradients are finite for any pose. The angles are continuous at the reach. They jump only where
    they are not determined, beyond the joint limits: with the hip at the ankle, with the hip straight below
    the foot's ankle, and with the hip yaw-pitch axis in line with the pitch axis (hip roll 45 degrees
    inward).

    If the hip yaw-pitch is given, because both legs share its motor, position and plane of the sole are
    exact, and the toes turn within that plane.

    Args:
        T_torso_sole: desired pose of the sole in the torso frame (m).
        side: `LEFT` (+1) or `RIGHT` (-1).
        robot: the robot.
        yaw_pitch: hip yaw-pitch (rad), for a robot whose ankle axes meet; by default that of the pose.

    Raises:
        ValueError: If the pose is not a finite matrix (4, 4), `side` is neither `LEFT` nor `RIGHT`, or
            `yaw_pitch` is given for a robot whose ankle axes do not meet.
    """
    checks.finite("T_torso_sole", T_torso_sole)
    side = _checked_side(side, T_torso_sole.dtype)
    g, links, reach = robot.geometry, leg_links(robot), leg_reach(robot)
    if yaw_pitch is not None:
        if g.ankle_drop != 0.0:
            raise ValueError(f"yaw_pitch must be None for a robot of ankle_drop above 0, got {yaw_pitch!r}")
        yaw_pitch = jnp.asarray(checks.number("yaw_pitch", yaw_pitch), T_torso_sole.dtype)
        return _solve_with_yaw_pitch(T_torso_sole, side, yaw_pitch, robot)
    R_torso_sole, position = T_torso_sole[:3, :3], T_torso_sole[:3, 3]

    # The pitch joints move the hip in the xz plane of the ankle; the roll turns the hip into that plane.
    hip_x, hip_y, hip_z = R_torso_sole.T @ (_hip_position(side, g) - position)
    hip_z = hip_z - g.foot_down
    height = jnp.maximum(jnp.abs(hip_z), _ROLL_FOLD)
    ankle_roll = jnp.arctan2(hip_y * jnp.clip(hip_z / _ROLL_FOLD, -1.0, 1.0), height)
    hip_z_in_plane = jnp.cos(ankle_roll) * hip_z + jnp.sin(ankle_roll) * hip_y
    knee, ankle_pitch = _solve_plane(hip_x, hip_z_in_plane - g.ankle_drop, links, reach)

    R_torso_thigh = R_torso_sole @ rotation_x(-ankle_roll) @ rotation_y(knee + ankle_pitch)
    hip = _solve_hip(R_torso_thigh, side)
    return jnp.stack([*hip, knee, ankle_pitch, ankle_roll])


def _solve_with_yaw_pitch(
    T_torso_sole: Float[Array, "4 4"], side: Scalar, yaw_pitch: Scalar, robot: NaoRobot
) -> Float[Array, "6"]:
    """Return the joint angles for a given hip yaw-pitch, which turns the sole in its plane.

    Hip roll, hip pitch and knee place the ankle; the two joints of the ankle align the sole with its plane.
    """
    up, position = T_torso_sole[:3, 2], T_torso_sole[:3, 3]
    tilt = side * _HIP_TILT
    R_torso_pelvis = rotation_x(tilt) @ rotation_z(-side * yaw_pitch) @ rotation_x(-tilt)
    ankle = position + robot.geometry.foot_down * up - _hip_position(side, robot.geometry)
    x, y, z = R_torso_pelvis.T @ ankle
    hip_roll = safe_arctan2(y, -z)
    # Solved for a sole perpendicular to the leg's plane; knee and ankle turn the thigh from there.
    knee, square = _solve_plane(
        -x, jnp.sin(hip_roll) * y - jnp.cos(hip_roll) * z, leg_links(robot), leg_reach(robot)
    )
    R_torso_shank = R_torso_pelvis @ rotation_x(hip_roll) @ rotation_y(square)
    x, y, z = R_torso_shank.T @ up
    ankle_pitch = safe_arctan2(-x, z)
    ankle_roll = jnp.arctan2(-y, jnp.cos(ankle_pitch) * z - jnp.sin(ankle_pitch) * x)
    return jnp.stack([yaw_pitch, hip_roll, -knee - square, knee, ankle_pitch, ankle_roll])


def _solve_plane(
    hip_x: Scalar, hip_z: Scalar, links: _Links, reach: tuple[float, float]
) -> tuple[Scalar, Scalar]:
    """Return knee and ankle pitch from the position of the hip ahead of and above the ankle pitch axis.

    The knee bends in one direction only, which selects one of the two triangles. The distance is first
    clipped to the reach; this also keeps the argument of arccos away from its ends, where the gradient is
    infinite.
    """
    thigh, shank, bend_at_zero = links
    distance = jnp.clip(jnp.sqrt(jnp.maximum(hip_x**2 + hip_z**2, _TINY)), *reach)
    bend = jnp.arccos((distance**2 - thigh**2 - shank**2) / (2.0 * thigh * shank))
    shank_to_hip = jnp.arctan2(thigh * jnp.sin(bend), shank + thigh * jnp.cos(bend))
    return bend_at_zero - bend, safe_arctan2(hip_x, hip_z) + shank_to_hip


def _solve_hip(R_torso_thigh: Float[Array, "3 3"], side: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return hip yaw-pitch, roll and pitch of a thigh orientation.

    ``Rx(-45 s deg) R_torso_thigh`` is ``Rz(first) Rx(second) Ry(third)``. The first angle may be
    undetermined. The other two are computed after its rotation is removed, which is always well conditioned.
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


def _hip_position(side: Scalar, geometry: NaoGeometry) -> Float[Array, "3"]:
    """Return the point in the torso frame where the three hip axes meet (m)."""
    x, y, z = geometry.hip_x, geometry.hip_y, geometry.hip_z
    return jnp.stack([jnp.full_like(side, x), side * y, jnp.full_like(side, z)])
