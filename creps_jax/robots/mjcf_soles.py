"""Read the soles of a model: the geoms of the feet, and the pose in which the soles are level."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from creps_jax.robots.humanoid import LegChain
from creps_jax.robots.mjcf_legs import Leg, foot_pose, is_below, leg_length, pitch_joints, posed
from creps_jax.typing import Float

# Only `humanoid_from_mjcf` is public.
__all__: list[str] = []

# Height within which the points of a sole lie, m, and share of the foot's length that they span.
_SOLE_FLATNESS, _SOLE_SHARE = 0.006, 0.5
# The geoms on which a robot can stand.
_SIMPLE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID,
)


class Sole(NamedTuple):
    """A sole in the pose of the leg in which it is level; all lengths are in the frame of the trunk.

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


def with_sole_geoms(model: mujoco.MjModel, spec: mujoco.MjSpec, side: str, leg: Leg) -> Leg:
    """Return a leg with the names of the solid geoms of its foot.

    Raises:
        ValueError: If the foot has none on which the robot can stand.
    """
    bodies = [spec.body(model.body(i).name) for i in _subtree(model, model.body(leg.foot).id)]
    geoms = [geom for body in bodies for geom in body.geoms]
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    solid = [g for g in geoms if g.contype != 0 or g.conaffinity != 0 or g.name in paired]
    simple = [geom for geom in solid if geom.type in _SIMPLE]
    if not simple:
        is_mesh = any(geom.type == mujoco.mjtGeom.mjGEOM_MESH for geom in solid or geoms)
        found = "only meshes" if is_mesh else "only geoms that touch nothing" if geoms else "none"
        raise ValueError(
            f"the {side} foot {leg.foot!r} must have a geom that touches the floor, a box, sphere, capsule, "
            f"cylinder or ellipsoid, got {found}: add one to the body in the model"
        )
    return leg._replace(geoms=tuple(geom.name for geom in simple))


def level_pose(
    model: mujoco.MjModel,
    legs: Sequence[Leg],
    held: Mapping[str, float],
    crouches: Sequence[np.ndarray] | None,
) -> mujoco.MjData:
    """Return the kinematics with all leg angles zero, or else in the crouch: the pose with level soles.

    Raises:
        ValueError: If a sole is level in neither.
    """
    where, data = "zero", posed(model, held)
    if crouches is not None and _tilted(model, data, legs):
        where = "the crouch"
        angles = [dict(zip(leg.joints, each, strict=True)) for leg, each in zip(legs, crouches, strict=True)]
        data = posed(model, held, angles[0] | angles[1])
    tilted = _tilted(model, data, legs)
    if tilted is not None:
        _, spanned, size = _touching(model, data, tilted)
        if size[0] == 0.0:
            found = "a single point of contact" if size[1] == 0.0 else "a row of points from left to right"
            raise ValueError(f"the sole of {tilted.foot!r} must have a length, got {found}")
        raise ValueError(
            f"the sole of {tilted.foot!r} must be level with all joints of the leg at zero, or else at the "
            f"angles of crouch, got lowest points at {where} that span {spanned[0]:.3f} of its {size[0]:.3f} "
            f"m forwards and {spanned[1]:.3f} of its {size[1]:.3f} m sideways"
        )
    return data


def read_sole(model: mujoco.MjModel, level: mujoco.MjData, chain: LegChain, leg: Leg) -> Sole:
    """Read the sole of a leg in a pose in which it is level.

    Raises:
        ValueError: If the sole is above the ankle, or farther below it than the leg is long.
    """
    points = level.xanchor[list(leg.ids)]
    _, _, ankle = pitch_joints(chain.axes, leg)
    touching, _, _ = _touching(model, level, leg)
    low, high = touching.min(axis=0), touching.max(axis=0)
    length, ankle_height = leg_length(chain, leg), float(points[ankle, 2] - low[2])
    if not 0.0 < ankle_height < length:
        raise ValueError(
            f"the height of the ankle above the sole of {leg.foot!r} must be above 0 and below the length of "
            f"the leg, {length:.3f} m, got {ankle_height:.3f} m: correct the place or the size of its geoms"
        )
    place = np.array([points[ankle, 0], points[-1, 1], low[2]])
    T_trunk_sole = np.eye(4)
    T_trunk_sole[:3, 3] = place
    return Sole(
        place=place,
        ankle_height=ankle_height,
        middle=float(0.5 * (low[0] + high[0]) - place[0]),
        right_edge=float(place[1] - _lowest_y(model, level, leg)),
        T_foot_sole=np.linalg.inv(foot_pose(model, level, leg)) @ T_trunk_sole,
    )


def _tilted(model: mujoco.MjModel, data: mujoco.MjData, legs: Sequence[Leg]) -> Leg | None:
    """Return the first leg whose sole is not level."""
    for leg in legs:
        _, spanned, size = _touching(model, data, leg)
        # A row of points along x has no width; without a length no robot can stand.
        if size[0] == 0.0 or (spanned < _SOLE_SHARE * size).any():
            return leg
    return None


def _touching(
    model: mujoco.MjModel, data: mujoco.MjData, leg: Leg
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "2"], Float[np.ndarray, "2"]]:
    """Return the points of a sole that touch a level floor, their length and width, and those of all, m."""
    points = np.concatenate([_support_points(model, data, name) for name in leg.geoms])
    touching = points[points[:, 2] < points[:, 2].min() + _SOLE_FLATNESS]
    return touching, np.ptp(touching, axis=0)[:2], np.ptp(points, axis=0)[:2]


def _lowest_y(model: mujoco.MjModel, data: mujoco.MjData, leg: Leg) -> float:
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


def _subtree(model: mujoco.MjModel, top: int) -> list[int]:
    return [body for body in range(1, model.nbody) if is_below(model, body, top)]
