"""Make a walking humanoid from an MJCF file and a short description; the rest is derived from the model."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from creps_jax import checks
from creps_jax.robots import mjcf_legs, mjcf_model, mjcf_posture, mjcf_read, mjcf_settings, mjcf_soles
from creps_jax.robots.humanoid import Humanoid, LegChain
from creps_jax.robots.mjcf_legs import Leg
from creps_jax.robots.mjcf_servos import Servo, read_servos_of
from creps_jax.robots.mjcf_soles import Sole
from creps_jax.robots.robot import GRAVITY, NAO_LEG_LENGTH

__all__ = ["humanoid_from_mjcf"]

# Gains of the servos: stiffness relative to weight times leg, and the damping time for a NAO's leg, s.
# At a quarter of this stiffness robots of 20 to 33 kg fall in all gaits.
_STIFFNESS, _DAMPING_TIME = 10.0, 0.01
# The least stiffness, relative to this one.
_SOFTEST = 0.01
# Speeds of the simulated NAO, m/s; those of another robot have the same Froude number if they are not given.
_NAO_SPEEDS = (0.1, 0.5)
# Distance between the soles for a leg of the NAO's length, m.
_SOLE_CLEARANCE = 0.02


def humanoid_from_mjcf(
    path: Path | str,
    *,
    left_leg: Sequence[str],
    right_leg: Sequence[str],
    feet: Sequence[str],
    name: str | None = None,
    crouch: Sequence[float | int] | None = None,
    held: Mapping[str, float | int] | None = None,
    arm_swing: Mapping[str, float | int] | None = None,
    kp: float | int | None = None,
    kv: float | int | None = None,
    max_speed: float | int | Mapping[str, float | int] | None = None,
    max_torque: float | int | None = None,
    foot_spacing: float | int | None = None,
    speeds: Sequence[float | int] | None = None,
) -> Humanoid:
    """Read a humanoid from its MuJoCo model, so that it can walk.

    The trunk is the body with the free joint; it must face along x. From the model come the joint axes, the
    soles, the lengths, the centre of mass, and the limits of joints and motors. Each joint gets a position
    servo with the torque of all its actuators. Meshes take no part in contacts; the feet need a box, sphere,
    capsule, cylinder or ellipsoid. The world, the options, the constraints to the world and the gravity
    compensation of the file do not apply.

    Args:
        path: The MJCF file.
        left_leg: Names of the joints of the left leg, from the hip to the ankle; five or six.
        right_leg: Those of the right leg, which must mirror the left one.
        feet: Names of the left and the right foot body.
        name: Name of the robot, one line; by default that of the file.
        crouch: Angles of the left leg with bent knees, rad; by default knees bent forwards. Soles that are
            not level with all leg angles zero must be level with these, the feet pointing along x.
        held: Angles at which other joints are held, by name, rad; zero by default.
        arm_swing: Change of a joint's angle for each metre that the left foot is ahead of the right one, by
            name, rad/m; none by default.
        kp: Stiffness of the servos, N m/rad; by default ten times weight times leg, and at least a
            hundredth of it.
        kv: Damping of the servos, N m s/rad; by default `kp` times 0.01 s, times the square root of the leg's
            length relative to that of the NAO.
        max_speed: Largest speed of all joints, or of each by name, rad/s; 8 by default, at
            most 100.
        max_torque: Torque of the motors for which the model states no limit, N m.
        foot_spacing: Distance between the ankles when standing and walking, m; less than the length of the
            leg, and so large that the feet do not overlap. By default the soles of legs of six joints are
            close to each other, but not farther apart than the hips: the narrower the stance, the less
            torque the hips need to carry the robot on one foot. Feet of legs of five joints are below the
            hips.
        speeds: Lowest and highest speed at which it is to walk, m/s; by default those of a NAO, scaled. The
            Froude number, speed^2 / (g leg), is at most 1.

    Raises:
        ValueError: If the file cannot be read, a name is not in the model, the joints of a leg are not in the
            order of the model, the legs do not mirror each other, the knee bends backwards, a foot has no
            geom or only meshes, the soles are level neither with all leg angles zero nor in the crouch, a
            joint has no actuator or no torque limit, a leg's range seems to be in degrees, or an argument has
            another type or is out of its range.
    """
    source = {key: value for key, value in locals().items() if value is not None and key != "path"}
    checks.instance("path", path, str, Path)
    if name is not None:
        mjcf_settings.check_name(name)
    path = Path(path)
    joints = tuple(
        mjcf_settings.checked_names(argument, values, mjcf_settings.LEG)
        for argument, values in (("left_leg", left_leg), ("right_leg", right_leg))
    )
    feet = mjcf_settings.checked_names("feet", feet, mjcf_settings.FEET)
    mjcf_settings.check_number("kp", kp, above=0.0)
    mjcf_settings.check_number("kv", kv, least=0.0)
    mjcf_settings.check_number("max_torque", max_torque, above=0.0)
    mjcf_settings.check_number("foot_spacing", foot_spacing, above=0.0)
    speeds = None if speeds is None else mjcf_settings.checked_speeds(speeds)
    spec = mjcf_read.read_spec(path)
    bare, model = mjcf_model.without_meshes(spec, path)
    servos = read_servos_of(model, max_torque)
    legs = _read_legs(model, spec, joints, feet)
    names = tuple(servos)
    others = [joint for joint in names if joint not in legs[0].joints + legs[1].joints]
    held = mjcf_settings.checked_held(held, others, servos)
    swing = mjcf_settings.by_joint("arm_swing", arm_swing, mjcf_settings.OTHERS, others)
    max_speeds = mjcf_settings.checked_max_speeds(max_speed, names)
    chains, soles, crouches = _read_chains(model, legs, servos, held, crouch)
    length = mjcf_legs.leg_length(chains[0], legs[0])
    mjcf_settings.check_size(length, soles[0].right_edge, foot_spacing, speeds)
    posture = mjcf_posture.standing_posture(chains, legs, soles, names, held, crouches)
    mjcf_posture.check_kinematics(model, chains, legs, soles, held)
    return _assembled(
        (spec, bare, model), source, chains, legs, soles, servos, posture,
        name=name or path.stem,
        arm_swing=tuple(swing.get(joint, 0.0) for joint in names),
        gains=(kp, kv),
        max_speeds=max_speeds,
        foot_spacing=foot_spacing,
        speeds=speeds,
    )  # fmt: skip


def _read_legs(
    model: mujoco.MjModel, spec: mujoco.MjSpec, joints: Sequence[Sequence[str]], feet: Sequence[str]
) -> tuple[Leg, Leg]:
    """Return the left and the right leg as they are in the model."""
    left, right = (
        mjcf_soles.with_sole_geoms(model, spec, side, mjcf_legs.read_leg(model, side, names, foot))
        for side, names, foot in zip(("left", "right"), joints, feet, strict=True)
    )
    return left, right


def _read_chains(
    model: mujoco.MjModel,
    legs: tuple[Leg, Leg],
    servos: Mapping[str, Servo],
    held: Mapping[str, float],
    crouch: Any,
) -> tuple[list[LegChain], list[Sole], list[np.ndarray] | None]:
    """Return the axes and the soles of both legs, and the angles of the given crouch."""
    zero = mjcf_legs.posed(model, held)
    chains = [mjcf_legs.read_chain(zero, leg, servos) for leg in legs]
    mjcf_legs.check_mirrored(chains, legs)
    chains = [mjcf_legs.with_knee_ahead(chain, leg) for chain, leg in zip(chains, legs, strict=True)]
    crouches = None if crouch is None else mjcf_posture.crouches_of_both(crouch, chains, legs)
    level = mjcf_soles.level_pose(model, legs, held, crouches)
    soles = [mjcf_soles.read_sole(model, level, chain, leg) for chain, leg in zip(chains, legs, strict=True)]
    chains = [
        chain._replace(sole=mjcf_legs.foot_pose(model, zero, leg) @ sole.T_foot_sole)
        for chain, leg, sole in zip(chains, legs, soles, strict=True)
    ]
    return chains, soles, crouches


def _assembled(
    read: tuple[mujoco.MjSpec, mujoco.MjSpec, mujoco.MjModel],
    source: Mapping[str, Any],
    chains: Sequence[LegChain],
    legs: Sequence[Leg],
    soles: Sequence[Sole],
    servos: Mapping[str, Servo],
    posture: np.ndarray,
    *,
    name: str,
    arm_swing: tuple[float, ...],
    gains: tuple[float | int | None, float | int | None],
    max_speeds: tuple[float, ...],
    foot_spacing: float | int | None,
    speeds: tuple[float, float] | None,
) -> Humanoid:
    """Derive lengths, centre of mass and gains, and put the record together.

    `read` is the robot as it was read, without its meshes, and compiled.
    """
    spec, bare, model = read
    names = tuple(servos)
    left, right = chains
    length = mjcf_legs.leg_length(left, legs[0])
    hip_x, _, hip_z = left.points[mjcf_legs.pitch_joints(left.axes, legs[0])[0]]
    com = mjcf_legs.posed(model, dict(zip(names, posture.tolist(), strict=True))).subtree_com[1]
    servo_gains = _servo_gains(gains, float(model.body_subtreemass[1]), length)
    lower, upper = _limits(servos, chains, legs)
    left_leg, right_leg = (tuple(names.index(joint) for joint in leg.joints) for leg in legs)
    slow, fast = (float(np.sqrt(length / NAO_LEG_LENGTH) * speed) for speed in _NAO_SPEEDS)
    return Humanoid(
        name=name,
        joint_names=names,
        joint_lower=lower,
        joint_upper=upper,
        max_joint_speed=max_speeds,
        max_joint_torque=tuple(servo.torque for servo in servos.values()),
        left_leg=left_leg,
        right_leg=right_leg,
        posture=tuple(posture.tolist()),
        arm_swing=arm_swing,
        hip_centre=(float(hip_x), float(hip_z)),
        leg_length=length,
        foot_spacing=float(_narrow_spacing(soles, legs, length) if foot_spacing is None else foot_spacing),
        ankle_height=soles[0].ankle_height,
        torso_height=float(length + soles[0].ankle_height - hip_z),
        com_above_hip=float(com[2] - hip_z),
        com_ahead_of_hip=float(com[0] - hip_x),
        zmp_ahead_of_ankle=soles[0].middle,
        own_names=names,
        own_signs=(1.0,) * len(names),
        left=left,
        right=right,
        model=mjcf_model.walking_model(bare, legs[0].geoms + legs[1].geoms, servos, servo_gains),
        film_model=mjcf_model.film_model(spec, bare, servos, servo_gains),
        speeds=(slow, fast) if speeds is None else speeds,
        source=dict(source),
    )


def _servo_gains(
    gains: tuple[float | int | None, float | int | None], mass: float, length: float
) -> tuple[float, float]:
    """Return stiffness and damping of the servos: the given ones, or those from weight and leg.

    Raises:
        ValueError: If the legs are too soft to carry the robot.
    """
    kp, kv = gains
    usual = _STIFFNESS * mass * GRAVITY * length
    kp = usual if kp is None else kp
    if not kp >= _SOFTEST * usual:
        raise ValueError(
            f"kp must be at least {_SOFTEST * usual:.3g} N m/rad, a hundredth of its default, got {kp:g}: "
            "softer legs cannot carry the robot"
        )
    # A number below 0 that float32 cannot hold is 0.
    kv = kp * _DAMPING_TIME * np.sqrt(length / NAO_LEG_LENGTH) if kv is None else max(kv, 0.0)
    return float(kp), float(kv)


def _limits(
    servos: Mapping[str, Servo], chains: Sequence[LegChain], legs: Sequence[Leg]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the lowest and the highest angle of each joint, rad; the knees are bent forwards."""
    ranges = {name: (servo.low, servo.high) for name, servo in servos.items()}
    for chain, leg in zip(chains, legs, strict=True):
        ends = zip(chain.lower.tolist(), chain.upper.tolist(), strict=True)
        ranges.update(zip(leg.joints, ends, strict=True))
    lower, upper = zip(*ranges.values(), strict=True)
    return lower, upper


def _narrow_spacing(soles: Sequence[Sole], legs: Sequence[Leg], length: float) -> float:
    """Return the distance between the ankles at which the soles are close to each other, m."""
    left, right = soles
    beside = 2.0 * left.right_edge + _SOLE_CLEARANCE * length / NAO_LEG_LENGTH
    below_hips = float(left.place[1] - right.place[1])
    # A leg of five joints cannot hold its sole level while it leans inward.
    return min(beside, below_hips) if len(legs[0].joints) == 6 else below_hips
