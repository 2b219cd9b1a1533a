"""Policies and walks, taken away: ONNX model and C function do what the policy does, a walk can be played."""

import csv
import ctypes
import dataclasses
import json
import math
import re
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest

from creps_jax.errors import UserError
from creps_jax.files import load_arrays, policies_folder
from creps_jax.policies.feature_settings import Features
from creps_jax.policies.features import describe, linear_features, quadratic_features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.policies.learned import Learned, load, save
from creps_jax.policies.network import network_policy, start_network
from creps_jax.policies.space import Space
from creps_jax.robots.nao_geometry import JOINT_LOWER, JOINT_NAMES, JOINT_UPPER, MAX_JOINT_SPEED
from creps_jax.robots.robot import NAO_H25
from creps_jax.tools.cli import main
from creps_jax.tools.export.c_header import make_header
from creps_jax.tools.export.onnx_model import make_model
from creps_jax.tools.robots import find_robot
from creps_jax.walking.gaits import learned_walker
from creps_jax.walking.open_loop import open_loop_walk
from tests.tools.offset_humanoid import scaled_walk, write_spec

NAMES = ("a b", "a-b", 'what?? "\\')
SHIPPED = policies_folder() / "walk.npz"
STEERED = policies_folder() / "steer.npz"
H25 = ("--robot", "nao_h25")
NAN, INFINITE = float("nan"), float("inf")


def make_policy(
    name: str, features: Features, constraint: str, *, num_contexts: int = 2, middle: float = 0.35
) -> Learned:
    rng = np.random.default_rng(len(name))
    low, high = (middle - 0.25, -5.0)[:num_contexts], (middle + 0.25, 5.0)[:num_contexts]
    # Means of either sign that reach beyond the box.
    scale = np.ones((features.make(low, high).size, 1))
    if features.kind == "linear":
        scale[1:, 0] = 1.0 / np.array(high)
    if features.kind == "polynomial":
        scale = 1.0 / np.abs(np.asarray(features.make(low, high)(jnp.array(high))))[:, None]
    coef = (2.0 * scale * rng.normal(size=(len(scale), 3))).astype(np.float32)
    return Learned(
        LinearGaussian(coef, np.eye(3, dtype=np.float32)),
        features.make(low, high),
        Space(("speed", "slope")[:num_contexts], low, high, ("m/s", "°")[:num_contexts]),
        Space(NAMES, (0.0, -1.0, 1.0), (2.0, 1.0, 1.5), ("m", "", "rad*/s"), constraint),
        {"name": name},
    )


def make_network(
    name: str, hidden: int | tuple[int, ...], constraint: str, *, num_contexts: int = 2
) -> Learned:
    other = make_policy(name, Features("linear"), constraint, num_contexts=num_contexts)
    features = network_policy(other.contexts.low, other.contexts.high).features
    state = start_network(jax.random.key(0), features, 3, hidden=hidden)
    coef = jax.random.normal(jax.random.key(1), state.coef.shape)
    return dataclasses.replace(other, policy=state._replace(coef=coef), features=features)


POLICIES = {
    policy.task["name"]: policy
    for policy in (
        make_policy("squashed", Features("rbf", 4), "sigmoid"),
        make_policy("narrow", Features("rbf", 6, bandwidth=0.02), "clip", num_contexts=1),
        make_policy("lonely", Features("rbf", 1), "sigmoid", num_contexts=1),
        make_policy("straight", Features("linear"), "sigmoid"),
        make_policy("clipped", Features("linear"), "clip"),
        make_policy("curved", Features("polynomial", degree=3), "sigmoid"),
        make_policy("bent", Features("polynomial", degree=2, scaled=False), "sigmoid"),
        make_policy("smooth", Features("kernel", num_points=8), "sigmoid"),
        make_policy("point", Features("kernel", num_points=1), "clip"),
        make_policy("near", Features("kernel", num_points=12, bandwidth=0.05), "clip", num_contexts=1),
        make_policy("far", Features("kernel", num_points=6), "clip", num_contexts=1, middle=1000.75),
        make_network("net", 32, "sigmoid"),
        make_network("deep", (5, 1, 7), "clip"),
        make_network("unit", 1, "none", num_contexts=1),
        make_policy("free", Features("linear"), "none"),
        load(SHIPPED),
    )
}


