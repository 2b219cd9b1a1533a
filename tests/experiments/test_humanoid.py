"""A robot that a file describes, from the first command to the last: check, learn, play, drive, export."""

import contextlib
import dataclasses
import io
import shlex
import shutil

import numpy as np
import pytest

from creps_jax.errors import UserError
from creps_jax.policies.learned import load
from creps_jax.robots.screw_kinematics import chain_fk
from creps_jax.tools import play, robot_check
from creps_jax.tools.cli import main as tools
from creps_jax.tools.robot_check import Trial, summary
from creps_jax.tools.robots import find_robot, robot_id
from creps_jax.walking.params import HUMANOID_BOUNDS, humanoid_bounds
from experiments import runner
from experiments.cli import main
from experiments.walk import SETTINGS
from tests.tools.offset_humanoid import write_spec

TINY = "--iterations 3 --samples 8 --first-samples 8 --learning-duration 2.5 --duration 2.5 --eval-seeds 1"


@pytest.fixture(scope="module")
def spec(tmp_path_factory):
    return write_spec(tmp_path_factory.mktemp("robot"))


@pytest.fixture(scope="module")
def learned(spec, tmp_path_factory):
    """The folder of a run that learns for one iteration."""
    folder = tmp_path_factory.mktemp("run") / "walk"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder.parent)
        patch.setattr(play, "write_video", lambda path, model, clips, **_: path.write_bytes(b"film"))
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            assert main(["run", "walk", "--robot", str(spec), "--out", str(folder), *TINY.split()]) == 0
        (folder.parent / "printed.txt").write_text(printed.getvalue())
    return folder


def test_a_run_prints_what_it_does_after_learning(learned):
    lines = (learned.parent / "printed.txt").read_text().splitlines()
    starts = ("evaluating the policy at 11 speeds", "figure: ", "policy: ", "writing the video", "video: ")
    found = [next(i for i, line in enumerate(lines) if line.startswith(start)) for start in starts]
    assert found == sorted(found)


def test_a_robot_is_described_and_tried_before_it_learns(spec, capsys):
    assert tools(["robot", str(spec)]) == 0
    out = capsys.readouterr().out
    robot = find_robot(str(spec)).robot
    assert out.startswith(f"{robot.name}: ") and "of 18 standard gaits stay up" in out.splitlines()[-1]
    assert robot.joint_names[robot.left_leg[0]] in out


def test_the_feet_of_the_printed_angles_are_below_the_hips(spec):
    robot = find_robot(str(spec)).robot
    for side, leg, chain in (("left", robot.left_leg, robot.left), ("right", robot.right_leg, robot.right)):
        (line,) = (line for line in robot_check.described(robot) if line.startswith(f"  {side} leg"))
        assert line.startswith(f"  {side} leg with its foot below the hip and its knee bent (rad): ")
        for index in leg:
            assert f"{robot.joint_names[index]} {robot.posture[index]:.2f}" in line
        sole = chain_fk(np.array([robot.posture[index] for index in leg], np.float32), chain)
        assert float(sole[0, 3]) == pytest.approx(robot.hip_centre[0], abs=1e-3)


