"""The humanoids described in models/humanoids, if the packages that bring their models are installed."""

import importlib.util
import tomllib

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from creps_jax.files import models_folder
from creps_jax.robots.screw_kinematics import chain_fk
from creps_jax.robots.spec import humanoid_from_toml
from creps_jax.simulation.models import check_model
from creps_jax.simulation.servos import read_servos
from creps_jax.walking.controller import Walker
from creps_jax.walking.gaits import straight_gait
from creps_jax.walking.params import NAO_BOUNDS, scales
from tests.oracles.walk_c import lean_of, servo_step

SPECS = sorted((models_folder() / "humanoids").glob("*.toml"))
# Mass (kg), number of joints, and of joints of a leg.
PUBLISHED = {
    "k1": (19.67, 22, 6),
    "t1": (31.61, 23, 6),
    "op3": (3.15, 20, 6),
    "g1": (33.34, 29, 6),
    "h1": (51.44, 19, 5),
}
PERIOD = 0.02


@pytest.fixture(scope="module", params=SPECS, ids=lambda path: path.stem)
def robot(request):
    package = tomllib.loads(request.param.read_text())["model"].partition(":")[0]
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{request.param.stem} needs the package {package}")
    return humanoid_from_toml(request.param)


def test_it_is_read(robot):
    mass, num_joints, num_leg = PUBLISHED[robot.name]
    assert robot.model.body_mass.sum() == pytest.approx(mass, abs=0.01)
    assert robot.num_joints == num_joints and len(robot.left_leg) == len(robot.right_leg) == num_leg
    check_model(robot.model, robot)
    check_model(robot.film_model, robot)
    lower, upper, posture = (np.array(x) for x in (robot.joint_lower, robot.joint_upper, robot.posture))
    assert (lower <= posture).all() and (posture <= upper).all()
    assert 0.0 < robot.com_above_hip < robot.leg_length


def test_its_kinematics_are_those_of_mujoco(robot):
    rng = np.random.default_rng(0)
    index = read_servos(robot.model).qpos_index
    data = mujoco.MjData(robot.model)
    for chain, leg in ((robot.left, robot.left_leg), (robot.right, robot.right_leg)):
        foot = robot.model.jnt_bodyid[robot.model.joint(robot.joint_names[leg[-1]]).id]
        fk = jax.jit(lambda joints, chain=chain: chain_fk(joints, chain))
        soles = []
        for _ in range(10):
            joints = np.array(robot.posture)
            joints[list(leg)] = rng.uniform(chain.lower, chain.upper)
            data.qpos[:7] = 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
            data.qpos[index] = joints
            mujoco.mj_kinematics(robot.model, data)
            pose = np.asarray(fk(jnp.asarray(joints[list(leg)], jnp.float32)))
            rotation, position = data.xmat[foot].reshape(3, 3), data.xpos[foot]
            soles.append(np.append(rotation.T @ (pose[:3, 3] - position), rotation.T @ pose[:3, :3]))
        # The sole is at one place in the foot.
        np.testing.assert_allclose(np.ptp(soles, axis=0), 0.0, atol=1e-5)


def test_it_stands_for_a_second(robot):
    theta = jnp.asarray(np.mean(NAO_BOUNDS, axis=0) * scales(robot), jnp.float32)
    theta = theta.at[4].set(0.0)
    walker = Walker(lambda command: straight_gait(theta, robot=robot), robot=robot, period=PERIOD)
    step = jax.jit(walker.step)
    state = walker.start()
    before = np.asarray(state.set_point, float)
    data = mujoco.MjData(robot.model)
    left = chain_fk(state.set_point[jnp.array(robot.left_leg)], robot.left)
    data.qpos[:7] = 0.0, 0.0, -float(left[2, 3]), 1.0, 0.0, 0.0, 0.0
    data.qpos[read_servos(robot.model).qpos_index] = before
    height = data.qpos[2]
    for _ in range(round(1.0 / PERIOD)):
        state, after = step(state, jnp.zeros(3), jnp.asarray(lean_of(data.qpos[3:7]), jnp.float32))
        after = np.asarray(after, float)
        servo_step(robot.model, data, before, after, (after - before) / PERIOD)
        before = after
    assert np.abs(lean_of(data.qpos[3:7])[:2]).max() < 0.1
    assert data.qpos[2] > 0.95 * height
    assert np.abs(data.qpos[:2]).max() < 0.1 * robot.leg_length
