"""Leg kinematics: against the simulator's table, inverse of one another, mirrored, finite everywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.numerics.rotations import rigid_transform, rotation_x, rpy_to_matrix
from creps_jax.robots import nao_kinematics
from creps_jax.robots.nao_geometry import (
    GEOMETRY,
    JOINT_LOWER,
    JOINT_NAMES,
    JOINT_UPPER,
    LEFT,
    RIGHT,
    leg_indices,
)
from creps_jax.robots.nao_kinematics import MAX_REACH, MIN_REACH, leg_fk, leg_ik, leg_reach
from creps_jax.robots.robot import NAO, NAO_H25
from tests.oracles import leg_fk_numpy as oracle

SIDES = pytest.mark.parametrize("side", [LEFT, RIGHT])
HIP_CENTRE = np.array([GEOMETRY.hip_x, GEOMETRY.hip_y, GEOMETRY.hip_z])


fk_batch = jax.jit(jax.vmap(leg_fk, (0, None)))
ik_batch = jax.jit(jax.vmap(leg_ik, (0, None)))
ik_jacobian_batch = jax.jit(jax.vmap(jax.jacobian(leg_ik), (0, None)))


def hip(side):
    return HIP_CENTRE * np.array([1.0, side, 1.0])


def random_joints(seed, side, count):
    legs = leg_indices(side)
    random = np.random.default_rng(seed)
    return random.uniform(JOINT_LOWER[legs], JOINT_UPPER[legs], (count, 6)).astype(np.float32)


def hip_height_over_foot(poses, side):
    """Return how high the hip lies above the ankle roll axis, seen from the foot."""
    from_sole = np.einsum("nji,nj->ni", poses[:, :3, :3], hip(side) - poses[:, :3, 3])
    return from_sole[:, 2] - GEOMETRY.foot_down


def ankle_to_hip(poses, joints, side):
    """Return the vector from the ankle pitch axis to the hip in the torso frame."""
    roll_axis = poses[:, :3, 3] + GEOMETRY.foot_down * poses[:, :3, 2]
    ankle_up = np.einsum("nij,nj->ni", poses[:, :3, :3], jax.vmap(rotation_x)(-joints[:, 5])[:, :, 2])
    return hip(side) - roll_axis - GEOMETRY.ankle_drop * ankle_up


@SIDES
def test_fk_agrees_with_the_simulators_body_table(side):
    joints = random_joints(0, side, 200)
    expected = np.stack([oracle.leg_fk(row, side) for row in joints.astype(np.float64)])
    np.testing.assert_allclose(fk_batch(joints, side), expected, atol=1e-6)


def test_straight_leg_ends_where_the_figures_say():
    np.testing.assert_allclose(leg_fk(jnp.zeros(6), LEFT)[:3, 3], [-0.005, 0.055, -0.385], atol=1e-6)
    np.testing.assert_allclose(GEOMETRY.torso_height, 0.385)


@pytest.mark.parametrize(
    ("joint", "expected"),
    [
        (2, lambda pose: pose[0, 3] > 0.0),  # hip pitch swings the leg forward
        (4, lambda pose: pose[2, 0] > 0.0),  # ankle pitch lifts the toes
        (1, lambda pose: pose[1, 3] > GEOMETRY.hip_y),  # hip roll spreads the left leg
    ],
)
def test_positive_angles_move_the_leg_as_documented(joint, expected):
    assert expected(leg_fk(jnp.zeros(6).at[joint].set(0.3), LEFT))


def test_negative_knee_flexes():
    pose = leg_fk(jnp.zeros(6).at[3].set(-0.5), LEFT)
    assert pose[0, 3] < -0.005 and pose[2, 3] > -0.385


@SIDES
def test_ik_undoes_fk_everywhere_inside_the_limits(side):
    joints = random_joints(1, side, 5000)
    poses = np.asarray(fk_batch(joints, side))
    exact = np.abs(hip_height_over_foot(poses, side)) > 1.01 * nao_kinematics._ROLL_FOLD
    assert exact.mean() > 0.98
    # Near a stretched knee a rounding of the distance is magnified 750 times.
    found = ik_batch(poses, side)
    np.testing.assert_allclose(found[exact], joints[exact], atol=3e-4)
    # A folded leg has other angles, and nearly the same pose.
    np.testing.assert_allclose(fk_batch(found, side)[~exact], poses[~exact], atol=1.2e-3)


@SIDES
def test_jacobians_of_ik_and_fk_are_inverse(side):
    walking = jnp.array([-0.2, 0.1 * side, 0.5, -0.9, 0.4, -0.15 * side])
    product = jax.jacobian(lambda joints: leg_ik(leg_fk(joints, side), side))(walking)
    np.testing.assert_allclose(product, np.eye(6), atol=2e-4)


def test_legs_are_mirror_images():
    joints = random_joints(2, LEFT, 100)
    flip_y = np.diag([1.0, -1.0, 1.0, 1.0]).astype(np.float32)
    flip_rolls = np.array([1, -1, 1, 1, 1, -1], np.float32)
    mirrored = np.einsum("ij,njk,kl->nil", flip_y, fk_batch(joints, LEFT), flip_y)
    np.testing.assert_allclose(fk_batch(joints * flip_rolls[None], RIGHT), mirrored, atol=1e-6)
    expected = ik_batch(fk_batch(joints, LEFT), LEFT) * flip_rolls[None]
    np.testing.assert_allclose(ik_batch(mirrored, RIGHT), expected, atol=1e-4)


def test_both_legs_go_through_one_vmap():
    sides = jnp.array([LEFT, RIGHT])
    joints = jnp.stack([jnp.array(random_joints(3, side, 1)[0]) for side in (LEFT, RIGHT)])
    both = jax.vmap(leg_fk)(joints, sides)
    np.testing.assert_allclose(both[1], leg_fk(joints[1], RIGHT), atol=1e-6)
    np.testing.assert_allclose(jax.vmap(leg_ik)(both, sides)[0], leg_ik(both[0], LEFT), atol=1e-6)


def _poses_of_all_sorts():
    """Return poses in and out of reach: near and far, upside down, and on every singular point and line."""
    random = np.random.default_rng(4)
    scales = 10.0 ** random.uniform(-4, 6, (500, 1))
    positions = HIP_CENTRE[None] + scales * random.normal(size=(500, 3))
    rotations = jax.vmap(rpy_to_matrix)(jnp.asarray(random.uniform(-np.pi, np.pi, (500, 3)), jnp.float32))
    lifts = np.array([0.0, GEOMETRY.foot_down, GEOMETRY.ankle_height, -GEOMETRY.foot_down, 0.3])
    special = np.stack([HIP_CENTRE - [0.0, 0.0, lift] for lift in lifts])
    turns = np.array([[0, 0, 0], [np.pi / 4, 0, 0], [-np.pi / 4, 0, 0], [0, np.pi / 2, 0], [np.pi, 0, 0]])
    special_rotations = jax.vmap(rpy_to_matrix)(jnp.asarray(np.repeat(turns, 5, axis=0), jnp.float32))
    positions = jnp.asarray(np.concatenate([positions, np.tile(special, (5, 1))]), jnp.float32)
    return jax.vmap(rigid_transform)(jnp.concatenate([rotations, special_rotations]), positions)


@SIDES
def test_ik_and_its_gradient_are_finite_for_any_pose(side):
    poses = _poses_of_all_sorts()
    joints = ik_batch(poses, side)
    assert np.isfinite(joints).all()
    assert np.isfinite(ik_jacobian_batch(poses, side)).all()
    knee = leg_indices(side).start + 3
    assert joints[:, 3].min() >= JOINT_LOWER[knee] - 1e-3
    assert joints[:, 3].max() <= JOINT_UPPER[knee] + 1e-3


def test_ik_is_finite_at_the_hip_roll_singularity():
    """Turn yaw-pitch and pitch into one line, where only their sum is determined."""
    joints = jnp.array([-0.3, -jnp.pi / 4, 0.4, -0.8, 0.4, 0.0])
    pose = leg_fk(joints, LEFT)
    solution, gradient = leg_ik(pose, LEFT), jax.jacobian(leg_ik)(pose, LEFT)
    assert np.isfinite(solution).all() and np.isfinite(gradient).all()
    np.testing.assert_allclose(leg_fk(solution, LEFT), pose, atol=1e-4)


@SIDES
@pytest.mark.parametrize(("scale", "reach"), [(3.0, MAX_REACH), (0.2, MIN_REACH)])
def test_unreachable_foot_is_held_at_the_reach_with_its_orientation(side, scale, reach):
    random = np.random.default_rng(5)
    offsets = np.array([0.0, 0.0, -0.25]) + random.uniform(-0.06, 0.06, (50, 3))
    rotations = jax.vmap(rpy_to_matrix)(jnp.asarray(random.uniform(-0.2, 0.2, (50, 3)), jnp.float32))
    # Scale the way from the hip to the ankle, not to the sole: the foot stays where it is below the ankle.
    sole_from_ankle = -GEOMETRY.foot_down * rotations[:, :, 2]
    positions = jnp.asarray(hip(side) + scale * offsets, jnp.float32) + sole_from_ankle
    asked = jax.vmap(rigid_transform)(rotations, positions)
    joints = ik_batch(asked, side)
    held = fk_batch(joints, side)
    np.testing.assert_allclose(held[:, :3, :3], asked[:, :3, :3], atol=1e-5)
    held_way, asked_way = (ankle_to_hip(np.asarray(poses), joints, side) for poses in (held, asked))
    lengths = np.linalg.norm(held_way, axis=1, keepdims=True)
    np.testing.assert_allclose(lengths, reach, atol=1e-5)
    directions = asked_way / np.linalg.norm(asked_way, axis=1, keepdims=True)
    np.testing.assert_allclose(held_way / lengths, directions, atol=2e-4)


@SIDES
def test_ik_is_continuous_through_the_reach(side):
    random = np.random.default_rng(6)
    directions = np.array([0.0, 0.0, -1.0]) + random.uniform(-0.5, 0.5, (20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances = np.linspace(0.06, 0.34, 7001)
    positions = hip(side) + distances[None, :, None] * directions[:, None] - [0.0, 0.0, GEOMETRY.ankle_height]
    positions = jnp.asarray(positions.reshape(-1, 3), jnp.float32)
    poses = jax.vmap(rigid_transform, (None, 0))(jnp.eye(3), positions)
    joints = np.asarray(ik_batch(poses, side)).reshape(20, 7001, 6)
    assert joints[:, 0, 3].max() < -2.0 and joints[:, -1, 3].min() > 0.0  # fully bent, stretched
    # The knee's steepest slope is 750 rad/m, at the stretched end; a step is 0.04 mm.
    assert np.abs(np.diff(joints, axis=1)).max() < 0.04


def test_reach_is_that_of_the_knee_at_its_limits():
    ankle = oracle.leg_fk(np.zeros(6), LEFT)[:3, 3] + np.array([0.0, 0.0, GEOMETRY.ankle_height])
    np.testing.assert_allclose(MAX_REACH, np.linalg.norm(ankle - HIP_CENTRE), atol=1e-4)
    assert MIN_REACH < 0.1


@jax.jit
def h25_there_and_back(joints, yaw_pitch):
    """Return the pose of a left leg, and its joints again: freely, with their yaw-pitch, with another."""
    pose = leg_fk(joints, LEFT, robot=NAO_H25)
    free, own, shared = (
        leg_ik(pose, LEFT, robot=NAO_H25, yaw_pitch=given) for given in (None, joints[0], yaw_pitch)
    )
    return pose, free, own, shared, leg_fk(shared, LEFT, robot=NAO_H25)


@pytest.fixture(scope="module")
def h25():
    """Take legs as deep and as wide as a step goes, the knee short of stretched, the sole about level."""
    random = np.random.default_rng(7)
    low, high = np.array([[-0.4, -0.3, -0.3, -1.8, -0.3, -0.3], [0.4, 0.3, 1.4, -0.1, 0.3, 0.3]])
    joints = random.uniform(low, high, (500, 6)).astype(np.float32)
    joints[:, 4] -= joints[:, 2] + joints[:, 3]
    shared = random.uniform(-0.3, 0.3, 500).astype(np.float32)
    return joints, shared, jax.tree.map(np.asarray, jax.vmap(h25_there_and_back)(joints, shared))


def test_ik_undoes_fk_for_another_robot_whether_or_not_it_is_told_the_yaw_pitch(h25):
    joints, _, (_, free, own, _, _) = h25
    np.testing.assert_allclose(free, joints, atol=1e-4)
    np.testing.assert_allclose(own, joints, atol=1e-4)


def test_a_sole_whose_yaw_pitch_is_given_lies_where_it_was_asked_for_but_for_its_toes(h25):
    _, given, (asked, _, _, shared, reached) = h25
    np.testing.assert_allclose(shared[:, 0], given, atol=1e-6)
    np.testing.assert_allclose(reached[:, :3, 3], asked[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(reached[:, :3, 2], asked[:, :3, 2], atol=1e-5)
    assert np.abs(reached[:, :3, 0] - asked[:, :3, 0]).max() > 0.1


def test_a_yaw_pitch_is_given_only_where_the_ankle_axes_meet():
    with pytest.raises(ValueError, match="yaw_pitch must be None for a robot of ankle_drop above 0, got"):
        leg_ik(jnp.eye(4), LEFT, yaw_pitch=0.1)


def test_reach_is_each_robots_own():
    assert leg_reach() == leg_reach(NAO) == (MIN_REACH, MAX_REACH)
    knee = leg_indices(LEFT).start + 3
    g = NAO_H25.geometry
    shortest, longest = leg_reach(NAO_H25)
    bend = NAO_H25.joint_lower[knee]
    ankle = g.thigh_down + g.shank_down * np.exp(1j * bend)
    np.testing.assert_allclose([shortest, longest], [abs(ankle), 0.2029], atol=3e-4)


def test_indices_select_the_joints_of_a_side():
    assert [name.split("_", 1)[1] for name in JOINT_NAMES[leg_indices(LEFT)]] == [
        name.split("_", 1)[1] for name in JOINT_NAMES[leg_indices(RIGHT)]
    ]
    for side, word in ((LEFT, "left_"), (RIGHT, "right_")):
        names = JOINT_NAMES[leg_indices(side)]
        assert len(names) == 6 and all(name.startswith(word) for name in names)
    with pytest.raises(ValueError, match=r"side must be LEFT .* got 0"):
        leg_indices(0)
