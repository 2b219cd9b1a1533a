"""The exported C code walks as Python does: the same set-points, and a simulated robot in closed loop."""

import dataclasses
import subprocess
from importlib import resources
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from creps_jax.contexts import context_grid
from creps_jax.errors import UserError
from creps_jax.files import policies_folder
from creps_jax.policies.feature_settings import Features
from creps_jax.policies.features import polynomial_features
from creps_jax.policies.learned import load
from creps_jax.policies.network import network_policy, start_network
from creps_jax.policies.network_mean import units
from creps_jax.policies.space import Space
from creps_jax.robots.mjcf import humanoid_from_mjcf
from creps_jax.robots.nao_geometry import JOINT_NAMES
from creps_jax.robots.robot import NAO, NAO_H25, Robot
from creps_jax.tools.export import walk_c
from creps_jax.tools.export.formula import formula_of
from creps_jax.walking.gaits import learned_walker
from creps_jax.walking.posture import Balance
from experiments.benchmarks.exported_walk import (
    COMPILER,
    STRICT,
    CompiledWalk,
    PythonWalk,
    Simulation,
    changing_commands,
)
from tests.tools.offset_humanoid import make_humanoid, scaled_walk

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="there is no C compiler")
WALKS = {
    "straight": ("nao", "walk", "one_step"),
    "straight, continuous": ("nao", "walk", "continuous"),
    "steered": ("nao", "steer", "continuous"),
    "real NAO": ("nao_h25", "walk", "one_step"),
}


def policy_of(robot, name, com):
    policy = load(policies_folder(robot) / f"{name}.npz")
    return dataclasses.replace(policy, task={**policy.task, "com": com})


def with_friction(policy):
    """Return a policy of a steered walk that depends on the friction of the floor, 0.4 to 1, too."""
    contexts = policy.contexts
    features = polynomial_features(contexts.size + 1, 2)
    wider = dataclasses.replace(
        policy,
        features=features,
        contexts=Space(
            (*contexts.names, "friction"), (*contexts.low, 0.4), (*contexts.high, 1.0), (*contexts.units, "")
        ),
        policy=policy.policy._replace(coef=jnp.zeros((features.size, policy.parameters.size))),
    )
    rows, wider_rows = (list(map(tuple, formula_of(each).exponents.tolist())) for each in (policy, wider))
    before = dict(zip(rows, np.asarray(policy.policy.coef), strict=True))
    extra = np.full(policy.parameters.size, 0.05)
    coef = [before.get(row[:-1], extra) if row[-1] == 0 else extra for row in wider_rows]
    return dataclasses.replace(wider, policy=policy.policy._replace(coef=jnp.asarray(coef, jnp.float32)))


def with_features(policy, features):
    """Return a policy of other features whose mean is close to that of a policy."""
    contexts = context_grid(policy.contexts.low, policy.contexts.high, 6)
    means = policy.features(contexts) @ policy.policy.coef
    coef = np.linalg.lstsq(np.asarray(features(contexts)), np.asarray(means), rcond=1e-4)[0]
    return dataclasses.replace(policy, features=features, policy=policy.policy._replace(coef=coef))


def assert_equal_walks(policy, robot, period, seconds, folder):
    """Compare C with Python over a walk whose commands and measurements change."""
    num = round(seconds / period)
    commands = changing_commands(num)
    rpy = 0.1 * np.cumsum(np.random.default_rng(1).normal(0.0, 0.01, (num, 3)), axis=0)
    rpy[:, 2] = np.linspace(0.0, 9.0, num)  # more than one turn
    walker = learned_walker(policy, robot=robot, period=period)

    def step(state, now):
        state, set_point = walker.step(state, *now)
        return state, set_point

    given = jnp.asarray(commands), jnp.asarray(rpy, jnp.float32)
    wanted = np.asarray(jax.jit(lambda given: lax.scan(step, walker.start(), given)[1])(given))
    code = CompiledWalk(folder, policy, robot, period)
    np.testing.assert_allclose(code.set_point, walker.start().set_point, atol=1e-5)
    found = np.array([code.step(*now) for now in zip(commands, rpy, strict=True)])
    np.testing.assert_allclose(found, wanted, atol=1e-4)


