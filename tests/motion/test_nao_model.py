"""The model file: it agrees with nao_geometry and the published masses, touches only with its soles."""

import itertools
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from creps_jax.motion.nao_geometry import (
    GEOMETRY,
    JOINT_LOWER,
    JOINT_NAMES,
    JOINT_UPPER,
    LEFT,
    MAX_JOINT_TORQUE,
    NUM_JOINTS,
    RIGHT,
    leg_indices,
)
from creps_jax.motion.nao_kinematics import leg_fk

NAO_XML = Path(__file__).parents[2] / "models" / "nao" / "nao.xml"
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
LINKS = {
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


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_path(str(NAO_XML))


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


def test_limits_agree_with_nao_geometry(model):
    limits = np.stack([JOINT_LOWER, JOINT_UPPER], axis=1)
    np.testing.assert_allclose(model.jnt_range[1:], limits, atol=1e-9)
    np.testing.assert_allclose(model.actuator_ctrlrange, limits, atol=1e-9)
    torques = np.tile([-MAX_JOINT_TORQUE, MAX_JOINT_TORQUE], (NUM_JOINTS, 1))
    np.testing.assert_allclose(model.actuator_forcerange, torques)
    assert model.jnt_limited[1:].all()
    assert model.actuator_ctrllimited.all() and model.actuator_forcelimited.all()


@pytest.mark.parametrize("side", SIDE_NAMES)
def test_lengths_agree_with_nao_geometry(model, data, side):
    g, sign = GEOMETRY, SIDE_NAMES[side]
    hip = np.array([g.hip_x, sign * g.hip_y, g.hip_z])
    knee = hip + np.array([g.thigh_forward, 0.0, -g.thigh_down])
    ankle_pitch = knee - [0.0, 0.0, g.shank_down]
    ankle_roll = ankle_pitch - [0.0, 0.0, g.ankle_drop]
    shoulder = np.array([0.0, sign * g.shoulder_y, g.shoulder_z])
    elbow = shoulder + np.array([g.elbow_forward, 0.0, g.elbow_up])
    places = {
        "hip_yaw_pitch": hip, "hip_roll": hip, "hip_pitch": hip, "knee": knee, "ankle_pitch": ankle_pitch,
        "ankle_roll": ankle_roll, "shoulder_pitch": shoulder, "shoulder_yaw": shoulder, "arm_roll": elbow,
        "elbow": elbow,
    }  # fmt: skip
    for joint, place in places.items():
        np.testing.assert_allclose(joint_position(model, data, f"{side}_{joint}"), place, atol=1e-9)
    sole = data.site(f"{side}_sole").xpos - data.body("torso").xpos
    np.testing.assert_allclose(sole, ankle_roll - [0.0, 0.0, g.foot_down], atol=1e-9)


def test_head_joints_agree_with_nao_geometry(model, data):
    for joint, height in (("head_yaw", GEOMETRY.neck_z), ("head_pitch", GEOMETRY.head_pitch_z)):
        np.testing.assert_allclose(joint_position(model, data, joint), [0.0, 0.0, height], atol=1e-9)


@pytest.mark.parametrize("side", SIDE_NAMES)
def test_sole_spheres_touch_the_ground_at_the_corners_of_the_sole(model, data, side):
    g = GEOMETRY
    mujoco.mj_kinematics(model, data)
    sole = data.site(f"{side}_sole").xpos
    names = [f"{side}_{corner}" for corner in SOLE_CORNERS]
    lowest = np.array([data.geom(n).xpos - [0, 0, model.geom(n).size[0]] for n in names]) - sole[None]
    edges = (g.foot_half_width, -g.foot_half_width)
    corners = [[x, y, 0.0] for x in (g.foot_front, g.foot_back) for y in edges]
    np.testing.assert_allclose(lowest, corners, atol=1e-9)


@pytest.mark.parametrize("side", SIDE_NAMES)
def test_fk_agrees_with_mujoco_on_random_poses(model, data, side):
    random = np.random.default_rng(0)
    for _ in range(20):
        data.qpos[:7] = random.normal(size=7)
        data.qpos[7:] = random.uniform(JOINT_LOWER, JOINT_UPPER)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_kinematics(model, data)
        torso, sole = data.body("torso"), data.site(f"{side}_sole")
        R_torso_world = torso.xmat.reshape(3, 3).T
        joint_pos = jnp.asarray(data.qpos[7:][leg_indices(SIDE_NAMES[side])], jnp.float32)
        pose = np.asarray(leg_fk(joint_pos, SIDE_NAMES[side]))
        np.testing.assert_allclose(pose[:3, :3], R_torso_world @ sole.xmat.reshape(3, 3), atol=3e-6)
        np.testing.assert_allclose(pose[:3, 3], R_torso_world @ (sole.xpos - torso.xpos), atol=1e-6)


def test_masses_and_inertias_are_those_of_the_published_solids(model):
    names = ["torso", "head", *(f"{s}_{link}" for s in SIDE_NAMES for link in (*ARM_LINKS, *LEG_LINKS))]
    for name in names:
        mass, inertia = LINKS[name.removeprefix("left_").removeprefix("right_")]
        body = model.body(name)
        np.testing.assert_allclose(body.mass, mass, rtol=1e-9, err_msg=name)
        np.testing.assert_allclose(np.sort(body.inertia), np.sort(inertia), rtol=1e-6, err_msg=name)
    np.testing.assert_allclose(model.body("neck").mass, 0.05)
    np.testing.assert_allclose(model.body_mass.sum(), 4.6071, atol=1e-9)


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


def test_looks_weigh_nothing(model):
    """Compile without the geoms that are only seen: the robot is the same."""
    spec = mujoco.MjSpec.from_file(str(NAO_XML))
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


def test_file_loads_nothing_from_elsewhere():
    """No mesh, texture file or include: the model is one file."""
    tags = {element.tag for element in ElementTree.parse(NAO_XML).iter()}
    assert not tags & {"mesh", "include", "hfield", "skin"}
    assert all("file" not in element.attrib for element in ElementTree.parse(NAO_XML).iter())