def contexts_of(policy: Learned) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return contexts, the nearest ones that were learned for, and whether these are the same."""
    low, high = np.float32(policy.contexts.low), np.float32(policy.contexts.high)
    rng = np.random.default_rng(0)
    inside = low + (high - low) * rng.uniform(size=(12, len(low))).astype(np.float32)
    inside = np.concatenate([np.clip(inside, low, high), [low, high]])
    outside = np.tile(inside[0], (6, 1))
    outside[:, -1] = [np.nextafter(low[-1], -INFINITE), 2 * high[-1], -INFINITE, INFINITE, NAN, -NAN]
    contexts = np.concatenate([inside, outside]).astype(np.float32)
    nearest = np.clip(np.where(np.isnan(contexts), low, contexts), low, high)
    return contexts, nearest, np.arange(len(contexts)) < len(inside)


def assert_same(policy: Learned, run) -> None:
    """Hold `run`, from contexts to parameters and in_range, against the policy's theta."""
    contexts, nearest, expected = contexts_of(policy)
    parameters, in_range = run(contexts)
    theta = np.array([policy.theta(*row.tolist()) for row in nearest])
    low, high = np.float32(policy.parameters.low), np.float32(policy.parameters.high)
    # Kernel features multiply the rounding of covariances by the inverse root of their matrix.
    tolerance = 3e-5 if describe(policy.features)["kind"] == "kernel" else 1e-6
    np.testing.assert_array_less(np.abs(parameters - theta) / (high - low), tolerance)
    np.testing.assert_array_equal(in_range, expected)
    if policy.parameters.constraint != "none":
        assert ((parameters >= low) & (parameters <= high)).all()


