"""A humanoid that is read from its model: its values, its motors, and the model in which it walks."""

import dataclasses

import mujoco
import numpy as np
import pytest

from creps_jax.robots.mjcf import humanoid_from_mjcf
from creps_jax.robots.screw_kinematics import chain_fk
from creps_jax.robots.spec import humanoid_from_toml
from creps_jax.simulation.models import check_model, load_model
from creps_jax.simulation.servos import read_servos
from tests.robots.small_humanoid import FEET, MOTOR, PARTS, SPEC, write_model

THIGH, SHANK = np.hypot(0.015, 0.2), np.hypot(0.005, 0.2)
LENGTH = THIGH + SHANK
ARMS = ("left_shoulder", "head", "right_shoulder")
JOINTS = (*ARMS, *SPEC["left_leg"], *SPEC["right_leg"])
POSITION = '<position name="{name}" joint="{name}" kp="50" ctrlrange="-0.9 1.1" forcerange="-7 6"/>'


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return write_model(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="module")
def robot(path):
    return humanoid_from_mjcf(path, **SPEC)


def read(tmp_path, *replacements, spec=SPEC, **changes):
    return humanoid_from_mjcf(write_model(tmp_path, *replacements, **changes), **spec)


def joint(robot, name):
    return robot.joint_names.index(name)


def standing(robot):
    """Return the kinematics of the model in the posture, with the trunk at the origin."""
    data = mujoco.MjData(robot.model)
    data.qpos[:7] = 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    data.qpos[read_servos(robot.model).qpos_index] = robot.posture
    mujoco.mj_forward(robot.model, data)
    return data


def test_lengths_are_those_of_the_model(robot):
    assert robot.name == "small" and robot.joint_names == JOINTS == robot.own_names
    assert [JOINTS[i] for i in robot.left_leg] == SPEC["left_leg"]
    assert [JOINTS[i] for i in robot.right_leg] == SPEC["right_leg"]
    assert robot.leg_length == pytest.approx(LENGTH)
    assert robot.hip_centre == pytest.approx((0.03, -0.09))
    # The soles reach 0.04 m inwards from the ankles; their distance scales with the leg.
    assert robot.foot_spacing == pytest.approx(0.08 + 0.02 * robot.size)
    assert robot.ankle_height == pytest.approx(0.06)
    assert robot.torso_height == pytest.approx(LENGTH + 0.06 + 0.09)
    assert robot.zmp_ahead_of_ankle == pytest.approx(0.03)
    np.testing.assert_allclose(robot.left.sole[:3, 3], [0.04, 0.07, -0.55], atol=1e-9)
    np.testing.assert_allclose(robot.right.sole[:3, 3], [0.04, -0.07, -0.55], atol=1e-9)


def test_the_centre_of_mass_is_that_of_mujoco_in_the_posture(robot):
    x, _, z = standing(robot).subtree_com[1]
    assert robot.com_ahead_of_hip == pytest.approx(x - 0.03, abs=1e-6)
    assert robot.com_above_hip == pytest.approx(z + 0.09, abs=1e-6)


def test_in_the_posture_knees_are_bent_and_soles_are_level_below_the_hips(robot):
    data = standing(robot)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        foot = data.body(f"{side}_foot")
        np.testing.assert_allclose(foot.xmat.reshape(3, 3), np.eye(3), atol=1e-4)
        np.testing.assert_allclose(foot.xpos[:2], [0.03, 0.07 * sign], atol=1e-4)
        assert -0.09 - foot.xpos[2] - 0.02 == pytest.approx(0.88 * LENGTH, abs=1e-4)
        assert sign * robot.posture[joint(robot, f"{side}_knee")] > 0.5
    assert [robot.posture[joint(robot, name)] for name in ARMS] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("foot", ["box", "sphere", "capsule", "cylinder", "ellipsoid"])