def test_a_robot_without_a_policy_is_told_the_command_that_learns_one(spec, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a folder" / "small.toml"
    shutil.copytree(spec.parent, path.parent)
    shutil.move(path.parent / spec.name, path)
    with pytest.raises(
        UserError, match=r"no policy has been learned yet in .*results; name a file"
    ) as caught:
        play.default_policy(str(path))
    command = str(caught.value).partition("learn one: ")[2]
    assert "--preset" not in command
    program, _, module, *arguments = shlex.split(command)
    assert (program, module, arguments) == ("python", "experiments", ["run", "walk", "--robot", str(path)])
    # Its preset is that of a robot from a file.
    asked = []
    monkeypatch.setattr(runner, "run", lambda request, **_: asked.append(request))
    assert main(arguments) == 0
    assert asked[0].preset == "humanoid"


@pytest.mark.parametrize("up", range(7))
def test_few_gaits_that_stay_up_are_an_advice(up):
    fallen, upright = Trial(0.2, 0.2, 0.1, 0.0, 1.5), Trial(0.2, 0.2, 0.1, 0.1, None)
    text = summary([fallen] * (18 - up) + [upright] * up)
    start = f"{up} of 18 standard gaits stay up"
    if up >= 6:
        assert text == start
    else:
        assert text.startswith(
            f"{start}{'' if up else ', the longest for 1.5 s'}: learning may fail; compare kp"
        )


def test_a_run_of_a_robot_from_a_file_is_one_of_the_preset_humanoid(learned, spec):
    policy = load(learned / "policy.npz")
    robot = find_robot(str(spec)).robot
    assert policy.task["robot"] == robot.name and policy.task["spec"] == robot_id(str(spec))
    assert policy.task["com"] == "continuous" and policy.task["balance"]["filter_time"] == 0.06
    np.testing.assert_allclose(policy.parameters.low, humanoid_bounds(robot)[0], rtol=1e-6)
    assert policy.contexts.low == (robot.speeds[0],) and policy.contexts.high == (robot.speeds[1],)
    assert {path.name for path in learned.iterdir()} >= {"table.md", "speed.png", "walk.mp4"}


def test_bounds_of_a_humanoid_scale_with_its_leg(spec):
    robot = find_robot(str(spec)).robot
    lengths, times = np.array(humanoid_bounds(robot))[:, [1, 7]], np.array(humanoid_bounds(robot))[:, 3]
    np.testing.assert_allclose(lengths, robot.size * np.array(HUMANOID_BOUNDS)[:, [1, 7]])
    np.testing.assert_allclose(times, robot.size**0.5 * np.array(HUMANOID_BOUNDS)[:, 3])


@pytest.mark.parametrize("named", [False, True])
def test_its_policy_is_played_driven_and_exported(learned, spec, tmp_path, monkeypatch, named):
    models = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(play, "write_video", lambda path, model, clips, **_: models.append(model.suffix))
    option = ["--robot", str(spec)] if named else []
    policy = ["--policy", str(learned / "policy.npz"), *option]
    (tmp_path / "commands.csv").write_text("time,vx,vy,turn\n0,0.1,0,0\n0.5,0,0,0\n")
    speed = find_robot(str(spec)).low
    assert tools(["play", *policy, "--speed", f"{speed:.6f}"]) == 0
    assert tools(["drive", *policy, "--script", "commands.csv"]) == 0
    for to in ("walk.c", "policy.h"):
        assert tools(["export", *policy, "--to", to]) == 0
    assert models == [".mjb", ".mjb"] and (tmp_path / "walk.h").exists()


def test_a_policy_whose_description_has_moved_asks_for_it(learned, spec, tmp_path):
    saved = load(learned / "policy.npz")
    moved = dataclasses.replace(saved, task={**saved.task, "spec": str(tmp_path / "gone.toml")})
    with pytest.raises(UserError, match=r"described by .*gone.toml, which is not there: name the file"):
        play.robot_of(moved)
    assert play.robot_of(moved, str(spec)).name == saved.task["robot"]
    with pytest.raises(UserError, match=r"the policy is of the robot .*, not of nao"):
        play.robot_of(moved, "nao")


def test_a_description_must_not_take_the_name_of_a_nao(spec, tmp_path):
    for path in spec.parent.iterdir():
        shutil.copy(path, tmp_path)
    text = "".join(f"{line}\n" for line in spec.read_text().splitlines() if not line.startswith("name"))
    (tmp_path / "nao.toml").write_text(text)
    with pytest.raises(UserError, match="must give its robot a name of its own, got 'nao'"):
        find_robot(str(tmp_path / "nao.toml"))


def test_the_settings_of_a_nao_are_those_of_the_paper_and_of_a_humanoid_others(spec):
    nao, other = SETTINGS["quick"], dataclasses.replace(SETTINGS["quick"], robot=str(spec))
    for name, expected in {"com": "one_step", "filter_time": 0.0, "upright": 0.0}.items():
        assert nao.of_robot(name) == expected
        assert other.of_robot(name) != expected
    assert dataclasses.replace(other, com="one_step").of_robot("com") == "one_step"
    assert other.resolved().robot == robot_id(str(spec)) and other.resolved().com == "continuous"


def test_standard_gaits_are_eighteen_at_three_speeds(spec):
    ranges = find_robot(str(spec))
    trials = robot_check.try_standard_gaits(ranges)
    assert len(trials) == 18
    assert {trial.asked for trial in trials} == {ranges.low, 0.5 * (ranges.low + ranges.high), ranges.high}


@pytest.mark.parametrize(
    ("low", "high"),
    [(0.3, 0.1), (0.2, 0.2), (-0.1, 0.3), (0.1, 30.0), (0.1, np.nan), (None, np.inf)],
)
def test_speeds_out_of_range_are_refused_before_anything_is_learned(spec, low, high):
    settings = {"robot": str(spec), "low": low, "high": high}
    with pytest.raises(UserError, match=r"0 <= low < high <= .* m/s, the fastest walk .*, got .* and"):
        dataclasses.replace(SETTINGS["humanoid"], **settings)
