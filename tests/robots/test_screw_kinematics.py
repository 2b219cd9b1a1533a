"""Kinematics by joint axes: those of MuJoCo and of the NAO, inverse of one another, finite everywhere."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from creps_jax.numerics.rotations import matrix_to_rpy, rigid_transform, rpy_to_matrix
from creps_jax.robots.mjcf import humanoid_from_mjcf
from creps_jax.robots.nao_geometry import JOINT_NAMES, LEFT, RIGHT, leg_indices
from creps_jax.robots.nao_kinematics import leg_fk
from creps_jax.robots.robot import NAO
from creps_jax.robots.screw_kinematics import chain_fk, chain_ik
from creps_jax.simulation.models import model_path
from tests.robots.small_humanoid import PARTS, SPEC, write_model

SIDES = ("left", "right")
FIVE = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch")
NUM = 200
NUM_UPPER = NAO.left_leg[0]
"""Number of a NAO's joints above its legs, the first ones."""


@pytest.mark.parametrize("dtype", [np.int32, bool, np.float16])
def test_poses_and_angles_of_any_numbers_are_solved_in_float32(robot, dtype):
    pose, guess = np.eye(4, dtype=dtype), np.zeros(6, dtype)
    expected = chain_ik(np.eye(4, dtype=np.float32), np.zeros(6, np.float32), robot.left)
    solve = jax.jit(lambda pose, guess: chain_ik(pose, guess, robot.left))
    for angles in (chain_ik(pose, guess, robot.left), solve(jnp.asarray(pose), jnp.asarray(guess))):
        assert angles.dtype == jnp.float32
        np.testing.assert_allclose(angles, expected, atol=1e-6)
    assert chain_fk(guess, robot.left).dtype == jnp.float32


def spec_of(parts):
    return SPEC | {f"{side}_leg": [f"{side}_{part}" for part in parts] for side in SIDES}


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return humanoid_from_mjcf(write_model(tmp_path_factory.mktemp("six")), **SPEC)


@pytest.fixture(scope="module")
def five(tmp_path_factory):
    path = write_model(tmp_path_factory.mktemp("five"), parts=FIVE)
    return humanoid_from_mjcf(path, **spec_of(FIVE))


@pytest.fixture(scope="module")
def compiled(robot):
    """Return fk, ik by 3 and by 30 iterations for each side, vmapped."""
    functions = {}
    for side in SIDES:
        chain = getattr(robot, side)
        functions[side] = (
            jax.jit(jax.vmap(lambda joints, chain=chain: chain_fk(joints, chain))),
            *(
                jax.jit(
                    jax.vmap(
                        lambda pose, guess, chain=chain, num=num: chain_ik(pose, guess, chain, iterations=num)
                    )
                )
                for num in (3, 30)
            ),
        )
    return functions


def random_joints(chain, seed, num=NUM, margin=0.0):
    rng = np.random.default_rng(seed)
    return rng.uniform(chain.lower + margin, chain.upper - margin, (num, len(chain.lower))).astype(np.float32)


def posture_of(robot, side):
    return np.array(robot.posture, np.float32)[list(getattr(robot, f"{side}_leg"))]


def pose_errors(found, wanted):
    """Return the largest distance (m) and the largest angle (rad) between poses."""
    apart = np.linalg.norm(found[:, :3, 3] - wanted[:, :3, 3], axis=1)
    # The sine of the angle, from the skew part: the cosine is too coarse in float32.
    turn = np.einsum("nij,nkj->nik", wanted[:, :3, :3], found[:, :3, :3])
    skew = 0.5 * np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]]
    )
    angle = np.where(np.trace(turn, axis1=1, axis2=2) < 1.0, np.pi, np.linalg.norm(skew, axis=0))
    return apart, angle