def test_soles_of_all_shapes_have_the_same_height(foot, tmp_path):
    robot = read(tmp_path, foot=foot)
    assert robot.ankle_height == pytest.approx(0.06, abs=1e-6)
    assert robot.zmp_ahead_of_ankle == pytest.approx(0.03, abs=1e-6)
    inner = {"box": 0.04, "sphere": 0.04, "capsule": 0.04, "cylinder": 0.055, "ellipsoid": 0.03}[foot]
    assert robot.foot_spacing == pytest.approx(min(0.14, 2 * inner + 0.02 * robot.size))
    # Both feet stand on the floor at this height.
    data = standing(robot)
    data.qpos[2] = -data.body("left_foot").xpos[2] + 0.04 - 1e-4
    mujoco.mj_forward(robot.model, data)
    floor = robot.model.geom("creps_jax_floor").id
    assert data.ncon >= 4 and all(floor in contact.geom for contact in data.contact)
    assert max(abs(contact.dist) for contact in data.contact) < 2e-4


@pytest.mark.parametrize(
    ("motor", "torque"),
    [
        ('<motor name="{name}" joint="{name}" gear="2" ctrlrange="-8 8"/>', 16.0),
        ('<motor name="{name}" joint="{name}" gear="-2" ctrlrange="-8 7"/>', 14.0),
        ('<motor name="{name}" joint="{name}" gear="2" forcerange="-3 3"/>', 6.0),
        ('<motor name="{name}" joint="{name}" gear="2" forcerange="-3 3" ctrlrange="-1 1"/>', 2.0),
        ('<general name="{name}" joint="{name}" gainprm="5" gear="3" ctrlrange="-1 1"/>', 15.0),
        (POSITION, 6.0),
        ('<velocity name="{name}" joint="{name}" kv="1" forcerange="-5 5"/>', 5.0),
        (
            '<motor name="{name}" joint="{name}" ctrlrange="-8 8"/>'
            '<motor name="{name}_2" joint="{name}" gear="-2" ctrlrange="-2 2"/>',
            12.0,
        ),
        (
            '<motor name="{name}" joint="{name}" ctrlrange="0 8"/>'
            '<motor name="{name}_2" joint="{name}" ctrlrange="-7 0"/>',
            7.0,
        ),
        (POSITION + POSITION.replace('name="{name}"', 'name="{name}_2"').replace("-7 6", "-1 2"), 8.0),
        (POSITION + '<velocity name="{name}_2" joint="{name}" kv="1" forcerange="-5 5"/>', 11.0),
        ('<motor name="{name}" joint="{name}" ctrlrange="-8 8"/><motor joint="{name}" gear="0"/>', 8.0),
    ],
    ids=[
        "ctrlrange",
        "negative gear",
        "forcerange",
        "smallest",
        "general",
        "position",
        "velocity",
        "two motors",
        "one motor for each direction",
        "two servos",
        "servo and damper",
        "motor without gear",
    ],
)
def test_torque_is_the_sum_of_the_limits_of_the_actuators(motor, torque, tmp_path):
    robot = read(tmp_path, motor=motor, arms=False)
    assert robot.max_joint_torque == pytest.approx((torque,) * 12)
    np.testing.assert_allclose(read_servos(robot.model).torque_range, [[-torque] * 12, [torque] * 12])


def test_the_torque_of_several_actuators_is_that_of_mujoco(tmp_path):
    knee = MOTOR.format(name="left_knee")
    second = '<motor name="second" joint="left_knee" ctrlrange="-3 3"/>'
    robot = read(tmp_path, (knee, knee + second))
    data = mujoco.MjData(own := mujoco.MjModel.from_xml_path(str(tmp_path / "small.xml")))
    data.ctrl[:] = own.actuator_ctrlrange[:, 1]
    mujoco.mj_forward(own, data)
    torque = data.joint("left_knee").qfrc_actuator[0]
    assert robot.max_joint_torque[joint(robot, "left_knee")] == pytest.approx(torque) == pytest.approx(19.0)


