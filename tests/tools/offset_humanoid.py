"""A small humanoid whose joint axes do not meet, and a walk for it."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from creps_jax.files import policies_folder
from creps_jax.policies.learned import Learned, load
from creps_jax.policies.space import Space
from creps_jax.robots.humanoid import Humanoid
from creps_jax.robots.mjcf import humanoid_from_mjcf
from creps_jax.robots.robot import Robot
from creps_jax.walking.params import scaled_bounds

JOINTS = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")
_SIDES = {"left": 1, "right": -1}

_LEG = """
<body name="{side}_thigh" pos="0 {y} -0.1">
  <joint name="{side}_hip_yaw" axis="0.2 0 1" pos="0.01 0 0.05" range="-1 1"/>
  <joint name="{side}_hip_roll" axis="{sign} 0 0" pos="-0.02 0 0.02" range="-0.8 0.8"/>
  <joint name="{side}_hip_pitch" axis="0 1 0" range="-1.8 1"/>
  <geom type="capsule" fromto="0 0 -0.03 0 0 -0.12" size="0.03" mass="0.6"/>
  <body name="{side}_shank" pos="0.01 0 -0.15">
    <joint name="{side}_knee" axis="0 {sign} 0" range="-2.2 2.2"/>
    <geom type="capsule" fromto="0 0 -0.03 0 0 -0.1" size="0.025" mass="0.4"/>
    <body name="{side}_foot" pos="0 0 -0.14">
      <joint name="{side}_ankle_pitch" axis="0 -1 0" range="-1 1"/>
      {ankle_roll}
      <geom type="box" pos="0.02 0 -0.05" size="0.08 0.045 0.01" mass="0.3"/>
    </body>
  </body>
</body>
"""
_ANKLE_ROLL = '<joint name="{side}_ankle_roll" axis="1 0 0" pos="0 0 -0.02" range="-0.7 0.7"/>'
_ROBOT = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="trunk" pos="0 0 0.5">
      <freejoint/>
      <geom type="box" size="0.06 0.08 0.1" pos="0 0 0.05" mass="3"/>
      <body name="head" pos="0 0 0.2">
        <joint name="neck" axis="0 0 1" range="-1.5 1.5"/>
        <geom type="sphere" size="0.05" mass="0.3"/>
      </body>
      {legs}
    </body>
  </worldbody>
  <actuator>
    {motors}
  </actuator>
</mujoco>
"""


def make_humanoid(folder: Path, num_leg_joints: int = 6) -> Humanoid:
    """Write the model and read the robot; legs of five joints have no ankle roll."""
    return humanoid_from_mjcf(_write_model(folder, num_leg_joints), **_description(num_leg_joints))


def write_spec(folder: Path) -> Path:
    """Write the model and the TOML file that describes the robot."""
    _write_model(folder, 6)
    lines = ['model = "model.xml"']
    for key, value in _description(6).items():
        is_table = isinstance(value, dict)
        lines.append(f"{key} = {{ neck = {value['neck']} }}" if is_table else f"{key} = {json.dumps(value)}")
    path = folder / "robot.toml"
    path.write_text("\n".join(lines))
    return path


def _write_model(folder: Path, num_leg_joints: int) -> Path:
    legs = "".join(
        _LEG.replace("{ankle_roll}", _ANKLE_ROLL if num_leg_joints == 6 else "").format(
            side=side, sign=sign, y=0.06 * sign
        )
        for side, sign in _SIDES.items()
    )
    joints = ["neck", *(f"{side}_{name}" for side in _SIDES for name in JOINTS[:num_leg_joints])]
    motors = "".join(f'<motor joint="{joint}" ctrllimited="true" ctrlrange="-20 20"/>' for joint in joints)
    path = folder / "model.xml"
    path.write_text(_ROBOT.format(legs=legs, motors=motors))
    return path


def _description(num_leg_joints: int) -> dict[str, Any]:
    legs = {f"{side}_leg": [f"{side}_{name}" for name in JOINTS[:num_leg_joints]] for side in _SIDES}
    return {
        "name": "offset-humanoid",
        **legs,
        "feet": ["left_foot", "right_foot"],
        "held": {"neck": 0.1},
        "arm_swing": {"neck": 2.0},
    }


def scaled_walk(robot: Robot, com: str = "continuous", name: str = "walk") -> Learned:
    """Return a shipped walk of the NAO, scaled to a robot."""
    policy = load(policies_folder() / f"{name}.npz")
    space = policy.parameters
    low, high = scaled_bounds(robot, (space.low[:10], space.high[:10]))
    low, high = (
        (*end, *(robot.size * side for side in sides[10:11]), *sides[11:])
        for end, sides in ((low, space.low), (high, space.high))
    )
    return dataclasses.replace(
        policy,
        parameters=Space(space.names, low, high, space.units, space.constraint),
        task={**policy.task, "robot": robot.name, "com": com},
    )
