"""Make a walking humanoid of an MJCF file and a short description; the rest is derived from the model."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from creps_jax import checks
from creps_jax.robots import mjcf_model
from creps_jax.robots.humanoid import Humanoid, LegChain
from creps_jax.robots.mjcf_model import Servo, named
from creps_jax.robots.robot import NAO_LEG_LENGTH
from creps_jax.robots.screw_kinematics import chain_fk, chain_ik
from creps_jax.typing import Float

__all__ = ["humanoid_from_mjcf"]

Number = float | int
GRAVITY = 9.81
# Gains of the servos: stiffness relative to weight times leg, and the damping time for a NAO's leg, s.
# At a quarter of this stiffness robots of 20 to 33 kg fall in all gaits.
_STIFFNESS, _DAMPING_TIME = 10.0, 0.01
# Largest speed of a joint if it is not given, rad/s.
_MAX_SPEED = 8.0
# Speeds of the simulated NAO, m/s; those of another robot have the same Froude number if they are not given.
_NAO_SPEEDS = (0.1, 0.5)
# An axis is along y if its y component is larger than this.
_ALONG = 0.8
# Bend of the knee, of the first guess and the least, rad; height of the hip, as a share of the leg's length.
_FIRST_BEND, _LEAST_BEND, _STANDING_HEIGHT = 0.6, 0.03, 0.88
# Height within which the points of a sole lie, m, and share of the foot's length that they span.
_SOLE_FLATNESS, _SOLE_SHARE = 0.006, 0.5
# Distance between the soles for a leg of the NAO's length, m.
_SOLE_CLEARANCE = 0.02
_MIRROR_TOLERANCE = 0.02
# Numbers of joints of a leg.
_LEG = {5: "5", 6: "6 joints, from hip to ankle"}
# Joints that the inverse kinematics does not move.
_OTHERS = "joints outside of the legs"
# The geoms on which a robot can stand.
_SIMPLE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID,
)
_KINEMATICS_TOLERANCE = 1e-4
# Largest difference of an angle that is at its limit, rad.
_ROUNDING = 1e-6
# Weight, in the inverse kinematics, of the rotation that a leg of five joints cannot make.
_MISSING_WEIGHT = 0.03


class _Leg(NamedTuple):
    """A leg as it is in the model: names of joints, foot body and geoms of the sole, and the joints' ids."""

    joints: tuple[str, ...]
    foot: str
    geoms: tuple[str, ...]
    ids: tuple[int, ...]


class _Sole(NamedTuple):
    """A sole in a pose of the leg in which it is level; all lengths in the frame of the trunk.

    Attributes:
        place: Origin of the sole frame, straight below the ankle in the lower face, m; its axes are parallel
            to those of the trunk.
        ankle_height: Height of the ankle above the sole, m.
        middle: Middle of the sole, as far as it touches the floor, ahead of the ankle, m.
        right_edge: The largest distance of a point of the foot to the right of the origin, m.
        T_foot_sole: Pose of the sole frame in that of the foot body, m.
    """

    place: Float[np.ndarray, "3"]
    ankle_height: float
    middle: float
    right_edge: float
    T_foot_sole: Float[np.ndarray, "4 4"]