def test_torque_may_be_limited_by_the_joint_or_given(tmp_path):
    limited = '"{}_knee" axis="0 {} 0" actuatorfrcrange="-{} {}"'
    changes = [
        (f'"{side}_knee" axis="0 {sign} 0"', limited.format(side, sign, low, high))
        for side, sign, low, high in (("left", 1, 11, 12), ("right", -1, 20, 20))
    ]
    robot = read(tmp_path, *changes)
    torques = dict(zip(JOINTS, robot.max_joint_torque, strict=True))
    assert torques["left_knee"] == 11.0 and torques["right_knee"] == 16.0 == torques["head"]
    plain = '<motor name="{name}" joint="{name}"/>'
    spec = SPEC | {"max_torque": 9.0}
    robot = read(tmp_path, *changes, motor=plain, spec=spec)
    torques = dict(zip(JOINTS, robot.max_joint_torque, strict=True))
    # The limits that the model states are kept.
    assert torques["left_knee"] == 11.0 and torques["right_knee"] == 20.0 and torques["head"] == 9.0


def test_ranges_are_those_of_the_joints_where_the_knees_are_ahead(robot):
    lower, upper = (
        dict(zip(JOINTS, limits, strict=True)) for limits in (robot.joint_lower, robot.joint_upper)
    )
    assert (lower["left_hip_yaw"], upper["left_hip_yaw"]) == (-1.0, 0.8)
    # The yaw axes of both legs are opposite to each other, as mirrored ones.
    assert (lower["right_hip_yaw"], upper["right_hip_yaw"]) == (-1.0, 0.8)
    assert (lower["left_knee"], upper["left_knee"]) == (0.0, 2.2)
    assert (lower["right_knee"], upper["right_knee"]) == (-2.2, 0.0)
    assert (lower["head"], upper["head"]) == (-1.0, 1.0)


def test_a_knee_that_bends_both_ways_is_limited_to_the_front(tmp_path):
    robot = read(tmp_path, ('range="0.0 2.2"', 'range="-2.2 2.2"'), ('range="-2.2 0.0"', 'range="-2.2 2.2"'))
    # At zero the shank is bent by 0.1 rad against the thigh; 0.03 rad are left.
    bend = np.arctan(0.005 / 0.2) + np.arctan(0.015 / 0.2)
    assert robot.joint_lower[joint(robot, "left_knee")] == pytest.approx(0.03 - bend)
    assert robot.joint_upper[joint(robot, "right_knee")] == pytest.approx(bend - 0.03)
    assert robot.joint_upper[joint(robot, "left_knee")] == 2.2


def test_joints_without_limits_turn_once_or_as_their_servos(tmp_path):
    robot = read(tmp_path, ('"head" axis="0 0 1" range="-1 1"', '"head" axis="0 0 1"'))
    assert robot.joint_lower[joint(robot, "head")] == -np.pi and robot.joint_upper[1] == np.pi
    head = ('"head" axis="0 0 1" range="-1 1"', '"head" axis="0 0 1"')
    motor = (MOTOR.format(name="head"), POSITION.format(name="head"))
    robot = read(tmp_path, head, motor)
    assert (robot.joint_lower[1], robot.joint_upper[1]) == (-0.9, 1.1)
    # The servo and the joint: both limit.
    robot = read(tmp_path, motor)
    assert (robot.joint_lower[1], robot.joint_upper[1]) == (-0.9, 1.0)


@pytest.mark.parametrize("gear", [2.0, 0.5, -3.0])
def test_the_range_of_a_geared_servo_is_that_of_its_joint(gear, tmp_path):
    low, high = sorted((-0.9 * gear, 1.1 * gear))
    head = ('"head" axis="0 0 1" range="-1 1"', '"head" axis="0 0 1"')
    servo = f'<position name="head" joint="head" kp="50" gear="{gear}" forcerange="-7 6" '
    servo += f'ctrlrange="{low} {high}"/>'
    robot = read(tmp_path, head, (MOTOR.format(name="head"), servo))
    assert (robot.joint_lower[1], robot.joint_upper[1]) == pytest.approx((-0.9, 1.1))
    # The set-points are those of MuJoCo: the file's own servo moves the joint to its limits.
    own = mujoco.MjModel.from_xml_path(str(tmp_path / "small.xml"))
    data = mujoco.MjData(own)
    for angle, point in ((-0.9, low if gear > 0 else high), (1.1, high if gear > 0 else low)):
        data.joint("head").qpos[0], data.actuator("head").ctrl[0] = angle, point
        mujoco.mj_forward(own, data)
        assert data.actuator("head").force[0] == pytest.approx(0.0, abs=1e-9)


