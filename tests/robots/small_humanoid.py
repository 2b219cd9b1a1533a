"""A small humanoid as an MJCF file: its axes are apart from each other, and the signs of both legs differ."""

from collections.abc import Sequence
from pathlib import Path

PARTS = ("hip_yaw", "hip_roll", "hip_pitch", "knee", "ankle_pitch", "ankle_roll")
SPEC = {
    "left_leg": [f"left_{part}" for part in PARTS],
    "right_leg": [f"right_{part}" for part in PARTS],
    "feet": ["left_foot", "right_foot"],
}
"""The arguments of `humanoid_from_mjcf` for the six-joint legs."""

# Offset of each joint from the one before (left leg, m), its axis, its lower and its upper limit (rad).
_JOINTS = {
    "hip_yaw": ((0.01, 0.06, -0.02), "z", -1.0, 0.8),
    "hip_roll": ((0.0, 0.0, -0.04), "x", -0.5, 0.7),
    "hip_pitch": ((0.02, 0.01, -0.03), "y", -1.6, 1.0),
    "knee": ((0.015, 0.0, -0.2), "y", 0.0, 2.2),
    "ankle_pitch": ((-0.005, 0.0, -0.2), "y", -1.3, 1.0),
    "ankle_roll": ((0.0, 0.0, -0.02), "x", -0.6, 0.6),
}
# Signs of the joints; mirrored axes would have yaw and roll opposite, and pitch equal.
_SIGNS = {"left": (1, 1, 1, 1, 1, 1), "right": (-1, 1, -1, -1, 1, -1)}
FEET = {
    "box": '<geom name="{side}_sole" type="box" pos="0.03 {y} -0.03" size="0.09 0.045 0.01" mass="0.2"/>',
    "sphere": "".join(
        f'<geom type="sphere" pos="{x} {y} -0.03" size="0.01" mass="0.05"/>'
        for x in (-0.05, 0.11)
        for y in (-0.03, 0.04)
    ),
    "capsule": "".join(
        f'<geom type="capsule" fromto="-0.05 {y} -0.03 0.11 {y} -0.03" size="0.01" mass="0.1"/>'
        for y in (-0.03, 0.04)
    ),
    "cylinder": '<geom type="cylinder" pos="0.03 {y} -0.03" size="0.06 0.01" mass="0.2"/>',
    "ellipsoid": "".join(
        f'<geom type="ellipsoid" pos="{x} 0 -0.03" size="0.02 0.03 0.01" mass="0.1"/>' for x in (-0.05, 0.11)
    ),
    "mesh": '<geom type="mesh" mesh="foot" mass="0.2"/>',
    "visual": '<geom type="box" size="0.09 0.045 0.01" contype="0" conaffinity="0" mass="0.2"/>',
    "tilted": '<geom type="box" pos="0.03 0 -0.03" size="0.09 0.045 0.01" euler="0 0.2 0" mass="0.2"/>',
    "none": '<inertial pos="0 0 0" mass="0.2" diaginertia="0.001 0.001 0.001"/>',
}
"""The geoms of a foot by name; the lowest points of the solid, level ones are 0.04 m below the ankle roll."""
MOTOR = '<motor name="{name}" joint="{name}" gear="2" ctrlrange="-8 8"/>'
"""A motor of 16 N m."""


def write_model(
    folder: Path,
    *replacements: tuple[str, str],
    name: str = "small",
    foot: str = "box",
    parts: Sequence[str] = PARTS,
    arms: bool = True,
    motor: str = MOTOR,
    actuators_reversed: bool = False,
    sides: Sequence[str] = ("left", "right"),
) -> Path:
    """Write the MJCF file of the humanoid into a folder, and return its path.

    Args:
        folder: Where to write it.
        replacements: Texts of the file to replace, and what takes their place; each must be there.
        name: Name of the file without its ending.
        foot: The geoms of the feet, of `FEET`.
        parts: Joints of a leg; the offsets of those left out are added to the next joint.
        arms: Whether it has arms of one joint each, and a head.
        motor: The actuator of a joint.
        actuators_reversed: Whether the actuators are in the reverse order of the joints.
        sides: Order of the legs in the tree.
    """
    joints = [f"{side}_{part}" for side in sides for part in parts]
    upper = _arm("left", 1) + '<body name="skull" pos="0 0 0.24">'
    upper += '<joint name="head" axis="0 0 1" range="-1 1"/>'
    upper += '<geom type="sphere" size="0.04" mass="0.3"/></body>' + _arm("right", -1)
    if arms:
        joints = ["left_shoulder", "head", "right_shoulder", *joints]
    motors = [motor.format(name=joint) for joint in joints]
    text = f"""<mujoco model="small">
  <compiler angle="radian" autolimits="true"/>
  <asset><mesh name="foot" vertex="{_mesh()}"/></asset>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 0.05"/>
    <body name="trunk" pos="0 0 0.6">
      <freejoint name="root"/>
      <geom name="chest" type="box" pos="0 0 0.1" size="0.05 0.08 0.1" mass="3"/>
      {upper if arms else ""}
      {"".join(_leg(side, parts, foot) for side in sides)}
    </body>
  </worldbody>
  <actuator>
    {"".join(reversed(motors) if actuators_reversed else motors)}
  </actuator>
</mujoco>
"""
    for old, new in replacements:
        assert old in text, old
        text = text.replace(old, new)
    path = folder / f"{name}.xml"
    path.write_text(text)
    return path


def _arm(side: str, sign: int) -> str:
    return (
        f'<body name="{side}_arm" pos="0 {0.11 * sign} 0.18">'
        f'<joint name="{side}_shoulder" axis="0 1 0" range="-2 2"/>'
        '<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3"/></body>'
    )


def _leg(side: str, parts: Sequence[str], foot: str) -> str:
    """Return the bodies of a leg, the last of which is the foot."""
    mirror = 1 if side == "left" else -1
    text, offset = "", [0.0, 0.0, 0.0]
    for part, sign in zip(_JOINTS, _SIGNS[side], strict=True):
        (x, y, z), axis, low, high = _JOINTS[part]
        offset = [offset[0] + x, offset[1] + mirror * y, offset[2] + z]
        if part not in parts:
            continue
        # Where mirrored axes have the opposite sign, so have the limits.
        turned = sign * (mirror if axis in "xz" else 1)
        low, high = (low, high) if turned > 0 else (0.0 - high, 0.0 - low)
        direction = " ".join(str(sign * int(axis == each)) for each in "xyz")
        body = f"{side}_foot" if part == parts[-1] else f"{side}_{part}_link"
        text += f'<body name="{body}" pos="{" ".join(f"{value:.6g}" for value in offset)}">'
        text += f'<joint name="{side}_{part}" axis="{direction}" range="{low} {high}"/>'
        if part == parts[-1]:
            drop = 0.0 if part == "ankle_roll" else -0.02
            text += f'<frame pos="0 0 {drop}">'
            text += FEET[foot].format(side=side, y=0.005 * mirror) + "</frame>"
        else:
            text += '<geom type="sphere" size="0.02" mass="0.2"/>'
        offset = [0.0, 0.0, 0.0]
    return text + "</body>" * len(parts)


def _mesh() -> str:
    return " ".join(f"{x} {y} {z}" for x in (-0.06, 0.12) for y in (-0.04, 0.05) for z in (-0.04, -0.02))