def humanoid_from_mjcf(
    path: Path | str,
    *,
    left_leg: Sequence[str],
    right_leg: Sequence[str],
    feet: Sequence[str],
    name: str | None = None,
    crouch: Sequence[Number] | None = None,
    held: Mapping[str, Number] | None = None,
    arm_swing: Mapping[str, Number] | None = None,
    kp: Number | None = None,
    kv: Number | None = None,
    max_speed: Number | Mapping[str, Number] | None = None,
    max_torque: Number | None = None,
    foot_spacing: Number | None = None,
    speeds: Sequence[Number] | None = None,
) -> Humanoid:
    """Read a humanoid from its MuJoCo model, so that it can walk.

    The trunk is the body with the free joint; it must face along x. From the model come the joint axes, the
    soles, the lengths, the centre of mass, and the limits of joints and motors. Each joint gets a position
    servo. Meshes take no part in contacts; the feet need a box, sphere, capsule, cylinder or ellipsoid.

    Args:
        path: The MJCF file.
        left_leg: Names of the joints of the left leg, from the hip to the ankle; five or six.
        right_leg: Those of the right leg, which must mirror the left one.
        feet: Names of the left and the right foot body.
        name: Name of the robot; by default that of the file.
        crouch: Angles of the left leg with bent knees, rad; by default knees bent forwards. Soles that are
            not level with all leg angles zero must be level with these, the feet pointing along x.
        held: Angles at which other joints are held, by name, rad; zero by default.
        arm_swing: Change of a joint's angle for each metre that the left foot is ahead of the right one, by
            name, rad/m; none by default.
        kp: Stiffness of the servos, N m/rad; by default ten times weight times leg.
        kv: Damping of the servos, N m s/rad; by default from `kp` and the length of the leg.
        max_speed: Largest speed of all joints, or of each by name, rad/s; 8 by default.
        max_torque: Torque of the motors for which the model states no limit, N m.
        foot_spacing: Distance between the ankles when standing and walking, m. By default the soles are
            close to each other, but not farther apart than the hips: the narrower the stance, the less
            torque the hips need to carry the robot on one foot.
        speeds: Lowest and highest speed at which it is to walk, m/s; by default those of a NAO, scaled.

    Raises:
        ValueError: If the file cannot be read, a name is not in the model, the joints of a leg are not in the
            order of the model, the legs do not mirror each other, the knee bends backwards, a foot has no
            geom or only meshes, the soles are level neither with all leg angles zero nor in the crouch, a
            joint has no actuator or no torque limit, or an argument has another type or is out of its range.
    """
    source = {key: value for key, value in locals().items() if value is not None and key != "path"}
    checks.instance("path", path, str, Path)
    if name is not None:
        checks.instance("name", name, str)
    path = Path(path)
    legs = _names("left_leg", left_leg, _LEG), _names("right_leg", right_leg, _LEG)
    feet = _names("feet", feet, {2: "2 bodies, the left and the right foot"})
    _check_number("kp", kp, above=0.0)
    _check_number("kv", kv, least=0.0)
    _check_number("max_torque", max_torque, above=0.0)
    _check_number("foot_spacing", foot_spacing, above=0.0)
    speeds = None if speeds is None else _checked_speeds(speeds)
    spec = mjcf_model.read_spec(path)
    model = mjcf_model.compiled(spec, path)
    servos = mjcf_model.read_servos_of(model, max_torque)
    left, right = (
        _read_leg(model, spec, side, joints, foot)
        for side, joints, foot in zip(("left", "right"), legs, feet, strict=True)
    )
    names = tuple(servos)
    others = [joint for joint in names if joint not in left.joints + right.joints]
    held = _held(held, others, servos)
    swing = _by_joint("arm_swing", arm_swing, _OTHERS, others)
    max_speeds = _max_speeds(max_speed, names)
    zero = _posed(model, held)
    chains = [_chain(zero, leg, servos) for leg in (left, right)]
    _check_mirrored(chains, (left, right))
    chains = [_with_knee_ahead(chain, leg) for chain, leg in zip(chains, (left, right), strict=True)]
    crouches = None if crouch is None else _crouches(crouch, chains, (left, right))
    level = _level_pose(model, (left, right), held, crouches)
    soles = [_read_sole(model, level, chain, leg) for chain, leg in zip(chains, (left, right), strict=True)]
    chains = [
        chain._replace(sole=_foot_pose(model, zero, leg) @ sole.T_foot_sole)
        for chain, leg, sole in zip(chains, (left, right), soles, strict=True)
    ]
    posture = _posture(chains, (left, right), soles, names, held, crouches)
    _check_kinematics(model, chains, (left, right), soles, held)
    return _assembled(
        spec, model, path, source, chains, (left, right), soles, servos, posture,
        name=name or path.stem,
        arm_swing=tuple(swing.get(joint, 0.0) for joint in names),
        gains=(kp, kv),
        max_speeds=max_speeds,
        foot_spacing=foot_spacing,
        speeds=speeds,
    )  # fmt: skip