def test_a_servo_without_gear_has_no_range(tmp_path):
    idle = '<position name="idle" joint="head" gear="0" ctrlrange="-0.1 0.1"/>'
    robot = read(tmp_path, ("<actuator>", f"<actuator>{idle}"))
    assert (robot.joint_lower[1], robot.joint_upper[1]) == (-1.0, 1.0)


def test_what_is_given_is_taken(path):
    crouch = [0.0, 0.0, -0.6, 1.2, -0.6, 0.0]
    robot = humanoid_from_mjcf(
        path,
        **SPEC,
        name="tiny",
        crouch=crouch,
        held={"left_shoulder": 0.3, "right_shoulder": -0.2},
        arm_swing={"left_shoulder": -5.0},
        kp=80.0,
        kv=2.0,
        max_speed={"head": 3.0},
        foot_spacing=0.13,
        speeds=[0.2, 0.4],
    )
    assert robot.name == "tiny" and robot.speeds == (0.2, 0.4)
    assert [robot.posture[joint(robot, name)] for name in ARMS] == [0.3, 0.0, -0.2]
    assert robot.foot_spacing == 0.13
    assert robot.arm_swing == (-5.0,) + (0.0,) * 14
    assert robot.max_joint_speed == (8.0, 3.0) + (8.0,) * 13
    servos = read_servos(robot.model)
    assert set(servos.stiffness.tolist()) == {80.0} and set(servos.damping.tolist()) == {2.0}
    assert robot.source["kp"] == 80.0 and "max_torque" not in robot.source
    assert humanoid_from_mjcf(path, **SPEC, max_speed=5.0).max_joint_speed == (5.0,) * 15


@pytest.mark.parametrize("spacing", [0.081, 0.4])
def test_feet_may_be_as_close_as_they_are_wide_or_almost_a_leg_apart(spacing, path):
    assert humanoid_from_mjcf(path, **SPEC, foot_spacing=spacing).foot_spacing == spacing


def test_a_crouch_leads_to_the_same_posture_with_the_signs_of_the_right_leg(path, robot):
    crouched = humanoid_from_mjcf(path, **SPEC, crouch=[0.0, 0.0, -0.9, 1.6, -0.7, 0.0])
    np.testing.assert_allclose(crouched.posture, robot.posture, atol=1e-4)


@pytest.fixture(scope="module")
def offset(tmp_path_factory):
    """Return the humanoid with ankles whose zero is turned by 0.5 rad: its soles are level in the crouch."""
    link, ankle = '"{}_ankle_pitch_link" pos="-0.005 0 -0.2"', '"{}_ankle_pitch" axis="0 1 0" range="{} {}"'
    changes = []
    for side in ("left", "right"):
        changes.append((link.format(side), f'{link.format(side)} euler="0 0.5 0"'))
        changes.append((ankle.format(side, -1.3, 1.0), ankle.format(side, -1.8, 0.5)))
    path = write_model(tmp_path_factory.mktemp("offset"), *changes)
    return humanoid_from_mjcf(path, **SPEC, crouch=[0.0, 0.0, -0.6, 1.2, -1.1, 0.0])


def test_soles_may_be_level_in_the_crouch_alone(robot, offset):
    for name in (
        "hip_centre",
        "leg_length",
        "foot_spacing",
        "ankle_height",
        "torso_height",
        "com_above_hip",
        "com_ahead_of_hip",
        "zmp_ahead_of_ankle",
        "speeds",
    ):
        assert getattr(offset, name) == pytest.approx(getattr(robot, name), abs=1e-5), name
    turned = np.array([0.5 if "ankle_pitch" in name else 0.0 for name in JOINTS])
    np.testing.assert_allclose(offset.posture + turned, robot.posture, atol=1e-4)
    np.testing.assert_allclose(offset.joint_lower + turned, robot.joint_lower, atol=1e-6)


