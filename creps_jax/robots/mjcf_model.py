"""Prepare the MuJoCo model of a humanoid for walking: a floor, a position servo a joint, simple feet."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from creps_jax.robots.mjcf_read import delete, in_one_line
from creps_jax.robots.mjcf_servos import Servo
from creps_jax.robots.robot import GRAVITY

# Only `humanoid_from_mjcf` is public.
__all__: list[str] = []

TIMESTEP = 0.004
_ITERATIONS, _LINE_ITERATIONS = 10, 10
# Contact bits: the floor touches every solid, and the feet also touch each other.
_FLOOR, _SOLID, _FOOT = 1, 2, 4
_NEVER = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
_ALWAYS = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
_MESH, _PLANE = mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_PLANE


def without_meshes(spec: mujoco.MjSpec, path: Path) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
    """Return a robot without its meshes, whose files may be missing, and its compiled model.

    Masses that the full model computes from meshes are kept.

    Raises:
        ValueError: If MuJoCo cannot compile it, or a mass follows from a mesh whose file is missing.
    """
    spec = spec.copy()
    _keep_masses(spec)
    without = " without its meshes" if any(geom.type == _MESH for geom in spec.geoms) else ""
    _delete_meshes(spec)
    try:
        return spec, spec.compile()
    except ValueError as error:
        raise ValueError(f"the model {path} must compile{without}: {in_one_line(error)}") from error


def walking_model(
    bare: mujoco.MjSpec, soles: Sequence[str], servos: Mapping[str, Servo], gains: tuple[float, float]
) -> mujoco.MjModel:
    """Return the model in which a robot walks.

    It has a level floor instead of its own world, no meshes, a position servo for each joint in the order of
    `servos`, and contacts of the solids with the floor only. The friction is that of the feet.

    Args:
        bare: The robot without its meshes.
        soles: Names of the geoms under the feet.
        servos: The motor of each joint.
        gains: Stiffness (N m/rad) and damping (N m s/rad) of the servos.
    """
    spec = bare.copy()
    frictions = _pair_frictions(spec)
    _set_up(spec, servos, gains)
    for geom in spec.geoms:
        is_solid = geom.contype != 0 or geom.conaffinity != 0
        geom.contype, geom.conaffinity = (_SOLID if is_solid else 0), 0
        if geom.name in soles:
            geom.contype, geom.conaffinity, geom.condim, geom.priority = _SOLID | _FOOT, _FOOT, 3, 1
            geom.friction = frictions.get(geom.name, geom.friction)
    _add_floor(spec)
    spec.compiler.discardvisual = False
    return spec.compile()


def film_model(
    spec: mujoco.MjSpec, bare: mujoco.MjSpec, servos: Mapping[str, Servo], gains: tuple[float, float]
) -> mujoco.MjModel:
    """Return the model with which a robot is drawn: its meshes, or its solids if mesh files are missing."""
    try:
        return _drawn(spec, servos, gains)
    except ValueError:
        shown = bare.copy()
        # Solids beside meshes are often in a group that is not drawn.
        for geom in shown.geoms:
            geom.group = 0
        return _drawn(shown, servos, gains)


def _drawn(spec: mujoco.MjSpec, servos: Mapping[str, Servo], gains: tuple[float, float]) -> mujoco.MjModel:
    spec = spec.copy()
    _set_up(spec, servos, gains)
    _add_floor(spec)
    return spec.compile()


def _set_up(spec: mujoco.MjSpec, servos: Mapping[str, Servo], gains: tuple[float, float]) -> None:
    """Delete the geoms of the world, give the robot servos, and set all options."""
    delete(spec, [geom for geom in spec.geoms if geom.parent.name == "world"], spec.pairs, spec.actuators)
    for joint in spec.joints:
        if joint.name in servos:
            joint.actfrclimited = False
    stiffness, damping = gains
    # The defaults and options of the file do not apply: a gear, disabled groups of actuators, a medium.
    plain = mujoco.MjSpec()
    for name, servo in servos.items():
        actuator = spec.add_actuator(plain.default, name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=stiffness, kv=damping)
        actuator.ctrllimited, actuator.ctrlrange = True, (servo.low, servo.high)
        actuator.forcelimited, actuator.forcerange = True, (-servo.torque, servo.torque)
    spec.option = plain.option
    option = spec.option
    option.timestep, option.integrator = TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver, option.cone = mujoco.mjtSolver.mjSOL_NEWTON, mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.iterations, option.ls_iterations = _ITERATIONS, _LINE_ITERATIONS
    option.gravity = 0.0, 0.0, -GRAVITY
    # The set-points stay within the limits, and the servos hold the joints near the set-points.
    option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_LIMIT)


def _add_floor(spec: mujoco.MjSpec) -> None:
    """Add a level floor with tiles, and light."""
    # Defaults of the file do not apply to the floor.
    plain = mujoco.MjSpec()
    texture = spec.add_texture(
        name="creps_jax_tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.40, 0.56, 0.46),
        rgb2=(0.43, 0.59, 0.49),
        width=64,
        height=64,
    )
    floor = spec.add_material(plain.default, name="creps_jax_floor", texrepeat=(1.0, 1.0), texuniform=True)
    floor.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = texture.name
    spec.worldbody.add_geom(
        plain.default,
        name="creps_jax_floor",
        type=_PLANE,
        size=(0.0, 0.0, 0.05),
        contype=_FLOOR,
        conaffinity=_SOLID,
        # The larger coefficient of two geoms counts: that of the robot.
        friction=(0.01, 0.005, 0.0001),
        material=floor.name,
    )
    spec.worldbody.add_light(
        plain.default,
        pos=(0.0, 0.0, 3.0),
        dir=(0.3, 0.4, -1.0),
        diffuse=(0.55, 0.55, 0.55),
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
    )
    spec.visual.map.shadowclip, spec.visual.quality.shadowsize = 3.0, 4096
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = (0.4, 0.4, 0.4), (0.35, 0.35, 0.35)
    if not any(texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX for texture in spec.textures):
        spec.add_texture(
            name="creps_jax_sky",
            type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
            builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=(0.52, 0.68, 0.84),
            rgb2=(0.93, 0.95, 0.96),
            width=64,
            height=384,
        )


def _keep_masses(spec: mujoco.MjSpec) -> None:
    """Write the masses and inertias that the full model has into its bodies, if it can be compiled.

    Raises:
        ValueError: If it cannot, and a mass follows from a mesh.
    """
    try:
        full = spec.copy().compile()
    except ValueError as error:
        heavy = [geom.parent.name for geom in spec.geoms if geom.type == _MESH and _gives_mass(spec, geom)]
        if heavy:
            raise ValueError(
                f"the mass of the body {heavy[0]!r} must be stated in the model, or follow from meshes whose "
                f"files are there: {in_one_line(error)}"
            ) from error
        return
    for index, body in enumerate(spec.bodies):
        if index == 0:
            continue
        body.explicitinertial = True
        body.mass, body.ipos, body.iquat = (
            full.body_mass[index],
            full.body_ipos[index],
            full.body_iquat[index],
        )
        body.inertia = full.body_inertia[index]
        body.fullinertia = np.full(6, np.nan)
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


def _gives_mass(spec: mujoco.MjSpec, geom: mujoco.MjsGeom) -> bool:
    """Return whether the mass of a body depends on a geom."""
    low, high = spec.compiler.inertiagrouprange
    from_geoms = mujoco.mjtInertiaFromGeom(spec.compiler.inertiafromgeom)
    is_derived = from_geoms == _ALWAYS or (from_geoms != _NEVER and not geom.parent.explicitinertial)
    is_counted = is_derived and low <= geom.group <= high
    return is_counted and (geom.density if np.isnan(geom.mass) else geom.mass) > 0.0


def _delete_meshes(spec: mujoco.MjSpec) -> None:
    """Delete the meshes, the geoms that have one, and their explicit contacts."""
    geoms = [geom for geom in spec.geoms if geom.type == _MESH]
    names = {geom.name for geom in geoms}
    pairs = [pair for pair in spec.pairs if names & {pair.geomname1, pair.geomname2}]
    delete(spec, pairs, geoms, spec.meshes)


def _pair_frictions(spec: mujoco.MjSpec) -> dict[str, Sequence[float]]:
    """Return the friction of each geom that touches a geom of the world by an explicit pair."""
    ground = {geom.name for geom in spec.geoms if geom.parent.name == "world"} | {"floor"}
    found = {}
    for pair in spec.pairs:
        for name, other in ((pair.geomname1, pair.geomname2), (pair.geomname2, pair.geomname1)):
            if other in ground:
                found[name] = (pair.friction[0], pair.friction[2], pair.friction[3])
    return found