def _read_leg(
    model: mujoco.MjModel, spec: mujoco.MjSpec, side: str, joints: Sequence[str], foot: str
) -> _Leg:
    """Check the names of a leg and their order in the tree of bodies."""
    known = [name for name in (model.joint(i).name for i in range(1, model.njnt)) if name]
    ids = tuple(model.joint(named(f"{side}_leg", "joints", joint, known)).id for joint in joints)
    named("feet", "bodies", foot, [model.body(i).name for i in range(1, model.nbody)])
    bodies = [int(model.jnt_bodyid[i]) for i in ids] + [model.body(foot).id]
    for (first, upper), (second, lower) in zip(
        zip(joints, bodies, strict=False), zip((*joints[1:], foot), bodies[1:], strict=True), strict=True
    ):
        if not _is_below(model, lower, upper):
            raise ValueError(
                f"{side}_leg must list the joints from hip to ankle, as they follow each other in the model: "
                f"{second!r} must come below {first!r}, got the order {', '.join(joints)}, foot {foot}"
            )
    skipped = [
        model.joint(j).name
        for body in _path(model, bodies[-1], bodies[0])
        for j in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
        if j not in ids
    ]
    if skipped:
        raise ValueError(
            f"{side}_leg must list all joints from hip to foot, got none of {', '.join(skipped)}, which "
            f"the model has between {joints[0]} and {foot}"
        )
    return _Leg(tuple(joints), foot, _sole_geoms(model, spec, side, foot), ids)


def _sole_geoms(model: mujoco.MjModel, spec: mujoco.MjSpec, side: str, foot: str) -> tuple[str, ...]:
    """Return the names of the solid geoms of a foot."""
    bodies = [spec.body(model.body(i).name) for i in _subtree(model, model.body(foot).id)]
    geoms = [geom for body in bodies for geom in body.geoms]
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    solid = [g for g in geoms if g.contype != 0 or g.conaffinity != 0 or g.name in paired]
    simple = [geom for geom in solid if geom.type in _SIMPLE]
    if not simple:
        is_mesh = any(geom.type == mujoco.mjtGeom.mjGEOM_MESH for geom in solid or geoms)
        found = "only meshes" if is_mesh else "only geoms that touch nothing" if geoms else "none"
        raise ValueError(
            f"the {side} foot {foot!r} must have a geom that touches the floor, a box, sphere, capsule, "
            f"cylinder or ellipsoid, got {found}: add one to the body in the model"
        )
    return tuple(geom.name for geom in simple)


