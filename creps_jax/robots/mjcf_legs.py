"""Read the legs of a model: the order of their joints, the joints' axes and limits, and which is the knee."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from creps_jax.robots.humanoid import LegChain
from creps_jax.robots.mjcf_servos import Servo
from creps_jax.robots.mjcf_settings import named
from creps_jax.typing import Float

# Only `humanoid_from_mjcf` is public.
__all__: list[str] = []

# Bend of the knee, of the first guess and the least, rad.
FIRST_BEND, _LEAST_BEND = 0.6, 0.03
# Bend in the middle of the range that tells whether the knee is ahead or behind, rad.
_CLEAR_BEND = 0.3
# An axis is along y if its y component is larger than this.
_ALONG = 0.8
_TURN = 2.0 * np.pi
_MIRROR_TOLERANCE = 0.02
# Weight, in the inverse kinematics, of the rotation that a leg of five joints cannot make.
_MISSING_WEIGHT = 0.03


class Leg(NamedTuple):
    """A leg as it is in the model.

    Attributes:
        joints: Names of the joints, from the hip to the ankle.
        foot: Name of the foot body.
        ids: The ids of the joints.
        geoms: Names of the geoms of the sole, see `mjcf_soles.with_sole_geoms`.
    """

    joints: tuple[str, ...]
    foot: str
    ids: tuple[int, ...]
    geoms: tuple[str, ...] = ()


def read_leg(model: mujoco.MjModel, side: str, joints: Sequence[str], foot: str) -> Leg:
    """Read a leg after checking its names and their order in the tree of bodies; the geoms come later.

    Raises:
        ValueError: If a name is unknown, or the joints are not all those from the hip to the foot, in order.
    """
    known = [name for name in (model.joint(i).name for i in range(1, model.njnt)) if name]
    ids = tuple(model.joint(named(f"{side}_leg", "joints", joint, known)).id for joint in joints)
    named("feet", "bodies", foot, [model.body(i).name for i in range(1, model.nbody)])
    bodies = [int(model.jnt_bodyid[i]) for i in ids] + [model.body(foot).id]
    for (first, upper), (second, lower) in zip(
        zip(joints, bodies, strict=False), zip((*joints[1:], foot), bodies[1:], strict=True), strict=True
    ):
        if not is_below(model, lower, upper):
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
            f"{side}_leg must list all joints from hip to foot; missing: {', '.join(skipped)}, which the "
            f"model has between {joints[0]} and {foot}"
        )
    return Leg(tuple(joints), foot, ids)


def posed(
    model: mujoco.MjModel, held: Mapping[str, float], angles: Mapping[str, float] | None = None
) -> mujoco.MjData:
    """Return the kinematics of the robot with its trunk at the origin and unturned."""
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    data.qpos[3] = 1.0
    for joint, angle in (dict(held) | dict(angles or {})).items():
        data.qpos[model.joint(joint).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def foot_pose(model: mujoco.MjModel, data: mujoco.MjData, leg: Leg) -> Float[np.ndarray, "4 4"]:
    """Return the pose of the foot body of a leg in the frame of the trunk, m."""
    body = model.body(leg.foot).id
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = data.xmat[body].reshape(3, 3), data.xpos[body]
    return pose


def read_chain(zero: mujoco.MjData, leg: Leg, servos: Mapping[str, Servo]) -> LegChain:
    """Read the axes of a leg, with all its angles zero, and the limits of its joints.

    The sole is unknown: it is set when it is known in which pose the soles are level.

    Raises:
        ValueError: If not three of the axes are along y, or a range seems to be in the wrong unit.
    """
    ids = list(leg.ids)
    axes, points = zero.xaxis[ids].copy(), zero.xanchor[ids].copy()
    pitch_joints(axes, leg)
    weights = np.ones(6)
    if len(ids) == 5:
        # It cannot turn about z without a yaw joint, or about x with one roll joint, which places the foot.
        num_roll, _, num_yaw = np.sum(np.abs(axes) > _ALONG, axis=0)
        weights[3], weights[5] = (
            1.0 if is_free else _MISSING_WEIGHT for is_free in (num_roll > 1, num_yaw > 0)
        )
    limits = np.array([(servos[name].low, servos[name].high) for name in leg.joints])
    _check_unit(limits, leg)
    return LegChain(axes, points, np.eye(4), limits[:, 0], limits[:, 1], weights)


def _check_unit(limits: Float[np.ndarray, "k 2"], leg: Leg) -> None:
    """Check that the ranges of a leg are neither degrees that were read as radians, nor the reverse."""
    widest = int(np.argmax(np.ptp(limits, axis=1)))
    low, high = limits[widest]
    if np.abs(limits).max() > _TURN:
        wrong, right = "must be within a turn, -6.28 to 6.28 rad", "degree"
    elif high - low < np.radians(_TURN):
        wrong, right = f"must be wider than {np.radians(_TURN):.2f} rad", "radian"
    else:
        return
    raise ValueError(
        f"the range of {leg.joints[widest]!r} {wrong}, got {low:.4g} to {high:.4g} rad: if the model states "
        f'{right}s, its compiler must have angle="{right}"'
    )


def pitch_joints(axes: Float[np.ndarray, "k 3"], leg: Leg) -> tuple[int, int, int]:
    """Return which joints of a leg are those of hip pitch, knee and ankle pitch."""
    pitch = np.flatnonzero(np.abs(axes[:, 1]) > _ALONG)
    if len(pitch) != 3:
        names = ", ".join(leg.joints[i] for i in pitch) or "none"
        raise ValueError(
            "a leg must have three joints whose axes point along y, those of hip, knee and ankle "
            f"(the trunk must face along x), got {names} in the leg {', '.join(leg.joints)}"
        )
    return tuple(int(i) for i in pitch)  # type: ignore[return-value]


def leg_length(chain: LegChain, leg: Leg) -> float:
    """Return the length of the thigh and the shank, from the axis of hip pitch to that of the ankle, m."""
    hip, knee, ankle = pitch_joints(chain.axes, leg)
    return float(
        sum(np.linalg.norm((chain.points[b] - chain.points[a])[::2]) for a, b in ((hip, knee), (knee, ankle)))
    )


def check_mirrored(chains: Sequence[LegChain], legs: Sequence[Leg]) -> None:
    """Check that the right leg mirrors the left one, up to the signs of its angles.

    Raises:
        ValueError: If it does not.
    """
    left, right = chains
    if len(legs[0].joints) != len(legs[1].joints):
        raise ValueError(
            f"both legs must have equally many joints, got {legs[0].joints} and {legs[1].joints}"
        )
    if not left.points[-1, 1] > 0.0 > right.points[-1, 1]:
        is_exchanged = left.points[-1, 1] < 0.0 < right.points[-1, 1]
        raise ValueError(
            "left_leg must be on the left side, where y is positive, and right_leg on the right, got "
            f"ankles at y = {left.points[-1, 1]:.3f} and {right.points[-1, 1]:.3f} m"
            f"{_cause_of_exchange(left, legs[0]) if is_exchanged else ''}"
        )
    mirror, axes = np.array([1.0, -1.0, 1.0]), mirrored_axes(left)
    for i, (first, second) in enumerate(zip(legs[0].joints, legs[1].joints, strict=True)):
        axis = axes[i]
        apart = mirror * left.points[i] - right.points[i]
        # A point may be anywhere on its axis.
        apart = apart - (apart @ axis) * axis
        if abs(abs(axis @ right.axes[i]) - 1.0) > 1e-2:
            unlike = f"axes {_shown(left.axes[i])} and {_shown(right.axes[i])}"
        elif np.linalg.norm(apart) > _MIRROR_TOLERANCE:
            unlike = f"positions {_shown(left.points[i])} and {_shown(right.points[i])} m"
        else:
            continue
        raise ValueError(
            f"right_leg must mirror left_leg joint by joint, got {first!r} and {second!r}, whose {unlike} do "
            "not mirror each other"
        )


def _shown(vector: Float[np.ndarray, "3"]) -> str:
    # Without the sign of a zero.
    return f"({', '.join(f'{value:.3f}' for value in np.round(vector, 3) + 0.0)})"


def _cause_of_exchange(chain: LegChain, leg: Leg) -> str:
    """Return why the ankle of the left leg is on the right side, as far as its knee tells."""
    bend, sign = _bend_at_zero(chain, leg)
    _, knee, _ = pitch_joints(chain.axes, leg)
    middle = bend + 0.5 * sign * (chain.lower[knee] + chain.upper[knee])
    if abs(middle) < _CLEAR_BEND:
        return ": exchange the legs, or turn the trunk so that it faces along x"
    if middle > 0.0:
        return ": exchange the legs"
    return ", and knees that bend backwards: turn the trunk so that it faces along x"


def mirrored_axes(chain: LegChain) -> Float[np.ndarray, "k 3"]:
    """Return the axes of a leg, mirrored to the other side: a mirror reverses turns about x and z."""
    return chain.axes * np.array([-1.0, 1.0, -1.0])


def with_knee_ahead(chain: LegChain, leg: Leg) -> LegChain:
    """Limit the knee to angles at which it is bent forwards.

    Raises:
        ValueError: If it has none.
    """
    _, knee, _ = pitch_joints(chain.axes, leg)
    bend, sign = _bend_at_zero(chain, leg)
    straight = sign * (_LEAST_BEND - bend)
    lower, upper = chain.lower.copy(), chain.upper.copy()
    if sign > 0:
        lower[knee] = max(lower[knee], straight)
    else:
        upper[knee] = min(upper[knee], straight)
    if upper[knee] - lower[knee] < FIRST_BEND:
        least, most = sorted((bend + sign * chain.lower[knee], bend + sign * chain.upper[knee]))
        is_ahead = most > _LEAST_BEND
        raise ValueError(
            f"the knee {leg.joints[knee]!r} must bend by {FIRST_BEND} rad or more so that it is ahead of "
            "hip and ankle, where x is positive: in its range, "
            f"{chain.lower[knee]:.2f} to {chain.upper[knee]:.2f} rad, it bends "
            f"{f'forwards from {max(least, 0.0):.2f} to {most:.2f} rad only' if is_ahead else 'backwards'}"
        )
    return chain._replace(lower=lower, upper=upper)


def _bend_at_zero(chain: LegChain, leg: Leg) -> tuple[float, float]:
    """Return how far the knee is bent forwards at zero, rad, and the sign of its angle for bending more."""
    hip, knee, ankle = pitch_joints(chain.axes, leg)
    thigh, shank = (chain.points[b, ::2] - chain.points[a, ::2] for a, b in ((hip, knee), (knee, ankle)))
    # Rotations about y from the thigh's direction to that of the shank: positive moves the ankle back.
    bend = np.arctan2(-shank[0], -shank[1]) - np.arctan2(-thigh[0], -thigh[1])
    return float(bend), float(np.sign(chain.axes[knee, 1]))


def is_below(model: mujoco.MjModel, lower: int, upper: int) -> bool:
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