def mujoco_sole(model, names, angles, foot):
    """Return the pose of the front of the sole's box, as MuJoCo has it with the trunk at the origin."""
    data = mujoco.MjData(model)
    data.qpos[:3], data.qpos[3:] = 0.0, 0.0
    data.qpos[3] = 1.0
    for name, angle in zip(names, angles, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    body = data.body(foot)
    return body.xmat.reshape(3, 3), body.xpos


@pytest.mark.parametrize("side", SIDES)
def test_fk_is_that_of_mujoco(robot, compiled, side):
    chain = getattr(robot, side)
    joints = random_joints(chain, 0, 50)
    found = np.asarray(compiled[side][0](joints))
    names = SPEC[f"{side}_leg"]
    for angles, pose in zip(joints, found, strict=True):
        rotation, position = mujoco_sole(robot.model, names, angles, f"{side}_foot")
        # The sole is straight below the roll joint, the origin of the foot.
        np.testing.assert_allclose(pose[:3, :3], rotation, atol=2e-6)
        np.testing.assert_allclose(pose[:3, 3], position + rotation @ [0.0, 0.0, -0.04], atol=2e-6)


@pytest.mark.parametrize("side", SIDES)
def test_ik_returns_a_pose_from_the_angles_of_one_period_before(robot, compiled, side):
    fk, ik, _ = compiled[side]
    chain = getattr(robot, side)
    joints = random_joints(chain, 1)
    changes = np.random.default_rng(2).uniform(-1.0, 1.0, joints.shape).astype(np.float32)
    wanted = fk(joints)
    for size, share, largest in ((0.05, 1.0, 1e-5), (0.15, 0.9, 2e-3)):
        found = ik(wanted, joints + size * changes)
        apart, angle = pose_errors(np.asarray(fk(found)), np.asarray(wanted))
        assert np.mean((apart < 1e-5) & (angle < 1e-5)) >= share
        # Near the straight leg and the limits larger changes take more iterations.
        assert apart.max() < largest and angle.max() < largest
        assert (found >= chain.lower.astype(np.float32)[None]).all()
        assert (found <= chain.upper.astype(np.float32)[None]).all()


@pytest.mark.parametrize("side", SIDES)
def test_ik_returns_nearly_every_pose_within_the_limits_from_the_posture(robot, compiled, side):
    fk, _, ik = compiled[side]
    joints = random_joints(getattr(robot, side), 3)
    wanted = fk(joints)
    found = ik(wanted, np.tile(posture_of(robot, side), (NUM, 1)))
    apart, angle = pose_errors(np.asarray(fk(found)), np.asarray(wanted))
    # From few of the poses, turned far, the way along the limits leads to no solution.
    assert np.mean((apart < 1e-5) & (angle < 1e-5)) >= 0.98


def test_out_of_reach_and_at_the_hip_angles_and_gradients_are_finite(robot, compiled):
    chain = robot.left
    rng = np.random.default_rng(4)
    rotations = jax.vmap(rpy_to_matrix)(jnp.asarray(rng.uniform(-3.0, 3.0, (50, 3)), jnp.float32))
    places = 10.0 ** rng.uniform(-1.0, 4.0, (50, 1)) * rng.uniform(-1.0, 1.0, (50, 3))
    places[:10] = chain.points[2]
    places[10] = 0.0
    places[11] = 1e30
    poses = jax.vmap(rigid_transform)(rotations, jnp.asarray(places, jnp.float32))
    guesses = np.tile(posture_of(robot, "left"), (50, 1))
    guesses[::5] = 0.0
    _, _, ik = compiled["left"]
    found = np.asarray(ik(poses, guesses))
    assert np.isfinite(found).all()
    assert (found >= chain.lower - 1e-6).all() and (found <= chain.upper + 1e-6).all()
    jacobian = jax.jit(jax.vmap(jax.jacrev(lambda pose, guess: chain_ik(pose, guess, chain), (0, 1))))
    for gradient in jax.tree.leaves(jacobian(poses, jnp.asarray(guesses))):
        assert np.isfinite(np.asarray(gradient)).all()


def test_out_of_reach_the_leg_points_to_the_pose(robot, compiled):
    fk, _, ik = compiled["left"]
    pose = robot.left.sole.astype(np.float32)
    pose[2, 3] -= 0.1
    angles = ik(pose[None], posture_of(robot, "left")[None])
    sole = np.asarray(fk(angles))[0]
    np.testing.assert_allclose(sole[:2, 3], pose[:2, 3], atol=5e-3)
    assert abs(np.asarray(angles)[0, PARTS.index("knee")]) < 0.1


def test_one_leg_is_solved_as_many_are(robot, compiled):
    fk, ik, _ = compiled["right"]
    chain = robot.right
    joints = random_joints(chain, 5, 4)
    guesses = joints + 0.05
    poses = fk(joints)
    many = ik(poses, guesses)
    one = jax.jit(lambda pose, guess: chain_ik(pose, guess, chain))
    for pose, guess, expected in zip(poses, guesses, many, strict=True):
        np.testing.assert_allclose(one(pose, guess), expected, atol=1e-5)


@pytest.mark.parametrize("direction", ["down", "up"])
def test_angles_are_continuous_through_the_straight_leg(robot, direction):
    chain = robot.left
    heights = np.concatenate([np.linspace(0.06, -0.02, 200), np.linspace(-0.02, 0.06, 200)])
    heights = heights if direction == "down" else heights[::-1]
    poses = np.tile(chain.sole.astype(np.float32), (400, 1, 1))
    poses[:, 2, 3] += heights

    def follow(last, pose):
        joints = chain_ik(pose, last, chain)
        return joints, joints

    start = chain_ik(jnp.asarray(poses[0]), jnp.asarray(posture_of(robot, "left")), chain, iterations=30)
    angles = np.asarray(jax.jit(lambda start, poses: jax.lax.scan(follow, start, poses)[1])(start, poses))
    # The knee of a leg that is nearly straight turns fast: by the root of the way.
    assert np.abs(np.diff(angles, axis=0)).max() < 0.05
    reached = jax.vmap(lambda joints: chain_fk(joints, chain))(jnp.asarray(angles))
    within = heights > 0.005
    np.testing.assert_allclose(reached[within, :3, 3], poses[within, :3, 3], atol=1e-5)
    np.testing.assert_allclose(reached[:, :2, 3], poses[:, :2, 3], atol=1e-3)


def walk_poses(robot, side, num=100):
    """Return poses of a sole along a step: forward, up, turned and leaned as far as a walk does."""
    chain = getattr(robot, side)
    time = np.linspace(0.0, 2.0 * np.pi, num)
    place = np.tile(chain.sole[:3, 3], (num, 1))
    place += robot.leg_length * np.stack(
        [0.12 * np.sin(time), 0.06 * np.cos(time), 0.15 + 0.04 * np.sin(2.0 * time)], axis=1
    )
    rpy = np.stack([0.05 * np.sin(time), 0.1 * np.cos(time), 0.15 * np.sin(time + 1.0)], axis=1)
    rotations = jax.vmap(rpy_to_matrix)(jnp.asarray(rpy, jnp.float32))
    return jax.vmap(rigid_transform)(rotations, jnp.asarray(place, jnp.float32)), rpy


@pytest.mark.parametrize("side", SIDES)
def test_a_leg_of_five_joints_holds_place_and_pitch(five, side):
    chain = getattr(five, side)
    assert chain.weights.tolist() == [1.0, 1.0, 1.0, 0.03, 1.0, 1.0]
    poses, rpy = walk_poses(five, side)
    start = np.tile(posture_of(five, side), (len(poses), 1))
    ik = jax.jit(jax.vmap(lambda pose, guess: chain_ik(pose, guess, chain, iterations=30)))
    found = jax.vmap(lambda joints: chain_fk(joints, chain))(ik(poses, start))
    np.testing.assert_allclose(found[:, :3, 3], poses[:, :3, 3], atol=2e-3)
    turned = np.asarray(jax.vmap(matrix_to_rpy)(found[:, :3, :3]))
    np.testing.assert_allclose(turned[:, 1], rpy[:, 1], atol=5e-3)
    np.testing.assert_allclose(turned[:, 2], rpy[:, 2], atol=2e-2)


def test_a_leg_of_five_joints_without_yaw_rolls_its_foot(tmp_path):
    parts = PARTS[1:]
    robot = humanoid_from_mjcf(write_model(tmp_path, parts=parts), **spec_of(parts))
    assert robot.left.weights.tolist() == [1.0, 1.0, 1.0, 1.0, 1.0, 0.03]
    poses, _ = walk_poses(robot, "left")
    start = np.tile(posture_of(robot, "left"), (len(poses), 1))
    ik = jax.jit(jax.vmap(lambda pose, guess: chain_ik(pose, guess, robot.left, iterations=30)))
    found = jax.vmap(lambda joints: chain_fk(joints, robot.left))(ik(poses, start))
    np.testing.assert_allclose(found[:, :3, 3], poses[:, :3, 3], atol=2e-3)
    # The sole is as level as that of the pose, whose yaw it cannot have.
    np.testing.assert_allclose(found[:, 2, 2], poses[:, 2, 2], atol=1e-2)


@pytest.fixture(scope="module")
def nao():
    legs = (tuple(f"{side}_{part}" for part in ("hip_yaw_pitch", *PARTS[1:])) for side in SIDES)
    left, right = legs
    return humanoid_from_mjcf(
        model_path(NAO),
        left_leg=left,
        right_leg=right,
        feet=("left_foot", "right_foot"),
        held=dict(zip(JOINT_NAMES[:NUM_UPPER], NAO.posture[:NUM_UPPER], strict=True)),
    )


@pytest.mark.parametrize(("side", "sign"), [("left", LEFT), ("right", RIGHT)])
def test_the_legs_of_a_nao_are_those_of_its_closed_form(nao, side, sign):
    chain = getattr(nao, side)
    joints = random_joints(chain, 6)
    fk = jax.jit(jax.vmap(lambda joints: chain_fk(joints, chain)))
    expected = jax.jit(jax.vmap(lambda joints: leg_fk(joints, sign)))(joints)
    np.testing.assert_allclose(fk(joints), expected, atol=2e-5)
    assert chain.weights.tolist() == [1.0] * 6
    guesses = joints + np.random.default_rng(7).uniform(-0.1, 0.1, joints.shape).astype(np.float32)
    ik = jax.jit(jax.vmap(lambda pose, guess: chain_ik(pose, guess, chain, iterations=5)))
    apart, angle = pose_errors(np.asarray(fk(ik(expected, guesses))), np.asarray(expected))
    assert np.quantile(apart, 0.95) < 1e-5 and np.quantile(angle, 0.95) < 1e-5


def test_a_nao_that_is_read_has_the_lengths_of_the_nao(nao):
    assert set(nao.joint_names) == set(JOINT_NAMES)
    assert [nao.joint_names[i] for i in nao.left_leg] == list(JOINT_NAMES[leg_indices(LEFT)])
    for name in ("leg_length", "foot_spacing", "ankle_height", "torso_height"):
        assert getattr(nao, name) == pytest.approx(getattr(NAO, name), abs=2e-3), name
    np.testing.assert_allclose(nao.hip_centre, NAO.hip_centre, atol=1e-6)
    np.testing.assert_allclose(nao.zmp_ahead_of_ankle, NAO.zmp_ahead_of_ankle, atol=0.011)
    np.testing.assert_allclose(nao.com_above_hip, NAO.com_above_hip, atol=0.01)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"guess": np.zeros(5)}, r"guess must have shape \(6,\), got \(5,\)"),
        ({"T_torso_sole": np.full((4, 4), np.nan)}, "T_torso_sole must be finite, got nan"),
    ],
)
def test_wrong_arrays_are_named(robot, arguments, message):
    good = {"T_torso_sole": np.eye(4), "guess": np.zeros(6)}
    given = {name: jnp.asarray(value, jnp.float32) for name, value in {**good, **arguments}.items()}
    with pytest.raises(ValueError, match=message):
        chain_ik(**given, chain=robot.left)
    with pytest.raises(ValueError, match=r"joint_pos must have shape \(6,\), got \(5,\)"):
        chain_fk(jnp.zeros(5), robot.left)