def _posed(model: mujoco.MjModel, held: Mapping[str, float], angles: Mapping[str, float] | None = None):
    """Return the kinematics of the robot with its trunk at the origin and unturned."""
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    data.qpos[3] = 1.0
    for joint, angle in (dict(held) | dict(angles or {})).items():
        data.qpos[model.joint(joint).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def _chain(zero: mujoco.MjData, leg: _Leg, servos: Mapping[str, Servo]) -> LegChain:
    """Read the axes of a leg, with all its angles zero, and the limits of its joints.

    The sole is unknown: it is set when it is known in which pose the soles are level.

    Raises:
        ValueError: If not three of the axes are along y.
    """
    ids = list(leg.ids)
    axes, points = zero.xaxis[ids].copy(), zero.xanchor[ids].copy()
    _pitch_joints(axes, leg)
    weights = np.ones(6)
    if len(ids) == 5:
        # It cannot turn about z without a yaw joint, or about x with one roll joint, which places the foot.
        num_roll, _, num_yaw = np.sum(np.abs(axes) > _ALONG, axis=0)
        weights[3], weights[5] = (
            1.0 if is_free else _MISSING_WEIGHT for is_free in (num_roll > 1, num_yaw > 0)
        )
    limits = np.array([(servos[name].low, servos[name].high) for name in leg.joints])
    return LegChain(axes, points, np.eye(4), limits[:, 0], limits[:, 1], weights)


def _pitch_joints(axes: Float[np.ndarray, "k 3"], leg: _Leg) -> tuple[int, int, int]:
    """Return which joints of a leg are those of hip pitch, knee and ankle pitch."""
    pitch = np.flatnonzero(np.abs(axes[:, 1]) > _ALONG)
    if len(pitch) != 3:
        names = ", ".join(leg.joints[i] for i in pitch) or "none"
        raise ValueError(
            "a leg must have three joints whose axes point along y, those of hip, knee and ankle "
            f"(the trunk must face along x), got {names} in the leg {', '.join(leg.joints)}"
        )
    return tuple(int(i) for i in pitch)  # type: ignore[return-value]


def _level_pose(
    model: mujoco.MjModel,
    legs: Sequence[_Leg],
    held: Mapping[str, float],
    crouches: Sequence[np.ndarray] | None,
) -> mujoco.MjData:
    """Return the kinematics with all leg angles zero, or else in the crouch: the pose with level soles.

    Raises:
        ValueError: If a sole is level in neither.
    """
    where, data = "zero", _posed(model, held)
    if crouches is not None and _tilted(model, data, legs):
        where = "the crouch"
        angles = [dict(zip(leg.joints, each, strict=True)) for leg, each in zip(legs, crouches, strict=True)]
        data = _posed(model, held, angles[0] | angles[1])
    tilted = _tilted(model, data, legs)
    if tilted is not None:
        _, spanned, size = _touching(model, data, tilted)
        raise ValueError(
            f"the sole of {tilted.foot!r} must be level with all joints of the leg at zero, or else at the "
            f"angles of crouch, got lowest points at {where} that span {spanned[0]:.3f} of its {size[0]:.3f} "
            f"m forwards and {spanned[1]:.3f} of its {size[1]:.3f} m sideways"
        )
    return data


def _tilted(model: mujoco.MjModel, data: mujoco.MjData, legs: Sequence[_Leg]) -> _Leg | None:
    """Return the first leg whose sole is not level."""
    for leg in legs:
        _, spanned, size = _touching(model, data, leg)
        # A row of points along x has no width; without a length no robot can stand.
        if size[0] == 0.0 or (spanned < _SOLE_SHARE * size).any():
            return leg
    return None


def _touching(
    model: mujoco.MjModel, data: mujoco.MjData, leg: _Leg
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the points of a sole that touch a level floor, their length and width, and those of all, m."""
    points = np.concatenate([_support_points(model, data, name) for name in leg.geoms])
    touching = points[points[:, 2] < points[:, 2].min() + _SOLE_FLATNESS]
    return touching, np.ptp(touching, axis=0)[:2], np.ptp(points, axis=0)[:2]


def _read_sole(model: mujoco.MjModel, level: mujoco.MjData, chain: LegChain, leg: _Leg) -> _Sole:
    """Read the sole of a leg in a pose in which it is level."""
    points = level.xanchor[list(leg.ids)]
    _, _, ankle = _pitch_joints(chain.axes, leg)
    touching, _, _ = _touching(model, level, leg)
    low, high = touching.min(axis=0), touching.max(axis=0)
    place = np.array([points[ankle, 0], points[-1, 1], low[2]])
    T_trunk_sole = np.eye(4)
    T_trunk_sole[:3, 3] = place
    return _Sole(
        place=place,
        ankle_height=float(points[ankle, 2] - low[2]),
        middle=float(0.5 * (low[0] + high[0]) - place[0]),
        right_edge=float(place[1] - _lowest_y(model, level, leg)),
        T_foot_sole=np.linalg.inv(_foot_pose(model, level, leg)) @ T_trunk_sole,
    )


def _lowest_y(model: mujoco.MjModel, data: mujoco.MjData, leg: _Leg) -> float:
    """Return how far to the right a foot reaches, in the frame of the trunk, m."""
    geoms = [model.geom(name).id for name in leg.geoms]
    rotations = data.geom_xmat[geoms].reshape(-1, 3, 3)
    centres, halves = model.geom_aabb[geoms, :3], model.geom_aabb[geoms, 3:]
    middles = data.geom_xpos[geoms] + np.einsum("nij,nj->ni", rotations, centres)
    return float(np.min(middles[:, 1] - np.sum(np.abs(rotations[:, 1]) * halves, axis=1)))


def _support_points(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> Float[np.ndarray, "n 3"]:
    """Return points of a geom between which it can touch a floor below, in the frame of the trunk, m."""
    geom = model.geom(name).id
    size, position, rotation = model.geom_size[geom], data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    kind = model.geom_type[geom]
    down = np.array([0.0, 0.0, -1.0])
    signs = np.array([-1.0, 1.0])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        corners = np.stack(np.meshgrid(signs, signs, signs), -1).reshape(-1, 3)
        return position + corners * size @ rotation.T
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return (position + size[0] * down)[None]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return position + signs[:, None] * size[1] * rotation[:, 2] + size[0] * down
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        around = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
        rim = np.stack([size[0] * np.cos(around), size[0] * np.sin(around)], 1)
        local = np.concatenate([np.column_stack([rim, np.full(16, sign * size[1])]) for sign in signs])
        return position + local @ rotation.T
    # The lowest point of an ellipsoid is where its normal points down.
    scaled = size * (rotation.T @ down)
    return (position + rotation @ (size * scaled / np.linalg.norm(scaled)))[None]


def _check_mirrored(chains: Sequence[LegChain], legs: Sequence[_Leg]) -> None:
    """Check that the right leg mirrors the left one, up to the signs of its angles."""
    left, right = chains
    if len(legs[0].joints) != len(legs[1].joints):
        raise ValueError(
            f"both legs must have equally many joints, got {legs[0].joints} and {legs[1].joints}"
        )
    if not left.points[-1, 1] > 0.0 > right.points[-1, 1]:
        raise ValueError(
            "left_leg must be on the left side, where y is positive, and right_leg on the right, got "
            f"ankles at y = {left.points[-1, 1]:.3f} and {right.points[-1, 1]:.3f} m"
        )
    mirror = np.array([1.0, -1.0, 1.0])
    for i, (first, second) in enumerate(zip(legs[0].joints, legs[1].joints, strict=True)):
        axis = -mirror * left.axes[i]
        apart = mirror * left.points[i] - right.points[i]
        # A point may be anywhere on its axis.
        apart = apart - (apart @ axis) * axis
        if abs(abs(axis @ right.axes[i]) - 1.0) > 1e-2 or np.linalg.norm(apart) > _MIRROR_TOLERANCE:
            raise ValueError(
                f"right_leg must mirror left_leg joint by joint, got {first!r} and {second!r}, whose axes "
                "do not mirror each other"
            )


def _with_knee_ahead(chain: LegChain, leg: _Leg) -> LegChain:
    """Limit the knee to angles at which it is bent forwards.

    Raises:
        ValueError: If it has none.
    """
    hip, knee, ankle = _pitch_joints(chain.axes, leg)
    thigh, shank = (chain.points[b, ::2] - chain.points[a, ::2] for a, b in ((hip, knee), (knee, ankle)))
    # Rotations about y from the thigh's direction to that of the shank: positive moves the ankle back.
    bend = np.arctan2(-shank[0], -shank[1]) - np.arctan2(-thigh[0], -thigh[1])
    sign = np.sign(chain.axes[knee, 1])
    straight = sign * (_LEAST_BEND - bend)
    lower, upper = chain.lower.copy(), chain.upper.copy()
    if sign > 0:
        lower[knee] = max(lower[knee], straight)
    else:
        upper[knee] = min(upper[knee], straight)
    if upper[knee] - lower[knee] < _FIRST_BEND:
        raise ValueError(
            f"the knee {leg.joints[knee]!r} must bend by {_FIRST_BEND} rad or more so that it is ahead of "
            "hip and ankle, where x is positive: in its range, "
            f"{chain.lower[knee]:.2f} to {chain.upper[knee]:.2f} rad, it bends backwards"
        )
    return chain._replace(lower=lower, upper=upper)


def _posture(
    chains: Sequence[LegChain],
    legs: Sequence[_Leg],
    soles: Sequence[_Sole],
    names: Sequence[str],
    held: Mapping[str, float],
    crouches: Sequence[np.ndarray] | None,
) -> np.ndarray:
    """Return the angles of standing: soles level and below the hips, knees bent, found from the crouch."""
    posture = np.array([held.get(name, 0.0) for name in names])
    guesses = [_bent(chain, leg) for chain, leg in zip(chains, legs, strict=True)]
    for chain, leg, sole, guess in zip(chains, legs, soles, crouches or guesses, strict=True):
        angles = _stand_on(chain, leg, sole, guess)
        for name, angle in zip(leg.joints, angles, strict=True):
            posture[list(names).index(name)] = angle
    return posture


def _bent(chain: LegChain, leg: _Leg) -> np.ndarray:
    """Return the angles of a leg with its knee bent forwards."""
    angles = np.zeros(len(leg.joints))
    for joint, turn in zip(_pitch_joints(chain.axes, leg), (-0.5, 1.0, -0.5), strict=True):
        angles[joint] = turn * _FIRST_BEND * np.sign(chain.axes[joint, 1])
    return angles


def _crouches(crouch: Any, chains: Sequence[LegChain], legs: Sequence[_Leg]) -> list[np.ndarray]:
    """Return the angles of both legs with bent knees, of those of the left one, after checking them."""
    left = _checked_crouch(crouch, chains[0], legs[0])
    # The right leg's angles have the sign of its axes relative to the mirrored ones.
    mirrored = chains[0].axes * np.array([-1.0, 1.0, -1.0])
    return [left, np.sign(np.sum(mirrored * chains[1].axes, axis=1)) * left]


def _checked_crouch(crouch: Any, chain: LegChain, leg: _Leg) -> np.ndarray:
    """Return the angles of the left leg with bent knees after checking them."""
    angles = checks.finite("crouch", checks.vector("crouch", crouch))
    if angles.shape != (len(leg.joints),):
        raise ValueError(
            f"crouch must have an angle for each of {', '.join(leg.joints)}, got {checks.shown(crouch)}"
        )
    _, knee, _ = _pitch_joints(chain.axes, leg)
    for i in (knee, *range(len(angles))):
        if not chain.lower[i] - _ROUNDING <= angles[i] <= chain.upper[i] + _ROUNDING:
            why = ", where the knee is bent forwards" if i == knee else ""
            raise ValueError(
                f"crouch must have {leg.joints[i]!r} from {chain.lower[i]:.2f} to {chain.upper[i]:.2f} rad"
                f"{why}, got {angles[i]:g}"
            )
    return angles


def _stand_on(chain: LegChain, leg: _Leg, sole: _Sole, guess: np.ndarray) -> np.ndarray:
    """Return the angles with which the sole is level, and the ankle below the hip."""
    x, _, z = chain.points[_pitch_joints(chain.axes, leg)[0]]
    pose = np.eye(4)
    pose[:3, 3] = x, sole.place[1], z - _STANDING_HEIGHT * _leg_length(chain, leg) - sole.ankle_height
    solve = jax.jit(lambda pose, guess: chain_ik(pose, guess, chain, iterations=100))
    angles = solve(jnp.asarray(pose, jnp.float32), jnp.asarray(guess, jnp.float32))
    found = np.asarray(chain_fk(angles, chain))
    apart = np.abs(found - pose)[:3, 3].max()
    if apart > 0.01:
        raise ValueError(
            f"the leg {', '.join(leg.joints)} must reach the floor below its hip with its knee bent, got a "
            f"sole {apart:.3f} m off: name a crouch, or correct the ranges of the joints"
        )
    return np.asarray(angles, float)


def _leg_length(chain: LegChain, leg: _Leg) -> float:
    hip, knee, ankle = _pitch_joints(chain.axes, leg)
    return float(
        sum(np.linalg.norm((chain.points[b] - chain.points[a])[::2]) for a, b in ((hip, knee), (knee, ankle)))
    )


def _check_kinematics(
    model: mujoco.MjModel,
    chains: Sequence[LegChain],
    legs: Sequence[_Leg],
    soles: Sequence[_Sole],
    held: Mapping[str, float],
) -> None:
    """Compare our forward kinematics with MuJoCo's at random angles."""
    rng = np.random.default_rng(0)
    for chain, leg, sole in zip(chains, legs, soles, strict=True):
        fk = jax.jit(lambda angles, chain=chain: chain_fk(angles, chain))
        for _ in range(20):
            angles = rng.uniform(np.maximum(chain.lower, -1.5), np.minimum(chain.upper, 1.5)).astype(
                np.float32
            )
            theirs = _foot_pose(
                model, _posed(model, held, dict(zip(leg.joints, angles.tolist(), strict=True))), leg
            )
            error = np.abs(np.asarray(fk(jnp.asarray(angles))) - theirs @ sole.T_foot_sole).max()
            if not error < _KINEMATICS_TOLERANCE:
                raise ValueError(
                    f"the pose of {leg.foot!r} must follow from the joints {', '.join(leg.joints)}, got "
                    f"{error:.2g} m between our kinematics and MuJoCo's: are joints of the leg coupled?"
                )


def _foot_pose(model: mujoco.MjModel, data: mujoco.MjData, leg: _Leg) -> np.ndarray:
    body = model.body(leg.foot).id
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    return pose


def _assembled(
    spec: mujoco.MjSpec,
    model: mujoco.MjModel,
    path: Path,
    source: Mapping[str, Any],
    chains: Sequence[LegChain],
    legs: Sequence[_Leg],
    soles: Sequence[_Sole],
    servos: Mapping[str, Servo],
    posture: np.ndarray,
    *,
    name: str,
    arm_swing: tuple[float, ...],
    gains: tuple[Number | None, Number | None],
    max_speeds: tuple[float, ...],
    foot_spacing: Number | None,
    speeds: tuple[float, float] | None,
) -> Humanoid:
    """Derive lengths, centre of mass and gains, and put the record together."""
    names = tuple(servos)
    left, right = chains
    length = _leg_length(left, legs[0])
    hip_x, _, hip_z = left.points[_pitch_joints(left.axes, legs[0])[0]]
    ankle_height = soles[0].ankle_height
    standing = _posed(model, dict(zip(names, posture.tolist(), strict=True)))
    com = standing.subtree_com[1]
    kp, kv = gains
    mass = float(model.body_subtreemass[1])
    kp = _STIFFNESS * mass * GRAVITY * length if kp is None else kp
    root = np.sqrt(length / NAO_LEG_LENGTH)
    # A number below 0 that float32 cannot hold is 0.
    kv = kp * _DAMPING_TIME * root if kv is None else max(kv, 0.0)
    servo_gains = {joint: (float(kp), float(kv)) for joint in names}
    lower, upper = (np.array([getattr(servos[joint], end) for joint in names]) for end in ("low", "high"))
    for chain, leg in zip(chains, legs, strict=True):
        where = [names.index(joint) for joint in leg.joints]
        lower[where], upper[where] = chain.lower, chain.upper
    spacing = foot_spacing
    if spacing is None:
        beside = 2.0 * soles[0].right_edge + _SOLE_CLEARANCE * length / NAO_LEG_LENGTH
        below_hips = soles[0].place[1] - soles[1].place[1]
        # A leg of five joints cannot hold its sole level while it leans inward.
        spacing = min(beside, below_hips) if len(legs[0].joints) == 6 else below_hips
    slow, fast = _NAO_SPEEDS
    return Humanoid(
        name=name,
        joint_names=names,
        joint_lower=tuple(lower.tolist()),
        joint_upper=tuple(upper.tolist()),
        max_joint_speed=max_speeds,
        max_joint_torque=tuple(servo.torque for servo in servos.values()),
        left_leg=tuple(names.index(joint) for joint in legs[0].joints),
        right_leg=tuple(names.index(joint) for joint in legs[1].joints),
        posture=tuple(posture.tolist()),
        arm_swing=arm_swing,
        hip_centre=(float(hip_x), float(hip_z)),
        leg_length=length,
        foot_spacing=float(spacing),
        ankle_height=ankle_height,
        torso_height=float(length + ankle_height - hip_z),
        com_above_hip=float(com[2] - hip_z),
        com_ahead_of_hip=float(com[0] - hip_x),
        zmp_ahead_of_ankle=soles[0].middle,
        own_names=names,
        own_signs=(1.0,) * len(names),
        left=left,
        right=right,
        model=mjcf_model.walking_model(spec, {leg.foot: leg.geoms for leg in legs}, servos, servo_gains),
        film_model=mjcf_model.film_model(spec, servos, servo_gains),
        speeds=(float(root * slow), float(root * fast)) if speeds is None else speeds,
        source=dict(source),
    )


def _by_joint(
    argument: str, values: Any, kind: str, names: Sequence[str], *, above: float = -np.inf
) -> dict[str, float]:
    """Return numbers by joint after checking the names and the numbers."""
    values = {} if values is None else values
    if not isinstance(values, Mapping):
        raise ValueError(f"{argument} must be numbers by joint, got {checks.shown(values)}")
    return {
        named(argument, kind, joint, names): float(
            checks.number(f"{argument} of {joint}", value, above=above)
        )
        for joint, value in values.items()
    }


def _held(values: Any, names: Sequence[str], servos: Mapping[str, Servo]) -> dict[str, float]:
    """Return the angle at which each joint outside of the legs is held, rad: zero, if it can be."""
    given = _by_joint("held", values, _OTHERS, names)
    for joint, angle in given.items():
        low, high = servos[joint].low, servos[joint].high
        if not low - _ROUNDING <= angle <= high + _ROUNDING:
            raise ValueError(f"held of {joint} must be from {low:.2f} to {high:.2f} rad, got {angle:g}")
    return {joint: given.get(joint, min(max(0.0, servos[joint].low), servos[joint].high)) for joint in names}


def _max_speeds(max_speed: Any, names: Sequence[str]) -> tuple[float, ...]:
    """Return the largest speed of each joint, rad/s."""
    if isinstance(max_speed, Mapping):
        given = _by_joint("max_speed", max_speed, "joints", names, above=0.0)
        return tuple(given.get(joint, _MAX_SPEED) for joint in names)
    fastest = _MAX_SPEED if max_speed is None else checks.number("max_speed", max_speed, above=0.0)
    return (float(fastest),) * len(names)


def _check_number(argument: str, value: Any, **limits: float) -> None:
    if value is not None:
        checks.number(argument, value, **limits)


def _checked_speeds(speeds: Any) -> tuple[float, float]:
    values = checks.finite("speeds", checks.vector("speeds", speeds), above=0.0)
    if values.shape != (2,) or not values[0] < values[1]:
        raise ValueError(f"speeds must be two numbers, the lower first, got {checks.shown(speeds)}")
    return float(values[0]), float(values[1])


def _names(argument: str, values: Any, kinds: Mapping[int, str]) -> tuple[str, ...]:
    """Return names after checking their number, one of `kinds`, and that each is there once."""
    is_list = isinstance(values, Sequence) and not isinstance(values, str)
    if not is_list or len(values) not in kinds or not all(isinstance(value, str) for value in values):
        expected = " or ".join(kinds.values())
        raise ValueError(f"{argument} must be the names of {expected}, got {checks.shown(values)}")
    if len(set(values)) != len(values):
        raise ValueError(f"{argument} must have each name once, got {checks.shown(values)}")
    return tuple(values)


def _is_below(model: mujoco.MjModel, lower: int, upper: int) -> bool:
    """Return whether a body is another one or hangs on it."""
    while lower not in (0, upper):
        lower = int(model.body_parentid[lower])
    return lower == upper


def _path(model: mujoco.MjModel, lower: int, upper: int) -> list[int]:
    """Return the bodies from one up to another one above it."""
    bodies = [lower]
    while bodies[-1] != upper:
        bodies.append(int(model.body_parentid[bodies[-1]]))
    return bodies


def _subtree(model: mujoco.MjModel, top: int) -> list[int]:
    return [body for body in range(1, model.nbody) if _is_below(model, body, top)]