@pytest.mark.parametrize("name", POLICIES)
def test_the_onnx_model_computes_theta(name):
    policy = POLICIES[name]
    model = make_model(policy)
    onnx.checker.check_model(model, full_check=True)
    assert (model.ir_version, model.opset_import[0].version) == (7, 13)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    assert_same(policy, lambda contexts: session.run(["parameters", "in_range"], {"context": contexts}))
    known = session.get_modelmeta().custom_metadata_map
    for ours, space in (("parameter", policy.parameters), ("context", policy.contexts)):
        for what in ("names", "units", "low", "high"):
            assert json.loads(known[f"{ours}_{what}"]) == list(getattr(space, what))
    assert json.loads(known["task"]) == policy.task
    assert f"task {name}" in model.doc_string and f"speed {policy.contexts.low[0]:g} to" in model.doc_string


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    """Compile all headers together, with a function and a string for each that ctypes can reach."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler: there is no cc on the PATH")
    folder = tmp_path_factory.mktemp("c")
    source = ""
    for name, policy in POLICIES.items():
        (folder / f"{name}.h").write_text(make_header(policy))
        source += f"""
            #include "{name}.h"
            #include "{name}.h"
            int run_{name}(const float *c, float *p) {{ return {name}_policy(c, p); }}
            const char *last_name_of_{name}(void) {{
                return {name}_parameter_names[{name.upper()}_NUM_PARAMETERS - 1];
            }}
        """
    (folder / "all.c").write_text("\n".join(map(str.strip, source.splitlines())))
    library = folder / "all.so"
    command = [compiler, "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run([*command, folder / "all.c", "-o", library, "-lm"], check=True, timeout=120)
    return ctypes.CDLL(str(library))


def as_floats(array: np.ndarray):
    return array.ctypes.data_as(ctypes.POINTER(ctypes.c_float))


@pytest.mark.parametrize("name", POLICIES)
def test_the_c_function_computes_theta(compiled, name):
    policy = POLICIES[name]

    def run(contexts):
        parameters = np.full((len(contexts), len(policy.parameters.names)), NAN, np.float32)
        in_range = [
            getattr(compiled, f"run_{name}")(as_floats(context), as_floats(row))
            for context, row in zip(contexts, parameters, strict=True)
        ]
        return parameters, in_range

    assert_same(policy, run)
    last_name = getattr(compiled, f"last_name_of_{name}")
    last_name.restype = ctypes.c_char_p
    assert last_name().decode() == policy.parameters.names[-1]


def test_the_header_is_c_plus_plus_too(tmp_path):
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler: there is no c++ on the PATH")
    (tmp_path / "walk.h").write_text(make_header(POLICIES["walk"]))
    (tmp_path / "main.cc").write_text(
        '#include "walk.h"\n'
        "int main() { float c[] = {0.3f}, p[WALK_NUM_PARAMETERS]; return walk_policy(c, p); }\n"
    )
    command = [compiler, "-Wall", "-Wextra", "-Werror", "-fsyntax-only", tmp_path / "main.cc"]
    subprocess.run(command, check=True, timeout=120)


def test_the_header_says_what_the_policy_is():
    policy = POLICIES["walk"]
    header = make_header(policy)
    assert header.count("#ifndef WALK_POLICY_H\n#define WALK_POLICY_H\n") == 1
    assert "#define WALK_NUM_CONTEXTS 1\n#define WALK_NUM_PARAMETERS 10\n" in header
    assert "Returns 1 if the context is within" in header and "Returns 0 if" in header
    tables = dict(re.findall(r"(\w+)(?:\[\w+\])+ = \{\n(.*?)\n\};", header, flags=re.DOTALL))
    floats = {
        name: [np.float32(number) for number in re.findall(r"(-?\d[^\s,{}]*)f\b", body)]
        for name, body in tables.items()
    }
    # Every number reads back as the same float.
    assert floats["walk_coef"] == policy.policy.coef.ravel().tolist()
    assert floats["walk_context_low"] + floats["walk_context_high"] == [np.float32(0.1), np.float32(0.6)]
    assert floats["walk_parameter_low"] == np.float32(policy.parameters.low).tolist()
    assert floats["walk_parameter_high"] == np.float32(policy.parameters.high).tolist()
    assert re.findall('"(.*)"', tables["walk_parameter_names"]) == list(policy.parameters.names)
    assert re.findall('"(.*)"', tables["walk_parameter_units"]) == list(policy.parameters.units)
    enum = re.search(r"enum walk_parameter \{(.*?)\}", header, flags=re.DOTALL)
    assert enum and enum[1].split(",")[3].strip() == "WALK_PARAMETER_STEP_DURATION"
    assert header.isascii() and max(map(len, header.splitlines())) <= 110


@pytest.mark.parametrize(
    ("task", "function"),
    [
        ({"name": "3-D arm"}, "task_3_d_arm_policy"),
        ({"name": "reach/hole"}, "reach_hole_policy"),
        ({"name": "θ"}, "learned_policy"),
        ({}, "learned_policy"),
    ],
)
def test_names_in_c_are_identifiers(task, function):
    header = make_header(dataclasses.replace(POLICIES["free"], task=task))
    assert f"static inline int {function}(" in header
    # Two parameters whose names become the same are told apart by their index.
    assert "PARAMETER_A_B_0,\n" in header and "PARAMETER_A_B_1,\n" in header


@pytest.mark.parametrize("make", [make_model, make_header])
def test_numbers_beyond_single_precision_are_refused(make):
    with pytest.raises(UserError, match="param_high of the policy is too large for single precision"):
        bounded = dataclasses.replace(POLICIES["clipped"].parameters, high=(2.0, 1e300, 1.5))
        make(dataclasses.replace(POLICIES["clipped"], parameters=bounded))


@pytest.mark.parametrize("make", [make_model, make_header])
def test_features_that_cannot_be_exported_are_named(make):
    contexts = Space(("speed",), (0.1,), (0.6,))
    features = quadratic_features(1)
    policy = LinearGaussian(np.zeros((2, 3)), np.eye(3))
    with pytest.raises(
        UserError, match="features must be linear, polynomial, rbf or kernel to be exported, got quadratic"
    ):
        make(Learned(policy, features, contexts, POLICIES["free"].parameters))


def test_parameters_without_bounds_are_exported():
    free = Space(NAMES, (-math.inf,) * 3, (math.inf,) * 3)
    policy = dataclasses.replace(POLICIES["free"], parameters=free)
    assert "-INFINITY, -INFINITY" in make_header(policy)
    onnx.checker.check_model(make_model(policy), full_check=True)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Work in an empty folder, without results, so that the default is the shipped policy."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_command_writes_policies(folder, capsys):
    (folder / "walk.h").write_text("old")
    assert main(["export", "--to", "walk.h"]) == 0
    assert (folder / "walk.h").read_text() == make_header(POLICIES["walk"])
    assert capsys.readouterr().out == f"policy: {SHIPPED}\nC header: walk.h\n"
    save(folder / "reach.npz", POLICIES["squashed"])
    assert main(["export", "--policy", "reach.npz", "--to", "new/reach.ONNX"]) == 0
    assert onnx.load(folder / "new" / "reach.ONNX") == make_model(POLICIES["squashed"])
    assert {path.name for path in folder.rglob("*")} == {"walk.h", "reach.npz", "new", "reach.ONNX"}


def test_the_command_writes_the_set_points_of_a_walk(folder):
    for ending in ("csv", "npz"):
        assert main(["export", "--to", f"walk.{ending}", "--speed", "0.3", "--duration", "1"]) == 0
    arrays = load_arrays(folder / "walk.npz")
    time, set_point = arrays["time"], arrays["set_point"]
    np.testing.assert_allclose(time, np.arange(51) * 0.02)
    assert float(arrays["speed"]) == 0.3 and tuple(arrays["joint_names"]) == JOINT_NAMES
    assert set_point.shape == (51, 22)
    assert ((set_point >= np.float32(JOINT_LOWER)) & (set_point <= np.float32(JOINT_UPPER))).all()
    assert 0.01 < np.abs(np.diff(set_point, axis=0)).max() <= 1.0001 * MAX_JOINT_SPEED * 0.02
    with (folder / "walk.csv").open() as file:
        header, *rows = csv.reader(file)
    assert header == ["time (s)", *(f"{name} (rad)" for name in JOINT_NAMES)]
    np.testing.assert_allclose([float(row[0]) for row in rows], time, atol=1e-9)
    np.testing.assert_array_equal(np.array(rows)[:, 1:].astype(np.float32), set_point)


def test_a_steered_walk_is_written_as_its_walker_walks_straight_ahead(folder):
    arguments = ["--to", "walk.npz", "--speed", "0.3", "--duration", "2", "--policy", str(STEERED)]
    assert main(["export", *arguments]) == 0
    walker = learned_walker(load(STEERED))
    commands = jnp.tile(jnp.array([0.3, 0.0, 0.0]), (100, 1))
    states = jax.jit(lambda commands: open_loop_walk(walker, commands))(commands)
    np.testing.assert_allclose(load_arrays(folder / "walk.npz")["set_point"], states.set_point, atol=1e-5)
    # As it was learned, the command rises by its acceleration.
    assert 0.0 < states.command[20, 0] < 0.3 and states.origin[-1, 0] > 0.2


@pytest.mark.parametrize("policy", [STEERED, policies_folder() / "walk.npz"])
def test_the_fastest_walk_can_be_written(policy, folder):
    arguments = ["--to", "walk.npz", "--duration", "0.1", "--policy", str(policy)]
    assert main(["export", *arguments, "--speed", "0.6"]) == 0
    assert main(["export", *arguments, "--speed", "0.7"]) == 2


def test_a_steered_walk_with_a_condition_is_written(folder):
    learned = load(STEERED)
    contexts = learned.contexts
    wider = Space(
        (*contexts.names, "friction"), (*contexts.low, 0.4), (*contexts.high, 1.0), (*contexts.units, "")
    )
    coef = jnp.zeros((5, learned.parameters.size))
    learned = dataclasses.replace(
        learned, contexts=wider, features=linear_features(4), policy=learned.policy._replace(coef=coef)
    )
    save(folder / "wider.npz", learned)
    assert (
        main(["export", "--policy", "wider.npz", "--to", "walk.csv", "--speed", "0.2", "--duration", "1"])
        == 0
    )
    assert main(["export", "--policy", "wider.npz", "--to", "walk.c"]) == 0


def test_a_walk_of_a_network_is_written(folder):
    learned = load(SHIPPED)
    features = network_policy(learned.contexts.low, learned.contexts.high).features
    middle = learned.mean(0.3)
    state = start_network(jax.random.key(0), features, len(middle), hidden=3, mean=middle)
    save(folder / "net.npz", dataclasses.replace(learned, policy=state, features=features))
    for arguments in (["--to", "walk.csv", "--speed", "0.3", "--duration", "1"], ["--to", "walk.c"]):
        assert main(["export", "--policy", "net.npz", *arguments]) == 0
    assert "tanhf" in (folder / "walk.c").read_text()


def test_a_robot_gets_its_own_policy_and_set_points(folder, capsys):
    assert main(["export", "--robot", "nao_h25", "--to", "h25.npz", "--speed", "0.2", "--duration", "1"]) == 0
    shipped = policies_folder("nao_h25") / "walk.npz"
    assert capsys.readouterr().out.splitlines()[0] == f"policy: {shipped}"
    set_point = load_arrays(folder / "h25.npz")["set_point"]
    low, high = np.float32(NAO_H25.joint_lower), np.float32(NAO_H25.joint_upper)
    assert ((set_point >= low) & (set_point <= high)).all()
    # Its elbows do not stretch, and one motor turns both hips.
    assert low[JOINT_NAMES.index("right_elbow")] > 0
    left, right = (set_point[:, JOINT_NAMES.index(f"{side}_hip_yaw_pitch")] for side in ("left", "right"))
    np.testing.assert_allclose(left, right, atol=1e-6)
    assert main(["export", "--robot", "nao_h25", "--to", "h25.h"]) == 0
    assert (folder / "h25.h").read_text() == make_header(load(shipped), "h25")


def test_the_walk_of_a_humanoid_is_written(folder, capsys):
    spec = write_spec(folder)
    robot = find_robot(str(spec)).robot
    save(folder / "humanoid.npz", scaled_walk(robot))
    asked = ["export", "--robot", spec.name, "--policy", "humanoid.npz"]
    assert main([*asked, "--to", "walk.csv", "--speed", "0.3", "--duration", "1"]) == 0
    assert main([*asked, "--to", "walk.c"]) == 0
    assert "offset_humanoid_walk_step" in (folder / "walk.h").read_text()
    with open(folder / "walk.csv", newline="") as file:
        header, *rows = csv.reader(file)
    assert header[1:] == [f"{name} (rad)" for name in robot.own_names]
    set_point = np.array(rows, np.float32)[:, 1:]
    assert set_point.shape == (51, robot.num_joints)
    assert ((set_point >= np.float32(robot.joint_lower)) & (set_point <= np.float32(robot.joint_upper))).all()
    # The left knee bends with positive angles, the right one with negative angles.
    knees = set_point[:, [robot.joint_names.index(f"{side}_knee") for side in ("left", "right")]]
    assert knees[:, 0].min() > 0.5 and knees[:, 1].max() < -0.5
    # Without its file the robot is not known.
    capsys.readouterr()
    assert main(["export", "--policy", "humanoid.npz", "--to", "walk.c"]) == 2
    assert "name the file that describes it with --robot" in capsys.readouterr().err


def test_mistakes_are_one_clear_line(folder, capsys):
    other = dataclasses.replace(POLICIES["walk"], task={**POLICIES["walk"].task, "name": "swim"})
    for name, policy in (("reach", POLICIES["squashed"]), ("walk", POLICIES["walk"]), ("swim", other)):
        save(folder / f"{name}.npz", policy)
    (folder / "file").touch()
    (folder / "folder.h").mkdir()
    (folder / "walk.h").touch()
    (folder / "drive.c").write_text('#include "drive.h"')
    walk = ["--to", "walk.csv", "--speed", "0.3"]
    steered = ["--policy", str(STEERED)]
    for match, arguments in (
        ("cannot write file/walk.h", ["--to", "file/walk.h"]),
        ("cannot write folder.h: Is a directory", ["--to", "folder.h"]),
        ("no such file: none.npz", ["--to", "walk.h", "--policy", "none.npz"]),
        ("is no walking policy: its parameters are a b, a-b", [*walk, "--policy", "reach.npz"]),
        ("is no walking policy: its task is 'swim'", [*walk, "--policy", "swim.npz"]),
        (f"{SHIPPED}: the policy is of the robot nao, not of", [*walk, "--policy", str(SHIPPED), *H25]),
        ("the policy is of the robot nao, not of nao_h25", ["--to", "w.h", "--policy", str(SHIPPED), *H25]),
        ("its range, 0.1 to 0.6 m/s, got 0.9", ["--to", "walk.csv", "--speed", "0.9"]),
        ("--duration must be 0.02 to 600 s, got 0.0", [*walk, "--duration", "0"]),
        ("--duration must be 0.02 to 600 s, got 0.01", [*walk, "--duration", "0.01"]),
        ("--duration must be 0.02 to 600 s, got nan", [*walk, "--duration", "nan"]),
        *(
            (f"--period must be 0.001 to 0.1 s, got {period}", [*where, "--period", period])
            for period in ("0.0", "1.0", "nan")
            for where in (walk, ["--to", "walk.c"])
        ),
        (
            "vx must be within its range, -0.2 to 0.6 m/s, got 0.7",
            ["--to", "walk.csv", "--speed", "0.7", *steered],
        ),
        ("would overwrite walk.h with the header", ["--to", "walk.c", *steered]),
        ("is the name of the header of drive.c", ["--to", "drive.h", *steered]),
        ("is the policy file itself", ["--to", "walk.npz", "--speed", "0.3", "--policy", "./walk.npz"]),
    ):
        assert main(["export", *arguments]) == 2, match
        error = capsys.readouterr().err
        assert match in error
        assert len(error.splitlines()) == 1
    assert not (folder / "walk.csv").exists()
    load(folder / "walk.npz")