def test_a_sole_that_is_level_in_the_crouch_has_the_same_poses(robot, offset):
    turned = np.array([0.0, 0.0, 0.0, 0.0, 0.5, 0.0], np.float32)
    angles = np.array([0.3, 0.2, -0.7, 0.9, -0.4, 0.2], np.float32)
    for ours, theirs in ((offset.left, robot.left), (offset.right, robot.right)):
        np.testing.assert_allclose(chain_fk(angles - turned, ours), chain_fk(angles, theirs), atol=1e-6)
        # At zero the toes are down.
        assert ours.sole[2, 0] == pytest.approx(-np.sin(0.5))


def test_a_crouch_may_turn_the_hips(tmp_path):
    changes = [
        (f'"{side}_hip_roll_link"', f'"{side}_hip_roll_link" euler="{turn} 0 0"')
        for side, turn in (("left", 0.2), ("right", -0.2))
    ]
    robot = read(tmp_path, *changes, spec=SPEC | {"crouch": [0.0, -0.2, -0.6, 1.2, -0.6, 0.0]})
    # At zero the ankles are farther out than in the crouch.
    assert robot.left.points[-1, 1] > 0.15
    assert robot.ankle_height == pytest.approx(0.06)
    np.testing.assert_allclose(robot.foot_spacing, 0.08 + 0.02 * robot.size, rtol=1e-6)
    data = standing(robot)
    for side, sign, roll in (("left", 1.0, -0.2), ("right", -1.0, 0.2)):
        foot = data.body(f"{side}_foot")
        np.testing.assert_allclose(foot.xmat.reshape(3, 3), np.eye(3), atol=1e-4)
        np.testing.assert_allclose(foot.xpos[:2], [0.03, 0.07 * sign], atol=1e-4)
        assert robot.posture[joint(robot, f"{side}_hip_roll")] == pytest.approx(roll, abs=1e-3)


def test_a_joint_that_cannot_be_zero_is_held_at_its_limit(tmp_path):
    robot = read(tmp_path, ('"head" axis="0 0 1" range="-1 1"', '"head" axis="0 0 1" range="0.2 1"'))
    assert robot.posture[joint(robot, "head")] == 0.2


def test_gains_and_speeds_follow_from_weight_and_leg(robot):
    servos = read_servos(robot.model)
    mass = robot.model.body_mass.sum()
    assert mass == pytest.approx(3.0 + 0.3 + 2 * 0.3 + 2 * (5 * 0.2 + 0.2))
    np.testing.assert_allclose(servos.stiffness, 10.0 * mass * 9.81 * LENGTH, rtol=1e-5)
    np.testing.assert_allclose(servos.damping / servos.stiffness, 0.01 * np.sqrt(LENGTH / 0.22), rtol=2e-2)
    assert robot.speeds == pytest.approx((0.1 * np.sqrt(robot.size), 0.5 * np.sqrt(robot.size)))
    assert [type(speed) for speed in robot.speeds] == [float, float]


def test_the_damping_of_joints_counts_in_the_lead_of_the_servos(tmp_path):
    damped = read(
        tmp_path,
        ('"head" axis="0 0 1"', '"head" axis="0 0 1" damping="0.7"'),
        spec=SPEC | {"kp": 50.0, "kv": 1.0},
    )
    servos = read_servos(damped.model)
    assert servos.joint_damping[joint(damped, "head")] == pytest.approx(0.7)
    np.testing.assert_allclose(servos.lead[joint(damped, "head")], 1.7 / 50.0, rtol=1e-6)
    np.testing.assert_allclose(np.delete(servos.lead, joint(damped, "head")), 1.0 / 50.0, rtol=1e-6)


def test_the_actuators_drive_the_joints_in_their_order(robot):
    model = load_model(robot)
    assert model is robot.model
    assert [model.actuator(i).name for i in range(model.nu)] == list(JOINTS)
    assert [model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu)] == list(JOINTS)
    check_model(model, robot)
    check_model(robot.film_model, robot)


