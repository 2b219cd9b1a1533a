"""The exported C code walks as Python does: the same set-points, and a simulated robot in closed loop."""

import ctypes
import dataclasses
import shutil
import subprocess

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax import lax

from creps_jax.files import policies_folder
from creps_jax.policies.features import polynomial_features
from creps_jax.policies.learned import load
from creps_jax.policies.space import Space
from creps_jax.robots.nao_geometry import JOINT_NAMES
from creps_jax.robots.robot import NAO, NAO_H25
from creps_jax.tools.export import walk_c
from creps_jax.walking.gaits import learned_walker

COMPILER = shutil.which("cc")
STRICT = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror"]
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
    before = dict(zip(walk_c.exponents(policy), np.asarray(policy.policy.coef), strict=True))
    extra = np.full(policy.parameters.size, 0.05)
    coef = [before.get(row[:-1], extra) if row[-1] == 0 else extra for row in walk_c.exponents(wider)]
    return dataclasses.replace(wider, policy=policy.policy._replace(coef=jnp.asarray(coef, jnp.float32)))


class CWalk:
    """The compiled code of a walk."""

    def __init__(self, folder, policy, period=0.02):
        walk_c.save(folder / "walk.c", policy, period=period)
        self.robot = learned_walker(policy).robot
        library = folder / "walk.so"
        command = [COMPILER, *STRICT, "-O2", "-shared", "-fPIC", folder / "walk.c", "-o", library, "-lm"]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        functions = ctypes.CDLL(str(library))
        self._step = getattr(functions, f"{self.robot.name}_walk_step")
        self._step.argtypes = [ctypes.c_void_p, ctypes.c_void_p, *[ctypes.c_float] * 3, ctypes.c_void_p]
        self._state = ctypes.create_string_buffer(8192)
        self.out = np.zeros(len(JOINT_NAMES), np.float32)
        getattr(functions, f"{self.robot.name}_walk_start")(
            self._state, ctypes.c_void_p(self.out.ctypes.data)
        )

    def step(self, command, rpy):
        command = np.asarray(command, np.float32)
        self._step(self._state, command.ctypes.data, *map(float, rpy), self.out.ctypes.data)
        return self.set_point()

    def set_point(self):
        return self.out * np.array(self.robot.own_signs, np.float32)


def changing_commands(num, seed=0):
    rng = np.random.default_rng(seed)
    commands = np.repeat(rng.uniform([-0.2, -0.1, -0.5], [0.4, 0.1, 0.5], (-(-num // 75), 3)), 75, axis=0)[
        :num
    ]
    commands[num // 3 : num // 2] = 0.0
    return commands.astype(np.float32)


@needs_compiler
@pytest.mark.parametrize("period", [0.02, 0.012])
@pytest.mark.parametrize("walk", [*WALKS, "steered with a condition"])
def test_set_points_are_those_of_python(walk, period, tmp_path):
    if period != 0.02 and walk != "steered":
        pytest.skip("one walk is enough for another period")
    policy = policy_of(*WALKS[walk.removesuffix(" with a condition")])
    if walk.endswith("with a condition"):
        policy = with_friction(policy)
    num = round(20.0 / period)
    commands = changing_commands(num)
    rpy = 0.1 * np.cumsum(np.random.default_rng(1).normal(0.0, 0.01, (num, 3)), axis=0)
    rpy[:, 2] = np.linspace(0.0, 9.0, num)  # more than one turn
    walker = learned_walker(policy, period=period)

    def step(state, now):
        state, set_point = walker.step(state, *now)
        return state, set_point

    given = jnp.asarray(commands), jnp.asarray(rpy, jnp.float32)
    wanted = np.asarray(jax.jit(lambda given: lax.scan(step, walker.start(), given)[1])(given))
    code = CWalk(tmp_path, policy, period)
    np.testing.assert_allclose(code.set_point(), walker.start().set_point, atol=1e-5)
    found = np.array([code.step(*now) for now in zip(commands, rpy, strict=True)])
    np.testing.assert_allclose(found, wanted, atol=1e-4)


@needs_compiler
def test_a_missing_measurement_is_bridged(tmp_path):
    policy = policy_of(*WALKS["steered"])
    code = CWalk(tmp_path, policy)
    missing = float("nan")
    for tick in range(200):
        rpy = (missing, missing, missing) if tick % 7 == 3 else (0.02, 0.05, 0.0)
        assert np.isfinite(code.step((0.3, 0.0, 0.0), rpy)).all()


@needs_compiler
def test_a_simulated_robot_walks_by_the_c_code_in_closed_loop(tmp_path):
    policy = policy_of(*WALKS["steered"])
    commands = changing_commands(1000, seed=3)
    code = CWalk(tmp_path, policy)
    in_c = Simulation(code.robot, np.asarray(learned_walker(policy).start().set_point))
    by_c = in_c.walk(code.step, commands)

    walker = learned_walker(policy)
    step, state = jax.jit(walker.step), walker.start()

    def step_in_python(command, rpy):
        nonlocal state
        state, set_point = step(state, jnp.asarray(command), jnp.asarray(rpy, jnp.float32))
        return np.asarray(set_point)

    in_python = Simulation(walker.robot, np.asarray(walker.start().set_point))
    by_python = in_python.walk(step_in_python, commands)

    # Contacts enlarge rounding errors: until then the set-points are equal, and after it the walks are alike.
    parted = np.abs(by_c - by_python).max(axis=1) > 1e-4
    assert not parted[:300].any()
    assert min(in_c.height(), in_python.height()) > 0.25
    np.testing.assert_allclose(in_c.speeds(), in_python.speeds(), atol=0.02)


class Simulation:
    """A robot in plain MuJoCo, with the servos of its model."""

    def __init__(self, robot, set_point):
        from creps_jax.simulation.models import load_nao

        self.model = load_nao(robot)
        self.data = mujoco.MjData(self.model)
        self.data.qpos[2] = robot.geometry.torso_height
        self.data.qpos[7:] = set_point
        mujoco.mj_forward(self.model, self.data)
        # Down until the lowest point of the feet is on the floor.
        lowest = min(
            self.data.geom_xpos[geom, 2] - self.model.geom_size[geom, 0]
            for geom in range(self.model.ngeom)
            if self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_SPHERE
        )
        self.data.qpos[2] -= lowest
        self.last = set_point
        self.positions = []

    def rpy(self):
        w, x, y, z = self.data.qpos[3:7]
        roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
        return roll, pitch, np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    def step(self, set_point):
        substeps = round(0.02 / self.model.opt.timestep)
        for index in range(substeps):
            self.data.ctrl[:] = self.last + (index + 1) / substeps * (set_point - self.last)
            mujoco.mj_step(self.model, self.data)
        self.last = set_point
        self.positions.append(self.data.qpos[:3].copy())

    def walk(self, controller, commands):
        """Walk by a controller: (command, rpy) -> set-points. Return all set-points."""
        set_points = []
        for command in commands:
            set_points.append(controller(command, self.rpy()))
            self.step(set_points[-1])
        return np.array(set_points)

    def height(self):
        return min(position[2] for position in self.positions)

    def speeds(self):
        """Return the distance that the torso moves in each two seconds over the time, m/s."""
        positions = np.array(self.positions)[::100, :2]
        return np.linalg.norm(np.diff(positions, axis=0), axis=1) / 2.0


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
