"""The humanoids that can walk: lengths, joint limits, and limits of the motors.

All have the joints of the simulated NAO, in the order and with the signs and frames of `nao_geometry`.
"""

import dataclasses
from collections.abc import Mapping
from math import radians

from creps_jax.robots.nao_geometry import (
    GEOMETRY,
    JOINT_LOWER,
    JOINT_NAMES,
    JOINT_UPPER,
    MAX_JOINT_SPEED,
    MAX_JOINT_TORQUE,
    NUM_JOINTS,
    NaoGeometry,
)

__all__ = ["NAO", "NAO_H25", "ROBOTS", "Robot"]


@dataclasses.dataclass(frozen=True)
class Robot:
    """The properties of a humanoid that kinematics and walking engine use.

    The three hip axes must meet in one point, and the knee must bend with a negative angle, see
    `nao_kinematics`.

    Attributes:
        name: Name of the robot and of its folder in `models`.
        geometry: Lengths.
        joint_lower: Lower limit of each joint, in the order of `nao_geometry.JOINT_NAMES`, rad.
        joint_upper: Upper limits, rad.
        max_joint_speed: Largest speed of each joint, rad/s.
        max_joint_torque: Largest torque of each joint, N m.
        com_above_hip: Height of the centre of mass above the middle of the hips, knees bent, m.
        com_ahead_of_hip: Forward distance of the centre of mass from the middle of the hips, m.
        zmp_ahead_of_ankle: Forward distance of the planned zero moment point from the ankle of a foot, m.
        has_one_yaw_motor: Whether one motor drives the hip yaw-pitch of both legs, which are then equal.
        own_names: Names of the joints in the robot's own software, in the order of
            `nao_geometry.JOINT_NAMES`.
        own_signs: +1 or -1 for each joint: angles times these have the signs of the robot's own software.

    Raises:
        ValueError: If there is not one limit, speed or torque for each joint, limits are not in order, or
            the legs share a motor although the ankle axes do not meet: `leg_ik` has no solution then.
    """

    name: str
    geometry: NaoGeometry
    joint_lower: tuple[float, ...]
    joint_upper: tuple[float, ...]
    max_joint_speed: tuple[float, ...]
    max_joint_torque: tuple[float, ...]
    com_above_hip: float
    com_ahead_of_hip: float
    zmp_ahead_of_ankle: float
    has_one_yaw_motor: bool = False
    own_names: tuple[str, ...] = JOINT_NAMES
    own_signs: tuple[float, ...] = (1.0,) * NUM_JOINTS

    def __post_init__(self) -> None:
        for name in (
            "joint_lower",
            "joint_upper",
            "max_joint_speed",
            "max_joint_torque",
            "own_names",
            "own_signs",
        ):
            if len(getattr(self, name)) != NUM_JOINTS:
                raise ValueError(f"{name} must have {NUM_JOINTS} entries, got {len(getattr(self, name))}")
        for name, low, high in zip(JOINT_NAMES, self.joint_lower, self.joint_upper, strict=True):
            if not low < high:
                raise ValueError(f"the lower limit of {name} must be below the upper, got {low} and {high}")
        if self.has_one_yaw_motor and self.geometry.ankle_drop != 0.0:
            raise ValueError(
                "legs that share a motor must have ankle axes that meet, ankle_drop 0, "
                f"got {self.geometry.ankle_drop}"
            )

    @property
    def foot_spacing(self) -> float:
        """Distance between the feet when standing, equal to that between the hips, m."""
        return 2.0 * self.geometry.hip_y


NAO = Robot(
    name="nao",
    geometry=GEOMETRY,
    joint_lower=JOINT_LOWER,
    joint_upper=JOINT_UPPER,
    max_joint_speed=(MAX_JOINT_SPEED,) * NUM_JOINTS,
    max_joint_torque=(MAX_JOINT_TORQUE,) * NUM_JOINTS,
    com_above_hip=0.025,
    com_ahead_of_hip=0.01,
    zmp_ahead_of_ankle=0.02,
)
"""The NAO of the RoboCup 3D simulation; `models/nao/SOURCE.md` names the sources of its values."""


def _both_sides(head: tuple, left_arm: tuple, left_leg: tuple) -> tuple:
    """Return values that are equal on both sides, in the order of the joints."""
    return (*head, *left_arm, *left_arm, *left_leg, *left_leg)