@needs_compiler
@pytest.mark.parametrize("period", [0.02, 0.012])
@pytest.mark.parametrize("walk", [*WALKS, "steered with a condition"])
def test_set_points_are_those_of_python(walk, period, tmp_path):
    if period != 0.02 and walk != "steered":
        pytest.skip("one walk is enough for another period")
    policy = policy_of(*WALKS[walk.removesuffix(" with a condition")])
    if walk.endswith("with a condition"):
        policy = with_friction(policy)
    assert_equal_walks(policy, NAO_H25 if walk == "real NAO" else NAO, period, 20.0, tmp_path)


@needs_compiler
@pytest.mark.parametrize(
    "features", [Features("rbf"), Features("polynomial"), Features("kernel", num_points=8)]
)
def test_set_points_of_other_features_are_those_of_python(features, tmp_path):
    policy = policy_of(*WALKS["steered"])
    other = with_features(policy, features.make(policy.contexts.low, policy.contexts.high))
    assert_equal_walks(other, NAO, 0.02, 8.0, tmp_path)


@needs_compiler
@pytest.mark.parametrize("hidden", [8, (3, 4)])
def test_set_points_of_a_network_are_those_of_python(hidden, tmp_path):
    policy = policy_of(*WALKS["steered"])
    low, high = policy.contexts.low, policy.contexts.high
    features = network_policy(low, high).features
    state = start_network(jax.random.key(0), features, policy.parameters.size, hidden=hidden)
    contexts = context_grid(low, high, 6)
    last = units(state.layers, features(contexts))
    means = policy.features(contexts) @ policy.policy.coef
    coef = np.linalg.lstsq(np.asarray(last), np.asarray(means), rcond=1e-2)[0]
    other = dataclasses.replace(policy, policy=state._replace(coef=coef), features=features)
    assert_equal_walks(other, NAO, 0.02, 8.0, tmp_path)


@needs_compiler
@pytest.mark.parametrize("num_leg_joints", [6, 5])
@pytest.mark.parametrize("walk", ["walk", "steer"])
def test_set_points_of_a_humanoid_are_those_of_python(walk, num_leg_joints, tmp_path):
    robot = make_humanoid(tmp_path, num_leg_joints)
    com = "one_step" if walk == "walk" else "continuous"
    policy = scaled_walk(robot, com, walk)
    balance = Balance(heading_gain=0.3, placement_gain=0.6, filter_time=0.06, forward_placement_gain=0.25)
    task = {**policy.task, "balance": balance._asdict()}
    assert_equal_walks(dataclasses.replace(policy, task=task), robot, 0.02, 8.0, tmp_path)


@needs_compiler
@pytest.mark.skipif(find_spec("rcsssmj") is None, reason="the package rcsssmj is not installed")
def test_set_points_of_the_k1_are_those_of_python(tmp_path):
    leg = ("Hip_Pitch", "Hip_Roll", "Hip_Yaw", "Knee_Pitch", "Ankle_Pitch", "Ankle_Roll")
    robot = humanoid_from_mjcf(
        Path(str(resources.files("rcsssmj"))) / "resources" / "robots" / "K1" / "robot.xml",
        name="k1",
        left_leg=[f"Left_{joint}" for joint in leg],
        right_leg=[f"Right_{joint}" for joint in leg],
        feet=["left_foot_link", "right_foot_link"],
        held={"Left_Shoulder_Roll": -1.35, "Right_Shoulder_Roll": 1.35},
    )
    assert_equal_walks(scaled_walk(robot), robot, 0.02, 8.0, tmp_path)


@needs_compiler
def test_names_of_any_characters_can_be_compiled(tmp_path):
    robot = make_humanoid(tmp_path)
    names = tuple(f'{name} "\\' for name in robot.joint_names)
    robot = dataclasses.replace(robot, name="2nd */ robot", own_names=names)
    code = CompiledWalk(tmp_path, scaled_walk(robot), robot)
    assert np.isfinite(code.step((0.1, 0.0, 0.0), (0.0, 0.0, 0.0))).all()
    assert "robot_2nd_robot_walk_step" in (tmp_path / "walk.h").read_text()