def test_a_model_in_another_order_is_the_same_robot(tmp_path, robot):
    other = read(tmp_path, sides=("right", "left"), actuators_reversed=True)
    assert other.joint_names == (*ARMS, *SPEC["right_leg"], *SPEC["left_leg"])
    assert [other.joint_names[i] for i in other.left_leg] == SPEC["left_leg"]
    for name in ("posture", "joint_lower", "joint_upper"):
        ours, theirs = (dict(zip(who.joint_names, getattr(who, name), strict=True)) for who in (robot, other))
        assert theirs == pytest.approx(ours, abs=1e-6), name
    for name in ("leg_length", "foot_spacing", "com_above_hip", "com_ahead_of_hip", "torso_height"):
        assert getattr(other, name) == pytest.approx(getattr(robot, name), abs=1e-6), name
    check_model(other.model, other)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joint_names": ("x", *JOINTS[1:])}, "the model's actuators must drive .* in this order"),
        (
            {"joint_lower": (-9.0,) * 15},
            "the model's left_shoulder must have the range of the robot",
        ),
        ({"max_joint_torque": (5.0,) * 15}, "the servo of the model's left_shoulder must have the torque"),
    ],
)
def test_a_model_that_does_not_fit_is_named(robot, change, message):
    with pytest.raises(ValueError, match=message):
        check_model(robot.model, dataclasses.replace(robot, **change))


def test_only_the_feet_touch_each_other_and_all_solids_touch_the_floor(robot):
    model = robot.model
    floor = model.geom("creps_jax_floor").id
    feet = {model.geom(f"{side}_sole").id for side in ("left", "right")}
    for first in range(model.ngeom):
        for second in range(first):
            touch = (model.geom_contype[first] & model.geom_conaffinity[second]) | (
                model.geom_contype[second] & model.geom_conaffinity[first]
            )
            assert bool(touch) == (floor in (first, second) or {first, second} == feet)


def test_what_touches_nothing_in_the_model_touches_no_floor(tmp_path):
    robot = read(tmp_path, ('size="0.04" mass="0.3"', 'size="0.04" mass="0.3" contype="0" conaffinity="0"'))
    skull = robot.model.body("skull").geomadr[0]
    assert robot.model.geom_contype[skull] == 0 == robot.model.geom_conaffinity[skull]


def test_soles_may_touch_by_pairs_alone_and_keep_their_friction(tmp_path):
    robot = read(
        tmp_path,
        ('name="left_sole"', 'name="left_sole" contype="0" conaffinity="0"'),
        ('name="right_sole"', 'name="right_sole" contype="0" conaffinity="0"'),
        (
            "<actuator>",
            '<contact><pair geom1="left_sole" geom2="ground" friction="0.7 0.7 0.01 0.001 0.001"/>'
            '<pair geom1="ground" geom2="right_sole" friction="0.7 0.7 0.01 0.001 '
            '0.001"/></contact><actuator>',
        ),
    )
    for side in ("left", "right"):
        np.testing.assert_allclose(robot.model.geom(f"{side}_sole").friction, [0.7, 0.01, 0.001])
        assert robot.model.geom(f"{side}_sole").contype[0] != 0
    assert robot.model.npair == 0


def test_the_rest_of_the_world_is_left_out(tmp_path, robot):
    other = read(
        tmp_path,
        (
            '<body name="trunk"',
            '<body name="table"><joint type="slide"/><geom type="box" size="1 1 1"/></body><body '
            'name="trunk"',
        ),
        ("</mujoco>", '<keyframe><key name="home"/></keyframe><sensor><gyro site="imu"/></sensor></mujoco>'),
        ('<freejoint name="root"/>', '<freejoint name="root"/><site name="imu"/>'),
    )
    assert other.model.nbody == robot.model.nbody and other.model.nkey == 0 == other.model.nsensor
    assert other.joint_names == robot.joint_names
    np.testing.assert_allclose(other.model.body_mass, robot.model.body_mass)


def test_masses_are_those_of_the_full_model(path, robot):
    full = mujoco.MjModel.from_xml_path(str(path))
    for model in (robot.model, robot.film_model):
        assert model.nbody == full.nbody
        for i in range(1, full.nbody):
            name = full.body(i).name
            np.testing.assert_allclose(model.body(name).mass, full.body(i).mass)
            np.testing.assert_allclose(model.body(name).inertia, full.body(i).inertia)
            np.testing.assert_allclose(model.body(name).ipos, full.body(i).ipos)


