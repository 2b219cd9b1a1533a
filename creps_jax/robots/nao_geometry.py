"""Lengths, joint order and joint limits of the simulated NAO; only its model file repeats them.

The robot is the NAO of type 0 of the RoboCup 3D simulation; `models/nao/SOURCE.md` names the source of each
value. Lengths are in metres in the torso frame at the zero pose (legs straight, arms stretched forward):
x forward, y left, z up, origin in the centre of the torso. Angles are in radians.

A side is a number, `LEFT = 1.0` or `RIGHT = -1.0`, the sign of y: multiplication by it mirrors, and functions
of a side can be vmapped over both legs.
"""

from math import radians
from typing import NamedTuple

from creps_jax import checks

__all__ = [
    "GEOMETRY",
    "JOINT_LOWER",
    "JOINT_NAMES",
    "JOINT_UPPER",
    "LEFT",
    "MAX_JOINT_SPEED",
    "MAX_JOINT_TORQUE",
    "NUM_JOINTS",
    "RIGHT",
    "NaoGeometry",
    "leg_indices",
]

LEFT = 1.0
"""The left side."""

RIGHT = -1.0
"""The right side."""


class NaoGeometry(NamedTuple):
    """Lengths (m) of the left side; on the right side `_y` has the opposite sign.

    The three hip axes meet in one point. At the zero pose knee and ankle are `thigh_forward` ahead of the
    hip. The two axes of the ankle need not meet: the roll axis is `ankle_drop` below the pitch axis. The
    defaults are the lengths of the simulated NAO.

    Attributes:
        hip_x: From the centre of the torso to the hip joints, forward.
        hip_y: From the centre of the torso to the hip joints, to the side.
        hip_z: From the centre of the torso to the hip joints, upward.
        thigh_forward: From hip to knee, forward.
        thigh_down: From hip to knee, downward.
        shank_down: From knee to ankle pitch axis, downward.
        ankle_drop: From ankle pitch axis to ankle roll axis, downward.
        foot_down: From ankle roll axis to sole, downward.
        foot_front: From ankle to the front edge of the sole.
        foot_back: From ankle to the rear edge of the sole, negative.
        foot_inner: From ankle to the inner edge of the sole.
        foot_outer: From ankle to the outer edge of the sole.
        shoulder_y: From the centre of the torso to the shoulder joints, to the side.
        shoulder_z: From the centre of the torso to the shoulder joints, upward.
        elbow_forward: From shoulder to elbow, forward, with the arm stretched forward.
        elbow_out: From shoulder to elbow, to the side.
        elbow_up: From shoulder to elbow, upward.
        neck_z: From the centre of the torso to the neck, upward.
        head_pitch_z: From the centre of the torso to the head pitch axis, upward.
    """

    hip_x: float = -0.010
    hip_y: float = 0.055
    hip_z: float = -0.115
    thigh_forward: float = 0.005
    thigh_down: float = 0.120
    shank_down: float = 0.100
    ankle_drop: float = 0.005
    foot_down: float = 0.045
    foot_front: float = 0.110
    foot_back: float = -0.050
    foot_inner: float = 0.040
    foot_outer: float = 0.040
    shoulder_y: float = 0.098
    shoulder_z: float = 0.075
    elbow_forward: float = 0.090
    elbow_out: float = 0.0
    elbow_up: float = 0.009
    neck_z: float = 0.090
    head_pitch_z: float = 0.150

    @property
    def ankle_height(self) -> float:
        """Height of the ankle pitch axis above the sole."""
        return self.ankle_drop + self.foot_down

    @property
    def torso_height(self) -> float:
        """Height of the centre of the torso above the sole at the zero pose."""
        return -self.hip_z + self.thigh_down + self.shank_down + self.ankle_height


GEOMETRY = NaoGeometry()
"""The lengths of the simulated NAO."""

_HEAD = ("head_yaw", "head_pitch")
_ARM = ("shoulder_pitch", "shoulder_yaw", "arm_roll", "elbow")
_LEG = ("hip_yaw_pitch", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")

JOINT_NAMES: tuple[str, ...] = (
    *_HEAD,
    *(f"{side}_{joint}" for part in (_ARM, _LEG) for side in ("left", "right") for joint in part),
)
"""The order of every joint vector: head 2, left arm 4, right arm 4, left leg 6, right leg 6."""

NUM_JOINTS = len(JOINT_NAMES)
"""Length of every joint vector."""

# Degrees, in the order above, with the signs of the simulator: positive hip pitch moves the leg forward, the
# knee bends with a negative angle, positive ankle pitch lifts the toes, positive shoulder pitch lifts the arm
# (it hangs at -90), positive head pitch looks up, roll and yaw are right-handed about x and z. A negative hip
# yaw-pitch turns the toes outward and moves the leg forward.
_HEAD_RANGES = ((-120.0, 120.0), (-45.0, 45.0))
_LEFT_ARM_RANGES = ((-120.0, 120.0), (-1.0, 95.0), (-120.0, 120.0), (-90.0, 1.0))
_RIGHT_ARM_RANGES = ((-120.0, 120.0), (-95.0, 1.0), (-120.0, 120.0), (-1.0, 90.0))
_LEFT_LEG_RANGES = ((-90.0, 1.0), (-25.0, 45.0), (-25.0, 100.0), (-130.0, 1.0), (-45.0, 75.0), (-45.0, 25.0))
_RIGHT_LEG_RANGES = ((-90.0, 1.0), (-45.0, 25.0), (-25.0, 100.0), (-130.0, 1.0), (-45.0, 75.0), (-25.0, 45.0))
_RANGES = _HEAD_RANGES + _LEFT_ARM_RANGES + _RIGHT_ARM_RANGES + _LEFT_LEG_RANGES + _RIGHT_LEG_RANGES

JOINT_LOWER: tuple[float, ...] = tuple(radians(low) for low, _ in _RANGES)
"""Lower joint limits (rad)."""

JOINT_UPPER: tuple[float, ...] = tuple(radians(high) for _, high in _RANGES)
"""Upper joint limits (rad)."""

MAX_JOINT_SPEED = radians(351.77)
"""Largest speed of every joint (rad/s)."""

MAX_JOINT_TORQUE = 10.0
"""Largest torque of every motor (N m)."""


@checks.arguments
def leg_indices(side: float | int) -> slice:
    """Return the indices of the six joints of a leg in a joint vector, in the order of `JOINT_NAMES`.

    Args:
        side: `LEFT` or `RIGHT`.

    Raises:
        ValueError: If `side` is neither `LEFT` nor `RIGHT`.
    """
    if side not in (LEFT, RIGHT):
        raise ValueError(f"side must be LEFT ({LEFT}) or RIGHT ({RIGHT}), got {side!r}")
    start = len(_HEAD) + 2 * len(_ARM) + (0 if side == LEFT else len(_LEG))
    return slice(start, start + len(_LEG))
