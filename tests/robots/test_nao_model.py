"""The model files: they agree with their robots and the published masses, touch only with their soles."""

import dataclasses
import itertools
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from creps_jax.robots.nao_geometry import JOINT_NAMES, LEFT, NUM_JOINTS, RIGHT, leg_indices
from creps_jax.robots.nao_kinematics import leg_fk
from creps_jax.robots.robot import NAO, NAO_H25
from creps_jax.simulation.models import check_model

MODELS = Path(__file__).parents[2] / "models"
SIDE_NAMES = {"left": LEFT, "right": RIGHT}
SOLE_CORNERS = ("sole_front_left", "sole_front_right", "sole_back_left", "sole_back_right")
ARM_LINKS = ("shoulder", "upper_arm", "elbow", "lower_arm")
LEG_LINKS = ("hip1", "hip2", "thigh", "shank", "ankle", "foot")


def box(mass, x, y, z):
    """Return mass and moments of inertia of a box of these full lengths."""
    return mass, mass / 12.0 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])


def ball(mass, radius):
    """Return mass and moments of inertia of a solid sphere."""
    return mass, np.full(3, 0.4 * mass * radius**2)


# The simulator's table of bodies, with lengths along our x (forward), y, z.
NAO_LINKS = {
    "torso": box(1.2171, 0.10, 0.10, 0.18),
    "head": ball(0.350, 0.065),
    "shoulder": ball(0.070, 0.01),
    "upper_arm": box(0.150, 0.08, 0.07, 0.06),
    "elbow": ball(0.035, 0.01),
    "lower_arm": box(0.200, 0.11, 0.05, 0.05),
    "hip1": ball(0.090, 0.01),
    "hip2": ball(0.125, 0.01),
    "thigh": box(0.275, 0.07, 0.07, 0.14),
    "shank": box(0.225, 0.07, 0.08, 0.11),
    "ankle": ball(0.125, 0.01),
    "foot": box(0.200, 0.16, 0.08, 0.02),
}


# The real robot's links, left side: mass, centre of mass (mm), moments of inertia about it (1e-4 kg m2).
H25_LINKS = {
    "torso": (1.04956, (-4.13, 0, 43.42), (30.84, 28.84, 15.92)),
    "neck": (0.06442, (-0.01, 0, -27.42), (0.266, 0.276, 0.055)),
    "head": (0.60533, (-1.12, 0, 52.58), (9.58, 8.17, 9.85)),
    "shoulder": (0.07504, (-1.65, -26.63, 0.14), (0.311, 0.140, 0.330)),
    "upper_arm": (0.15777, (24.55, 5.63, 3.30), (0.872, 2.75, 2.42)),
    "elbow": (0.06483, (-27.44, 0, -0.14), (0.056, 0.266, 0.276)),
    "lower_arm": (0.07761, (25.56, 2.81, 0.76), (0.247, 0.384, 0.360)),
    "hand": (0.18533, (34.34, -0.88, 3.08), (0.687, 1.36, 1.33)),
    "hip1": (0.06981, (-7.81, -11.14, 26.61), (0.234, 0.476, 0.497)),
    "hip2": (0.13053, (-15.49, 0.29, -5.15), (0.241, 0.635, 0.568)),
    "thigh": (0.38968, (1.38, 2.21, -53.73), (5.10, 4.65, 3.01)),
    "shank": (0.29142, (4.53, 2.25, -49.36), (4.71, 4.13, 1.86)),
    "ankle": (0.13416, (0.45, 0.29, 6.85), (0.322, 0.679, 0.548)),
    "foot": (0.16184, (25.42, 3.30, -32.39), (0.979, 3.70, 4.19)),
}


def path_of(robot):
    return MODELS / robot.name / f"{robot.name}.xml"


def load(robot):
    return mujoco.MjModel.from_xml_path(str(path_of(robot)))


@pytest.fixture(scope="module", params=[NAO, NAO_H25], ids=lambda robot: robot.name)
def robot(request):
    return request.param


@pytest.fixture(scope="module")
def model(robot):
    return load(robot)


@pytest.fixture
def data(model):
    return mujoco.MjData(model)


def joint_position(model, data, name):
    """Return where a joint lies in the torso's frame at the zero pose."""
    mujoco.mj_resetData(model, data)
    mujoco.mj_kinematics(model, data)
    return data.joint(name).xanchor - data.body("torso").xpos


