"""Read the robot of an MJCF file, and separate it from the rest of its world."""

import os
from collections.abc import Sequence
from pathlib import Path

import mujoco

# Only `humanoid_from_mjcf` is public.
__all__: list[str] = []

_WORLD = "world"
_TENDON = mujoco.mjtTrn.mjTRN_TENDON
# Largest number of characters of MuJoCo's message in an error.
_WIDTH = 160


def read_spec(path: Path) -> mujoco.MjSpec:
    """Read the robot of an MJCF file without its world, and name the bodies and geoms that have no name.

    Raises:
        ValueError: If it cannot be read, or has not one robot with a free joint.
    """
    if not os.path.isfile(path):
        raise ValueError(f"the model must be an MJCF file, got {path}, which is no file")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ValueError(
            f"the model {path} must be an MJCF file that MuJoCo can read: {in_one_line(error)}"
        ) from error
    # Fused bodies would have no masses of their own.
    spec.compiler.fusestatic = False
    _leave_only_the_robot(spec, path)
    _release_from_the_world(spec)
    for kind, elements in (("body", spec.bodies), ("geom", spec.geoms)):
        for index, element in enumerate(elements):
            element.name = element.name or f"creps_jax_{kind}_{index}"
    return spec


def _leave_only_the_robot(spec: mujoco.MjSpec, path: Path) -> None:
    """Delete the bodies without a free joint, what aims at them, poses, sensors, and limits of contacts."""
    bodies = spec.worldbody.bodies
    is_free = [any(joint.type == mujoco.mjtJoint.mjJNT_FREE for joint in body.joints) for body in bodies]
    if sum(is_free) != 1:
        found = [
            body.name or "one without a name" for body, free in zip(bodies, is_free, strict=True) if free
        ]
        raise ValueError(
            f"the model {path} must have one body with a free joint, the trunk of the robot, got "
            f"{', '.join(found) or 'none'}"
        )
    others = [body for body, free in zip(bodies, is_free, strict=True) if not free]
    # Numbers of the name `max_contact_points` limit the contacts of MJX.
    delete(spec, others, spec.keys, spec.sensors, spec.tuples, spec.numerics)
    left = {"", *(body.name for body in spec.bodies)}
    delete(spec, [each for each in (*spec.cameras, *spec.lights) if each.targetbody not in left])


def _release_from_the_world(spec: mujoco.MjSpec) -> None:
    """Delete constraints and tendons that hold the robot from outside, and the compensation of gravity."""
    tendons = [tendon for tendon in spec.tendons if _is_of_world(tendon)]
    names = {tendon.name for tendon in tendons}
    delete(
        spec,
        [each for each in spec.equalities if _holds_to_world(each, spec) or _couples(each, names)],
        [each for each in spec.actuators if each.trntype == _TENDON and each.target in names],
        tendons,
    )
    for body in spec.bodies:
        body.gravcomp = 0.0


def _couples(equality: mujoco.MjsEquality, tendons: set[str]) -> bool:
    """Return whether a constraint couples one of some tendons; joints may have the same names."""
    return equality.type == mujoco.mjtEq.mjEQ_TENDON and bool(tendons & {equality.name1, equality.name2})


def _is_of_world(tendon: mujoco.MjsTendon) -> bool:
    """Return whether a tendon passes through sites or geoms of the world."""
    targets = [wrap.target for wrap in tendon.path if wrap.type != mujoco.mjtWrap.mjWRAP_PULLEY]
    return any(target.parent.name == _WORLD for target in targets)


def _holds_to_world(equality: mujoco.MjsEquality, spec: mujoco.MjSpec) -> bool:
    """Return whether a constraint connects a body or a site with the world."""
    if equality.type not in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD):
        return False
    ends = {equality.name1, equality.name2}
    if equality.objtype == mujoco.mjtObj.mjOBJ_BODY:
        return bool(ends & {"", _WORLD})
    return any(site.parent.name == _WORLD for site in spec.sites if site.name in ends)


def delete(spec: mujoco.MjSpec, *lists: Sequence[object]) -> None:
    """Delete the elements of lists from a model."""
    for elements in lists:
        for element in list(elements):
            spec.delete(element)


def in_one_line(error: Exception) -> str:
    """Return the message of MuJoCo, which names the element in further lines."""
    text = " ".join(str(error).removeprefix("Error: ").split())
    return text if len(text) <= _WIDTH else f"{text[: _WIDTH - 4]} ..."