def test_the_robot_must_be_that_of_the_policy(tmp_path):
    robot = make_humanoid(tmp_path)
    policy = scaled_walk(robot)
    with pytest.raises(UserError, match=r"robot must be the Robot 'offset-humanoid'.*got no robot"):
        walk_c.make_walk(policy)
    with pytest.raises(UserError, match=r"robot must be 'offset-humanoid'.*got 'nao'"):
        walk_c.make_walk(policy, robot=NAO)
    fields = {field.name: getattr(robot, field.name) for field in dataclasses.fields(Robot)}
    with pytest.raises(UserError, match="robot must be a NaoRobot or a Humanoid"):
        walk_c.make_walk(policy, robot=Robot(**fields))


@needs_compiler
def test_a_pause_of_the_measurements_is_bridged(tmp_path):
    """The robot goes on with the tilt that was measured last, and with the planned heading."""
    policy = policy_of(*WALKS["steered"])
    paused, measured = (CompiledWalk(tmp_path, policy, NAO) for _ in range(2))
    command, still, missing = (0.2, 0.0, 0.4), (0.02, 0.05, 0.0), (float("nan"),) * 3
    for tick in range(200):
        # Sway up to the pause.
        sway = 0.08 * np.sin(14.0 * 0.02 * tick)
        rpy = (sway, 0.05, 0.0) if tick < 150 else still
        wanted = measured.step(command, rpy)
        found = paused.step(command, missing if tick >= 150 else rpy)
        assert np.isfinite(found).all()
        assert np.abs(found - wanted).max() < 0.3


@needs_compiler
def test_a_simulated_robot_walks_by_the_c_code_in_closed_loop(tmp_path):
    policy = policy_of(*WALKS["steered"])
    commands = changing_commands(1000, seed=3)
    walks = CompiledWalk(tmp_path, policy, NAO), PythonWalk(policy, NAO)
    first = walks[1].set_point
    in_c, in_python = (Simulation(NAO, first) for _ in walks)
    by_c, by_python = in_c.walk(walks[0].step, commands), in_python.walk(walks[1].step, commands)

    # Contacts enlarge rounding errors: until then the set-points are equal, and after it the walks are alike.
    parted = np.abs(by_c - by_python).max(axis=1) > 1e-4
    assert not parted[:300].any()
    assert min(in_c.lowest(), in_python.lowest()) > 0.25
    np.testing.assert_allclose(in_c.speeds(), in_python.speeds(), atol=0.02)


@needs_compiler
def test_the_headers_of_two_robots_can_be_included_together(tmp_path):
    for robot in ("nao", "nao_h25"):
        folder = tmp_path / robot
        folder.mkdir()
        walk_c.save(folder / "walk.c", policy_of(robot, "walk", "one_step"))
        (folder / "walk.h").rename(tmp_path / f"{robot}.h")
    (tmp_path / "both.c").write_text(
        '#include "nao.h"\n#include "nao_h25.h"\n'
        "int main(void) { return sizeof(nao_walk_state) == sizeof(nao_h25_walk_state) ? 0 : 1; }\n"
    )
    done = subprocess.run([COMPILER, *STRICT, "-c", "both.c"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_real_nao_has_the_names_and_signs_of_its_own_software(tmp_path):
    code, header = walk_c.make_walk(policy_of("nao_h25", "walk", "one_step"))
    assert '"LKneePitch"' in code and '"left_knee"' not in code and "nao_h25_walk_step" in header
    knee = NAO_H25.own_names.index("LKneePitch")
    # It bends with positive angles.
    assert NAO_H25.own_signs[knee] * NAO_H25.joint_lower[knee] > 1.0
    assert NAO.own_names == JOINT_NAMES and set(NAO.own_signs) == {1.0}
