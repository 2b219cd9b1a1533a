"""The humanoids that can walk: lengths, joint limits, and limits of the motors.

`creps_jax.robots.mjcf` makes such a record of any humanoid from its MuJoCo model.
"""

import dataclasses
from collections.abc import Mapping
from math import radians

from creps_jax.robots.nao_geometry import (
    GEOMETRY,
    JOINT_LOWER,
    JOINT_NAMES,
    JOINT_UPPER,
    LEFT,
    MAX_JOINT_SPEED,
    MAX_JOINT_TORQUE,
    NUM_JOINTS,
    RIGHT,
    NaoGeometry,
    leg_indices,
)

__all__ = ["GRAVITY", "NAO", "NAO_H25", "NAO_LEG_LENGTH", "ROBOTS", "NaoRobot", "Robot"]

GRAVITY = 9.81
"""Acceleration of gravity, m/s^2."""

NAO_LEG_LENGTH = GEOMETRY.thigh_down + GEOMETRY.shank_down
"""Distance from hip to ankle of the simulated NAO, m: lengths and times of a walk scale with the leg."""

# How a NAO holds its head (2 joints) and its left and right arm (4 joints each), how it bends its legs (6
# joints each), and how its shoulders swing against the legs.
_POSTURE = (
    *(0.0, 0.0),
    *(-1.6, 0.1, -1.57, -0.6),
    *(-1.6, -0.1, 1.57, 0.6),
    *((0.0, 0.0, 0.6, -1.1, 0.5, 0.0) * 2),
)
_ARM_SWING = (0.0, 0.0, -5.0, 0.0, 0.0, 0.0, 5.0, *((0.0,) * 15))


def _indices(joints: slice) -> tuple[int, ...]:
    return tuple(range(joints.start, joints.stop))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Robot:
    """The properties of a humanoid that the walking engine uses.

    A joint vector holds the angle of each joint in the order of `joint_names`, rad. Lengths are in metres, in
    the frame of the trunk: x forward, y left, z up.

    Attributes:
        name: Name of the robot.
        joint_names: Names of the joints.
        joint_lower: Lower limit of each joint, rad.
        joint_upper: Upper limits, rad.
        max_joint_speed: Largest speed of each joint, rad/s.
        max_joint_torque: Largest torque of each joint, N m.
        left_leg: Index of each joint of the left leg, from hip to ankle, in a joint vector.
        right_leg: Those of the right leg.
        posture: Angles with the knees bent and the feet below the hips, whatever `foot_spacing` is, rad; the
            other joints as they are held.
        arm_swing: Change of each angle for each metre that the left foot is ahead of the right one, rad/m.
        hip_centre: Position (x, z) of the middle of the hips.
        leg_length: Distance from hip to ankle of a straight leg.
        foot_spacing: Distance between the feet when standing.
        ankle_height: Height of the ankle above the sole.
        torso_height: Height of the origin of the trunk above the sole with straight legs.
        com_above_hip: Height of the centre of mass above the middle of the hips, knees bent.
        com_ahead_of_hip: Forward distance of the centre of mass from the middle of the hips.
        zmp_ahead_of_ankle: Forward distance of the planned zero moment point from the ankle of a foot.
        own_names: Names of the joints in the robot's own software.
        own_signs: +1 or -1 for each joint: angles times these have the signs of the robot's own software.

    Raises:
        ValueError: If there is not one value for each joint, or limits are not in order.
    """

    name: str
    joint_names: tuple[str, ...]
    joint_lower: tuple[float, ...]
    joint_upper: tuple[float, ...]
    max_joint_speed: tuple[float, ...]
    max_joint_torque: tuple[float, ...]
    left_leg: tuple[int, ...]
    right_leg: tuple[int, ...]
    posture: tuple[float, ...]
    arm_swing: tuple[float, ...]
    hip_centre: tuple[float, float]
    leg_length: float
    foot_spacing: float
    ankle_height: float
    torso_height: float
    com_above_hip: float
    com_ahead_of_hip: float
    zmp_ahead_of_ankle: float
    own_names: tuple[str, ...]
    own_signs: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check that there is one value for each joint."""
        for name in (
            "joint_lower",
            "joint_upper",
            "max_joint_speed",
            "max_joint_torque",
            "posture",
            "arm_swing",
            "own_names",
            "own_signs",
        ):
            if len(getattr(self, name)) != self.num_joints:
                raise ValueError(
                    f"{name} must have {self.num_joints} entries, got {len(getattr(self, name))}"
                )
        for name, low, high in zip(self.joint_names, self.joint_lower, self.joint_upper, strict=True):
            if not low < high:
                raise ValueError(f"the lower limit of {name} must be below the upper, got {low} and {high}")

    @property
    def num_joints(self) -> int:
        """Length of a joint vector."""
        return len(self.joint_names)

    @property
    def size(self) -> float:
        """Length of a leg, relative to that of the simulated NAO."""
        return self.leg_length / NAO_LEG_LENGTH


@dataclasses.dataclass(frozen=True, kw_only=True)
class NaoRobot(Robot):
    """A humanoid with the joints of the NAO, in the order and with the signs and frames of `nao_geometry`.

    The three hip axes must meet in one point, and the knee must bend with a negative angle, see
    `nao_kinematics`. What the lengths determine is computed from `geometry`.

    Attributes:
        geometry: Lengths.
        has_one_yaw_motor: Whether one motor drives the hip yaw-pitch of both legs, which are then equal.

    Raises:
        ValueError: As for `Robot`, or if the legs share a motor although the ankle axes do not meet: `leg_ik`
            has no solution then.
    """

    geometry: NaoGeometry
    has_one_yaw_motor: bool = False
    own_names: tuple[str, ...] = JOINT_NAMES
    own_signs: tuple[float, ...] = (1.0,) * NUM_JOINTS
    joint_names: tuple[str, ...] = dataclasses.field(default=JOINT_NAMES, init=False)
    left_leg: tuple[int, ...] = dataclasses.field(default=_indices(leg_indices(LEFT)), init=False)
    right_leg: tuple[int, ...] = dataclasses.field(default=_indices(leg_indices(RIGHT)), init=False)
    posture: tuple[float, ...] = dataclasses.field(default=_POSTURE, init=False)
    arm_swing: tuple[float, ...] = dataclasses.field(default=_ARM_SWING, init=False)
    hip_centre: tuple[float, float] = dataclasses.field(init=False)
    leg_length: float = dataclasses.field(init=False)
    foot_spacing: float = dataclasses.field(init=False)
    ankle_height: float = dataclasses.field(init=False)
    torso_height: float = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        """Compute what follows from the lengths."""
        g = self.geometry
        for name, value in {
            "hip_centre": (g.hip_x, g.hip_z),
            "leg_length": g.thigh_down + g.shank_down,
            "foot_spacing": 2.0 * g.hip_y,
            "ankle_height": g.ankle_height,
            "torso_height": g.torso_height,
        }.items():
            object.__setattr__(self, name, value)
        super().__post_init__()
        if self.has_one_yaw_motor and g.ankle_drop != 0.0:
            raise ValueError(
                f"legs that share a motor must have ankle axes that meet, ankle_drop 0, got {g.ankle_drop}"
            )


NAO = NaoRobot(
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


NAO_H25 = NaoRobot(
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

ROBOTS: Mapping[str, NaoRobot] = {robot.name: robot for robot in (NAO, NAO_H25)}
"""The robots whose models come with the library, by name."""