def test_joints_and_actuators_are_in_the_order_of_nao_geometry(model):
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE
    assert tuple(model.joint(i + 1).name for i in range(model.njnt - 1)) == JOINT_NAMES
    assert tuple(model.joint(i).name for i in model.actuator_trnid[:, 0]) == JOINT_NAMES
    assert (model.nq, model.nv, model.nu) == (7 + NUM_JOINTS, 6 + NUM_JOINTS, NUM_JOINTS)


def test_limits_agree_with_the_robots(model, robot):
    limits = np.stack([robot.joint_lower, robot.joint_upper], axis=1)
    np.testing.assert_allclose(model.jnt_range[1:], limits, atol=1e-9)
    np.testing.assert_allclose(model.actuator_ctrlrange, limits, atol=1e-9)
    torques = np.outer(robot.max_joint_torque, [-1.0, 1.0])
    np.testing.assert_allclose(model.actuator_forcerange, torques)
    assert model.jnt_limited[1:].all()
    assert model.actuator_ctrllimited.all() and model.actuator_forcelimited.all()


@pytest.mark.parametrize("side", SIDE_NAMES)
def test_lengths_agree_with_the_robots(model, data, robot, side):
    g, sign = robot.geometry, SIDE_NAMES[side]
    hip = np.array([g.hip_x, sign * g.hip_y, g.hip_z])
    knee = hip + np.array([g.thigh_forward, 0.0, -g.thigh_down])
    ankle_pitch = knee - [0.0, 0.0, g.shank_down]
    ankle_roll = ankle_pitch - [0.0, 0.0, g.ankle_drop]
    shoulder = np.array([0.0, sign * g.shoulder_y, g.shoulder_z])
    elbow = shoulder + np.array([g.elbow_forward, sign * g.elbow_out, g.elbow_up])
    places = {
        "hip_yaw_pitch": hip, "hip_roll": hip, "hip_pitch": hip, "knee": knee, "ankle_pitch": ankle_pitch,
        "ankle_roll": ankle_roll, "shoulder_pitch": shoulder, "shoulder_yaw": shoulder, "arm_roll": elbow,
        "elbow": elbow,
    }  # fmt: skip
    for joint, place in places.items():
        np.testing.assert_allclose(joint_position(model, data, f"{side}_{joint}"), place, atol=1e-9)
    sole = data.site(f"{side}_sole").xpos - data.body("torso").xpos
    np.testing.assert_allclose(sole, ankle_roll - [0.0, 0.0, g.foot_down], atol=1e-9)


def test_head_joints_agree_with_the_robots(model, data, robot):
    g = robot.geometry
    for joint, height in (("head_yaw", g.neck_z), ("head_pitch", g.head_pitch_z)):
        np.testing.assert_allclose(joint_position(model, data, joint), [0.0, 0.0, height], atol=1e-9)


@pytest.mark.parametrize("side", SIDE_NAMES)
def test_sole_spheres_touch_the_ground_at_the_corners_of_the_sole(model, data, robot, side):
    g = robot.geometry
    mujoco.mj_kinematics(model, data)
    sole = data.site(f"{side}_sole").xpos
    names = [f"{side}_{corner}" for corner in SOLE_CORNERS]
    lowest = np.array([data.geom(n).xpos - [0, 0, model.geom(n).size[0]] for n in names]) - sole[None]
    edges = (g.foot_outer, -g.foot_inner) if side == "left" else (g.foot_inner, -g.foot_outer)
    corners = [[x, y, 0.0] for x in (g.foot_front, g.foot_back) for y in edges]
    np.testing.assert_allclose(lowest, corners, atol=1e-9)


@pytest.mark.parametrize("side", SIDE_NAMES)
def test_fk_agrees_with_mujoco_on_random_poses(model, data, robot, side):
    random = np.random.default_rng(0)
    fk = jax.jit(lambda joint_pos: leg_fk(joint_pos, SIDE_NAMES[side], robot=robot))
    for _ in range(20):
        data.qpos[:7] = random.normal(size=7)
        data.qpos[7:] = random.uniform(robot.joint_lower, robot.joint_upper)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        torso, sole = data.body("torso"), data.site(f"{side}_sole")
        R_torso_world = torso.xmat.reshape(3, 3).T
        joint_pos = jnp.asarray(data.qpos[7:][leg_indices(SIDE_NAMES[side])], jnp.float32)
        pose = np.asarray(fk(joint_pos))
        np.testing.assert_allclose(pose[:3, :3], R_torso_world @ sole.xmat.reshape(3, 3), atol=3e-6)
        np.testing.assert_allclose(pose[:3, 3], R_torso_world @ (sole.xpos - torso.xpos), atol=1e-6)


