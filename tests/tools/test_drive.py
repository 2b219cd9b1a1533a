"""Drive by a file of commands, and by keys."""

import numpy as np
import pytest

from creps_jax.errors import UserError
from creps_jax.files import policies_folder
from creps_jax.policies.learned import load
from creps_jax.tasks.closed_loop import CONTROL_PERIOD
from creps_jax.tools import cli
from creps_jax.tools.drive import (
    beyond_range,
    captions,
    default_policy,
    drive_by_commands,
    read_script,
    report,
)
from creps_jax.tools.drive_live import Command, LiveRobot
from creps_jax.walking.gaits import command_range, learned_walker

SCRIPT = "time,vx,vy,turn\n0,0.2,0,0\n1.5,0,0,0.4\n2,0,0,0\n"


@pytest.fixture(scope="module")
def walker():
    return learned_walker(load(policies_folder() / "steer.npz"))


def test_a_script_is_the_command_of_each_control_step(tmp_path):
    (tmp_path / "commands.csv").write_text("\ufeff" + SCRIPT, encoding="utf-8")
    commands = read_script(tmp_path / "commands.csv")
    assert commands.shape == (round(2.0 / CONTROL_PERIOD), 3)
    np.testing.assert_allclose(
        commands[[0, 74, 75, 99]], [[0.2, 0, 0], [0.2, 0, 0], [0, 0, 0.4], [0, 0, 0.4]]
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, "cannot read the commands"),
        ("", "must begin with the line time,vx,vy,turn, got nothing"),
        ("t,x\n0,1\n", "must begin with the line"),
        ("time,vx,vy,turn\n0,0.2,0,0\n", "two lines or more"),
        ("time,vx,vy,turn\n0,0.2,0,0\n0,0,0,0\n", "times rise from 0"),
        ("time,vx,vy,turn\n1,0.2,0,0\n2,0,0,0\n", "times rise from 0"),
        ("time,vx,vy,turn\n0,fast,0,0\n2,0,0,0\n", "line 2 of .* must be four numbers"),
        ("time,vx,vy,turn\n0,nan,0,0\n2,0,0,0\n", "line 2 of .* must be four numbers"),
        ("time,vx,vy,turn\n0,1,0\n2,0,0,0\n", "line 2 of .* must be four numbers"),
        ("time,vx,vy,turn\n0,0,0,0\n5000,0,0,0\n", "must end within 600 s"),
    ],
)
def test_a_bad_script_is_named(text, expected, tmp_path):
    path = tmp_path / "commands.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UserError, match=expected):
        read_script(path)


def test_commands_beyond_the_learned_range_are_noted():
    policy = load(policies_folder() / "steer.npz")
    commands = np.zeros((10, 3), np.float32)
    assert beyond_range(policy, commands) == []
    # Each axis is in its range, all together are beyond the ellipsoid.
    commands[5] = 0.6, 0.15, 0.8
    (note,) = beyond_range(policy, commands)
    assert note.endswith("such as 0.60 0.15 0.80 to 0.43 0.09 0.46")
    straight = load(policies_folder() / "walk.npz")
    assert beyond_range(straight, commands) == []
    commands[5, 0] = 1.0
    (note,) = beyond_range(straight, commands)
    assert note.endswith("such as 1.00 0.15 0.80 to 0.60 0.15 0.80")


def test_a_robot_without_a_steered_policy_is_driven_by_its_straight_walk():
    assert default_policy().name == "steer.npz"
    assert default_policy("nao_h25").parent == policies_folder("nao_h25")


def test_a_drive_is_reported_and_captioned(walker):
    commands = np.zeros((150, 3), np.float32)
    commands[:100, 0] = 0.2
    drive = drive_by_commands(walker, commands, seed=0)
    lines = report(commands, drive)
    assert len(lines) == 4 and lines[-1] == "the robot did not fall"
    assert "0.20 0.00 0.00" in lines[1]
    texts = captions(drive)
    assert len(texts) == 150 and texts[60].startswith("asked 0.20 0.00 0.00, reached 0.")


def test_keys_change_the_command():
    command = Command(np.full(3, -1.0), np.full(3, 1.0))
    for key in (265, 265, 263, 44):
        command.press(key)
    np.testing.assert_allclose(command.value, [0.1, 0.05, 0.2])
    command.press(0)
    np.testing.assert_allclose(command.value, [0.1, 0.05, 0.2])
    command.press(32)
    np.testing.assert_allclose(command.value, 0.0)


def test_keys_keep_the_command_in_the_range_of_the_policy():
    learned = load(policies_folder() / "steer.npz")
    command = Command(*command_range(learned))
    for key in (264, 44, 262):
        for _ in range(30):
            command.press(key)
    low, high = learned.contexts.low, learned.contexts.high
    np.testing.assert_allclose(command.value, [low[0], high[1], low[2]], atol=1e-6)


def test_a_live_robot_walks_and_starts_again_after_a_fall(walker):
    live = LiveRobot(walker)
    for _ in range(100):
        qpos, speed = live.step(np.array([0.3, 0.0, 0.0], np.float32))
    assert not live.has_fallen and qpos[0] > 0.1 and speed[0] > 0.1
    live.has_fallen = True
    qpos, _ = live.step(np.zeros(3, np.float32))
    assert abs(qpos[0]) < 0.05


def test_without_a_screen_the_command_names_the_other_way(monkeypatch, capsys):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    assert cli.main(["drive"]) == 2
    assert "creps-jax drive --script commands.csv" in capsys.readouterr().err


def test_a_video_must_be_an_mp4_file(tmp_path, capsys):
    (tmp_path / "commands.csv").write_text(SCRIPT)
    script = ["--script", str(tmp_path / "commands.csv")]
    assert cli.main(["drive", *script, "--video", str(tmp_path / "a.gif")]) == 2
    assert "must be an .mp4 file" in capsys.readouterr().err