SHELL = '<mesh name="shell" file="{}"/>'
TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_the_mass_of_a_mesh_is_kept_and_the_mesh_only_drawn(tmp_path, robot):
    (tmp_path / "shell.obj").write_text(TETRAHEDRON)
    changes = (
        ("<asset>", f"<asset>{SHELL.format('shell.obj')}"),
        ('type="sphere" size="0.04" mass="0.3"', 'type="mesh" mesh="shell" density="3000"'),
    )
    heavy = read(tmp_path, *changes)
    volume = 0.1**3 / 6.0
    np.testing.assert_allclose(heavy.model.body("skull").mass, 3000.0 * volume, rtol=1e-6)
    assert heavy.model.body("skull").geomnum[0] == 0 and heavy.film_model.body("skull").geomnum[0] == 1
    assert heavy.model.nmesh == 0 and heavy.film_model.nmesh == 2


def test_a_model_whose_mesh_files_are_missing_is_read_and_drawn_without(tmp_path, robot):
    shell = ("<asset>", f"<asset>{SHELL.format('missing.stl')}")
    drawn = FEET["box"].format(side="left", y=0.005)
    other = read(
        tmp_path,
        shell,
        (
            drawn,
            drawn.replace("<geom ", '<geom group="3" ', 1)
            + '<geom type="mesh" mesh="shell" contype="0" conaffinity="0" mass="0"/>',
        ),
    )
    np.testing.assert_allclose(other.model.body_mass, robot.model.body_mass)
    assert other.film_model.nmesh == 0 == other.model.nmesh
    # Group 3 is not drawn.
    assert other.model.geom_group.any() and not other.film_model.geom_group.any()
    assert other.posture == pytest.approx(robot.posture)


def test_feet_of_meshes_and_a_box_stand_on_the_box(tmp_path):
    box = FEET["box"].format(side="left", y=0.005), FEET["box"].format(side="right", y=-0.005)
    robot = read(tmp_path, *((each, each + '<geom type="mesh" mesh="foot" mass="0"/>') for each in box))
    assert robot.ankle_height == pytest.approx(0.06)


def test_two_robots_do_not_know_each_other(path, robot, tmp_path):
    before = (robot.leg_length, robot.posture, robot.model.nu, robot.model.actuator_gainprm.copy())
    parts = PARTS[:5]
    five = read(
        tmp_path,
        parts=parts,
        arms=False,
        spec=SPEC | {f"{side}_leg": [f"{side}_{part}" for part in parts] for side in ("left", "right")},
    )
    assert five.num_joints == 10 == five.model.nu and five.ankle_height == pytest.approx(0.06)
    again = humanoid_from_mjcf(path, **SPEC)
    assert again.model is not robot.model and again != robot == robot
    for found in (again, robot):
        assert (found.leg_length, found.posture, found.model.nu) == before[:3]
        np.testing.assert_array_equal(found.model.actuator_gainprm, before[3])


@pytest.mark.parametrize("name", ["my/robot", "Läufer 2.1", "K1 (v2)"])
def test_a_robot_may_have_any_name_of_one_line(name, path):
    assert humanoid_from_mjcf(path, **SPEC, name=name, kp=2.5, max_speed=100).name == name


def test_names_may_be_any(tmp_path):
    names = {"left_": "Links/", "right_": "R "}
    robot = read(
        tmp_path,
        *names.items(),
        spec={
            key: [
                names["left_" if value.startswith("left_") else "right_"] + value.partition("_")[2]
                for value in values
            ]
            for key, values in SPEC.items()
        },
    )
    assert "Links/knee" in robot.joint_names and "R knee" in robot.joint_names


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_a_robot_is_read_from_toml(encoding, tmp_path):
    write_model(tmp_path)
    spec = tmp_path / "walker.toml"
    keys = "".join(f"{key} = {values}\n" for key, values in SPEC.items())
    spec.write_text(
        f'model = "small.xml"\n{keys}kp = 90\nspeeds = [0.1, 0.3]\n[held]\nhead = 1\n', encoding=encoding
    )
    robot = humanoid_from_toml(spec)
    assert robot.name == "walker" and robot.speeds == (0.1, 0.3)
    assert robot.posture[joint(robot, "head")] == 1.0
    assert robot.source["name"] == "walker" and robot.source["kp"] == 90