def test_masses_and_inertias_are_those_of_the_published_solids():
    model = load(NAO)
    names = ["torso", "head", *(f"{s}_{link}" for s in SIDE_NAMES for link in (*ARM_LINKS, *LEG_LINKS))]
    for name in names:
        mass, inertia = NAO_LINKS[name.removeprefix("left_").removeprefix("right_")]
        body = model.body(name)
        np.testing.assert_allclose(body.mass, mass, rtol=1e-9, err_msg=name)
        np.testing.assert_allclose(np.sort(body.inertia), np.sort(inertia), rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(model.body("neck").mass, 0.05)
    np.testing.assert_allclose(model.body_mass.sum(), 4.6071, atol=1e-9)


def test_masses_and_inertias_are_the_published_ones():
    """About the centres of mass: the tensors that are printed about the links' origins are larger."""
    model = load(NAO_H25)
    for name, (mass, centre, inertia) in H25_LINKS.items():
        in_the_middle = name in ("torso", "neck", "head")
        for side, sign in {"": 1.0}.items() if in_the_middle else (("left_", 1.0), ("right_", -1.0)):
            body = model.body(side + name)
            np.testing.assert_allclose(body.mass, mass, rtol=1e-9, err_msg=name)
            place = 1e-3 * np.array(centre) * [1.0, sign, 1.0]
            np.testing.assert_allclose(body.ipos, place, atol=1e-9, err_msg=name)
            # MuJoCo sorts principal moments and turns the frame.
            axes = np.zeros(9)
            mujoco.mju_quat2Mat(axes, body.iquat)
            axes = axes.reshape(3, 3)
            tensor = axes @ np.diag(body.inertia) @ axes.T
            np.testing.assert_allclose(tensor, 1e-4 * np.diag(inertia), atol=1e-9, err_msg=name)
    np.testing.assert_allclose(model.body_mass.sum(), 5.19535, atol=1e-9)


def test_the_real_robots_one_yaw_motor_turns_both_legs():
    model, nao = load(NAO_H25), load(NAO)
    assert NAO_H25.has_one_yaw_motor and not NAO.has_one_yaw_motor and nao.neq == 0
    # In the air, where no foot is held.
    model.opt.gravity[:] = 0.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    data.ctrl[JOINT_NAMES.index("left_hip_yaw_pitch")] = -0.2
    for _ in range(250):
        mujoco.mj_step(model, data)
    left, right = (data.joint(f"{side}_hip_yaw_pitch").qpos[0] for side in SIDE_NAMES)
    # The two servos, half a motor each, pull it to the middle of their set-points.
    np.testing.assert_allclose([left, right], -0.1, atol=0.03)
    np.testing.assert_allclose(left, right, atol=5e-3)


def test_only_sole_spheres_and_floor_collide(model):
    names = [model.geom(i).name for i in range(model.ngeom)]
    bits = list(zip(names, model.geom_contype, model.geom_conaffinity, strict=True))
    pairs = {
        frozenset((first[0], second[0]))
        for first, second in itertools.combinations(bits, 2)
        if (first[1] & second[2]) or (second[1] & first[2])
    }
    soles = [f"{side}_{corner}" for side in SIDE_NAMES for corner in SOLE_CORNERS]
    assert pairs == {frozenset(("floor", sole)) for sole in soles}
    assert all((model.geom(sole).condim == 3).all() and model.geom(sole).friction[0] == 1.0 for sole in soles)


def test_looks_weigh_nothing(model, robot):
    """Compile without the geoms that are only seen: the robot is the same."""
    spec = mujoco.MjSpec.from_file(str(path_of(robot)))
    spec.compiler.discardvisual = True
    bare = spec.compile()
    assert bare.ngeom == 9
    np.testing.assert_allclose(bare.body_inertia, model.body_inertia, atol=1e-12)
    np.testing.assert_allclose(bare.body_ipos, model.body_ipos, atol=1e-12)


def test_sensors_read_the_torso(model, data):
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    data.qvel[:6] = [0.3, -0.1, 0.2, 0.4, 0.5, -0.6]  # world linear, body angular velocity
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.sensor("orientation").data, [1, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(data.sensor("velocimeter").data, [0.3, -0.1, 0.2], atol=1e-9)
    np.testing.assert_allclose(data.sensor("gyro").data, [0.4, 0.5, -0.6], atol=1e-9)
    assert data.sensor("accelerometer").data.shape == (3,)


def test_keyframe_puts_both_soles_flat_on_the_floor(model, data):
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    mujoco.mj_kinematics(model, data)
    for side in SIDE_NAMES:
        np.testing.assert_allclose(data.site(f"{side}_sole").xpos[2], 0.0, atol=1e-5)
        np.testing.assert_allclose(data.site(f"{side}_sole").xmat.reshape(3, 3), np.eye(3), atol=2e-4)
    np.testing.assert_allclose(data.qpos[7:], data.ctrl)
    low, high = model.actuator_ctrlrange.T
    assert (data.ctrl > low).all() and (data.ctrl < high).all()


def test_stands_still_for_two_seconds(model, data):
    mujoco.mj_resetDataKeyframe(model, data, model.key("stand").id)
    start = data.qpos.copy()
    for _ in range(round(2.0 / model.opt.timestep)):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos - start).max() < 0.02
    assert np.abs(data.qvel).max() < 0.02
    weight = model.body_mass.sum() * 9.81
    np.testing.assert_allclose(np.linalg.norm(data.sensor("accelerometer").data), 9.81, atol=0.05)
    np.testing.assert_allclose(data.qfrc_constraint[2], weight, rtol=0.02)


@pytest.mark.usefixtures("relaxed_promotion")
def test_mjx_accepts_the_model(model):
    assert mjx.put_model(model).nq == model.nq


def test_file_loads_nothing_from_elsewhere(robot):
    """No mesh, texture file or include: the model is one file."""
    elements = list(ElementTree.parse(path_of(robot)).iter())
    assert not {element.tag for element in elements} & {"mesh", "include", "hfield", "skin"}
    assert all("file" not in element.attrib for element in elements)


def test_a_model_that_does_not_fit_its_robot_is_an_error():
    check_model(load(NAO), NAO)
    check_model(load(NAO_H25), NAO_H25)
    with pytest.raises(ValueError, match=r"left_shoulder_yaw must have the range of the robot nao_h25.* got"):
        check_model(load(NAO), NAO_H25)
    spec = mujoco.MjSpec.from_file(str(path_of(NAO)))
    spec.body("right_shank").pos[2] = -0.13
    with pytest.raises(ValueError, match=r"right_knee must be where the robot nao has it, .*-0\.235.* got"):
        check_model(spec.compile(), NAO)


@pytest.mark.parametrize(
    ("largest", "is_limited", "found"),
    [(4, True, "-5 to 4"), (6, True, "-5 to 6"), (5, False, "-inf")],
)
def test_a_model_with_other_motors_is_an_error(largest, is_limited, found):
    model = load(NAO_H25)
    knee = JOINT_NAMES.index("left_knee")
    model.actuator_forcerange[knee], model.actuator_forcelimited[knee] = (-5.0, largest), is_limited
    with pytest.raises(ValueError, match=f"left_knee must .*the robot nao_h25, -5 to 5 N m, got {found}"):
        check_model(model, NAO_H25)


def test_a_model_with_another_number_of_yaw_motors_is_an_error():
    model = load(NAO_H25)
    two_motors = dataclasses.replace(NAO_H25, has_one_yaw_motor=False)
    with pytest.raises(ValueError, match=r"must not hold .* of the robot nao_h25 is False, got one such"):
        check_model(model, two_motors)
    model.eq_active0[:] = 0
    check_model(model, two_motors)
    with pytest.raises(ValueError, match=r"must hold .* of the robot nao_h25 is True, got no such"):
        check_model(model, NAO_H25)


def test_a_model_with_thicker_feet_is_an_error():
    model = load(NAO)
    model.geom_size[[model.geom(f"right_{corner}").id for corner in SOLE_CORNERS], 0] += 0.005
    with pytest.raises(ValueError, match=r"right sole must be .* the robot nao has it, 0\.045 m, got 0\.05"):
        check_model(model, NAO)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint_lower": (0.0,)}, "joint_lower must have 22 entries, got 1"),
        ({"joint_lower": NAO.joint_upper}, "the lower limit of head_yaw must be below the upper, got 2.09"),
        ({"has_one_yaw_motor": True}, "must have ankle axes that meet, ankle_drop 0, got 0.005"),
    ],
)
def test_a_robot_that_cannot_be_is_an_error(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(NAO, **changes)