# Degrees. The right side mirrors the left one: rolls and yaws have the opposite sign.
_H25_HEAD = ((-119.5, 119.5), (-29.5, 38.5))
_H25_LEFT_ARM = ((-119.5, 119.5), (-18.0, 76.0), (-119.5, 119.5), (-88.5, -2.0))
_H25_RIGHT_ARM = ((-119.5, 119.5), (-76.0, 18.0), (-119.5, 119.5), (2.0, 88.5))
_H25_YAW_PITCH = (-65.62, 42.44)
_H25_PITCHES = ((-27.73, 88.0), (-121.04, 5.29), (-52.86, 68.15))
_H25_LEFT_LEG = (_H25_YAW_PITCH, (-21.74, 45.29), *_H25_PITCHES, (-22.79, 44.06))
_H25_RIGHT_LEG = (_H25_YAW_PITCH, (-45.29, 21.74), *_H25_PITCHES, (-44.06, 22.79))
_H25_RANGES = (*_H25_HEAD, *_H25_LEFT_ARM, *_H25_RIGHT_ARM, *_H25_LEFT_LEG, *_H25_RIGHT_LEG)

# The names of Aldebaran's SDK, and its signs, which are opposite to those of the simulation for some joints.
_H25_OWN = {
    "head_yaw": ("HeadYaw", 1.0),
    "head_pitch": ("HeadPitch", -1.0),
    "shoulder_pitch": ("ShoulderPitch", -1.0),
    "shoulder_yaw": ("ShoulderRoll", 1.0),
    "arm_roll": ("ElbowYaw", 1.0),
    "elbow": ("ElbowRoll", 1.0),
    "hip_yaw_pitch": ("HipYawPitch", 1.0),
    "hip_roll": ("HipRoll", 1.0),
    "hip_pitch": ("HipPitch", -1.0),
    "knee": ("KneePitch", -1.0),
    "ankle_pitch": ("AnklePitch", -1.0),
    "ankle_roll": ("AnkleRoll", 1.0),
}


def _h25_own(joint: str) -> tuple[str, float]:
    """Return name and sign of a joint of the real NAO in its own software."""
    side, _, part = joint.partition("_")
    if side not in ("left", "right"):
        return _H25_OWN[joint]
    name, sign = _H25_OWN[part]
    return side[0].upper() + name, sign


NAO_H25 = Robot(
    name="nao_h25",
    geometry=NaoGeometry(
        hip_x=0.0,
        hip_y=0.050,
        hip_z=-0.085,
        thigh_forward=0.0,
        thigh_down=0.100,
        shank_down=0.1029,
        ankle_drop=0.0,
        foot_down=0.04511,
        foot_front=0.100,
        foot_back=-0.050,
        foot_inner=0.039,
        foot_outer=0.050,
        shoulder_y=0.098,
        shoulder_z=0.100,
        elbow_forward=0.105,
        elbow_out=0.015,
        elbow_up=0.0,
        neck_z=0.1265,
        head_pitch_z=0.1265,
    ),
    joint_lower=tuple(radians(low) for low, _ in _H25_RANGES),
    joint_upper=tuple(radians(high) for _, high in _H25_RANGES),
    max_joint_speed=_both_sides((8.27, 7.19), (8.27, 7.19, 8.27, 7.19), (4.16, 4.16, 6.40, 6.40, 6.40, 4.16)),
    max_joint_torque=_both_sides((1.55, 1.53), (1.33, 1.78, 1.55, 1.53), (2.5, 5.0, 5.0, 5.0, 5.0, 5.0)),
    com_above_hip=0.037,
    com_ahead_of_hip=0.01,
    zmp_ahead_of_ankle=0.02,
    has_one_yaw_motor=True,
    own_names=tuple(_h25_own(name)[0] for name in JOINT_NAMES),
    own_signs=tuple(_h25_own(name)[1] for name in JOINT_NAMES),
)
"""The real NAO, H25; `models/nao_h25/SOURCE.md` names the sources of its values.

One motor drives the yaw-pitch of both hips; the joint of each leg has half of its torque.
"""

ROBOTS: Mapping[str, Robot] = {robot.name: robot for robot in (NAO, NAO_H25)}
"""The robots by name."""
