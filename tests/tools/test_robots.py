"""The robots that the commands find by name or by a description."""

import dataclasses
import os
import shutil

import pytest

from creps_jax.errors import UserError
from creps_jax.files import policies_folder
from creps_jax.policies.learned import load
from creps_jax.tools import play
from creps_jax.tools.robots import ROBOTS, find_robot
from experiments.walk import Settings
from tests.tools.offset_humanoid import write_spec


@pytest.fixture
def spec(tmp_path):
    return write_spec(tmp_path)


def edit(path, old, new):
    """Replace a text of a file, which is then newer than before."""
    text, before = path.read_text(), path.stat().st_mtime_ns
    assert old in text
    path.write_text(text.replace(old, new))
    os.utime(path, ns=(before + 1_000, before + 1_000))


def model_of(spec):
    (path,) = spec.parent.glob("*.xml")
    return path


def test_a_robot_is_read_once_until_its_files_are_edited(spec):
    first = find_robot(str(spec))
    assert find_robot(str(spec)) is first and find_robot(os.path.relpath(spec)) is first
    spec.write_text(f"speeds = [0.1, 0.2]\n{spec.read_text()}")
    second = find_robot(str(spec))
    assert (second.low, second.high) == (0.1, 0.2) != (first.low, first.high)
    edit(model_of(spec), 'mass="3"', 'mass="4"')
    third = find_robot(str(spec))
    added = third.robot.model.body_mass.sum() - second.robot.model.body_mass.sum()
    assert added == pytest.approx(1.0) and third.low == 0.1
    assert find_robot(str(spec)) is third


def test_an_edit_that_breaks_a_description_is_named(spec):
    find_robot(str(spec))
    edit(spec, "left_leg", "left_log")
    with pytest.raises(UserError, match="unknown key 'left_log'"):
        find_robot(str(spec))
    edit(spec, "left_log", "left_leg")
    find_robot(str(spec))
    model_of(spec).unlink()
    with pytest.raises(UserError, match="which is no file"):
        find_robot(str(spec))
    spec.unlink()
    with pytest.raises(UserError, match="cannot read"):
        find_robot(str(spec))


def test_settings_keep_their_robot_while_its_files_are_edited(spec):
    settings = Settings(robot=str(spec))
    before = settings.ranges()
    edit(model_of(spec), 'mass="3"', 'mass="4"')
    assert settings.ranges() is before is not Settings(robot=str(spec)).ranges()
    shutil.rmtree(spec.parent)
    assert settings.ranges() is before and settings.context_range()[0] == (before.low,)


@pytest.mark.parametrize("name", ["robot.xml", "folder/robot.mjcf", "robot.urdf"])
def test_a_model_needs_a_description(name):
    with pytest.raises(UserError, match=f"described by a .toml file that names its model, got {name}"):
        find_robot(name)


def test_a_policy_of_a_description_with_another_name_tells_which_name_it_needs(spec):
    shipped = load(policies_folder() / "walk.npz")
    policy = dataclasses.replace(shipped, task={**shipped.task, "robot": "before"})
    with pytest.raises(UserError, match=r"of the robot before, not of .*may say name = 'before'"):
        play.robot_of(policy, str(spec))


def test_the_robots_of_the_library_are_found_by_name():
    assert find_robot("nao") is ROBOTS["nao"]
    with pytest.raises(UserError, match="unknown robot 'noa', did you mean 'nao'"):
        find_robot("noa")
