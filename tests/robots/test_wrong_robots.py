"""A wrong model or description of a robot gives one sentence that names the cause."""

import inspect
import re

import pytest

from creps_jax.errors import UserError
from creps_jax.robots import mjcf, mjcf_settings, spec
from tests.robots.small_humanoid import FEET, MOTOR, SPEC, write_model

LEFT, RIGHT = SPEC["left_leg"], SPEC["right_leg"]
LEFT_KNEE = '<joint name="left_knee" axis="0 1 0" range="0.0 2.2"/>'
KNEE_MOTOR = MOTOR.format(name="left_knee")
NO_LIMIT = '<motor name="{name}" joint="{name}"/>'
UPRIGHT = [0.0, 0.0, -0.4, 0.8, -0.4, 0.0]


def both_knees(low, high):
    """Replace the range of both knees, whose axes are opposite to each other."""
    return tuple(
        (
            f'"{side}_knee" axis="0 {sign} 0" range="{old}"',
            f'"{side}_knee" axis="0 {sign} 0" range="{new}"',
        )
        for side, sign, old, new in (
            ("left", 1, "0.0 2.2", f"{low} {high}"),
            ("right", -1, "-2.2 0.0", f"{-high} {-low}"),
        )
    )


def swapped(values, first, second):
    values = list(values)
    values[first], values[second] = values[second], values[first]
    return values


# All of the robot hangs on a body that is turned by half a turn about z.
FACES_BACKWARDS = [
    ('<freejoint name="root"/>', '<freejoint name="root"/><body name="inner" euler="0 0 3.14159265">'),
    ("</worldbody>", "</body></worldbody>"),
]


# What is wrong: replacements in the model or arguments of `write_model`, arguments of `humanoid_from_mjcf`,
# and the error.
MODELS = {
    "no free joint": (
        [('<freejoint name="root"/>', "")],
        "small.xml must have one body with a free joint, the trunk of the robot, got none$",
    ),
    "fixed by hinges": (
        [('<freejoint name="root"/>', '<joint name="root_x" type="slide" axis="1 0 0"/>')],
        "one body with a free joint, the trunk of the robot, got none$",
    ),
    "two robots": (
        [("</worldbody>", '<body name="ball"><freejoint/><geom size="0.1"/></body></worldbody>')],
        "one body with a free joint, the trunk of the robot, got trunk, ball$",
    ),
    "slide joint": (
        [('"head" axis', '"head" type="slide" axis')],
        "all joints of the robot must be hinges, got 'head'",
    ),
    "ball joint": (
        [('<joint name="head" axis="0 0 1" range="-1 1"/>', '<joint name="head" type="ball"/>')],
        "all joints of the robot must be hinges, got 'head'",
    ),
    "joint without a name": (
        [('<joint name="head" ', "<joint "), (MOTOR.format(name="head"), "")],
        "each joint of the robot must have a name, got none for one of body 'skull'$",
    ),
    "no actuator": (
        [(KNEE_MOTOR, "")],
        "each joint must have an actuator in the model, got none for 'left_knee'$",
    ),
    "no actuators": (
        {"motor": ""},
        "each joint must have an actuator in the model, got none for any joint$",
    ),
    "no torque limit": (
        [(KNEE_MOTOR, NO_LIMIT.format(name="left_knee"))],
        "the torque of 'left_knee' must have a limit: its joint has no actuatorfrcrange, and its actuator "
        "has neither a forcerange nor, as a motor, a ctrlrange; state one in the model, or max_torque in the "
        "description$",
    ),
    "one of two actuators without a limit": (
        [(KNEE_MOTOR, KNEE_MOTOR + '<motor joint="left_knee"/>')],
        "the torque of 'left_knee' must have a limit: its joint has no actuatorfrcrange, and its actuator",
    ),
    "torque in one direction": (
        [(KNEE_MOTOR, KNEE_MOTOR.replace('"-8 8"', '"0 8"'))],
        "the torque of 'left_knee' must have a limit above 0 in both directions, got 0$",
    ),
    "faces along y": (
        [
            ('axis="0 1 0"', 'axis="9 0 0"'),
            ('axis="1 0 0"', 'axis="0 1 0"'),
            ('axis="9 0 0"', 'axis="1 0 0"'),
        ],
        "a leg must have three joints whose axes point along y, those of hip, knee and ankle "
        r"\(the trunk must face along x\), got left_hip_roll, left_ankle_roll in the leg left_hip_yaw",
    ),
    "right leg not mirrored": (
        [('"right_hip_roll_link" pos="0 0 -0.04"', '"right_hip_roll_link" pos="0 0 -0.09"')],
        "right_leg must mirror left_leg joint by joint, got 'left_hip_roll' and 'right_hip_roll', whose "
        r"positions \(0.010, 0.060, -0.060\) and \(0.010, -0.060, -0.110\) m do not mirror each other$",
    ),
    "another axis on the right": (
        [('"right_hip_yaw" axis="0 0 -1"', '"right_hip_yaw" axis="0 0.5 -1"')],
        "right_leg must mirror left_leg joint by joint, got 'left_hip_yaw' and 'right_hip_yaw', whose axes "
        r"\(0.000, 0.000, 1.000\) and \(0.000, 0.447, -0.894\) do not mirror each other$",
    ),
    "knees that bend backwards": (
        both_knees(-2.2, -0.2),
        "the knee 'left_knee' must bend by 0.6 rad or more so that it is ahead of hip and ankle, where x is "
        "positive: in its range, -2.20 to -0.20 rad, it bends backwards$",
    ),
    "knees that hardly bend": (
        both_knees(-2.2, 0.3),
        "the knee 'left_knee' must bend by 0.6 rad or more .* in its range, -2.20 to 0.30 rad, it bends "
        "forwards from 0.00 to 0.40 rad only$",
    ),
    "knees of degrees that hardly bend": (
        both_knees(0, 0.23),
        "the knee 'left_knee' must bend by 0.6 rad or more .* in its range, 0.00 to 0.23 rad, it bends "
        "forwards from 0.10 to 0.33 rad only$",
    ),
    "knees that are always bent": (
        both_knees(1.0, 1.4),
        "the knee 'left_knee' must bend by 0.6 rad or more .* it bends forwards from 1.10 to 1.50 rad only$",
    ),
    "faces along -x": (
        FACES_BACKWARDS,
        "left_leg must be on the left side, where y is positive, and right_leg on the right, got ankles at "
        "y = -0.070 and 0.070 m, and knees that bend backwards: turn the trunk so that it faces along x$",
    ),
    "faces along -x with knees that bend both ways": (
        [*FACES_BACKWARDS, *both_knees(-2.2, 2.2)],
        "ankles at y = -0.070 and 0.070 m: exchange the legs, or turn the trunk so that it faces along x$",
    ),
    "a leg that reaches nothing": (
        [
            (
                '"left_ankle_pitch" axis="0 1 0" range="-1.3 1.0"',
                '"left_ankle_pitch" axis="0 1 0" range="0.9 1"',
            )
        ],
        "the leg left_hip_yaw.* must reach the floor below its hip with its knee bent, got a sole 0.0",
    ),
    "foot without geoms": (
        {"foot": "none"},
        "the left foot 'left_foot' must have a geom that touches the floor, a box, sphere, capsule, cylinder "
        "or ellipsoid, got none: add one to the body in the model$",
    ),
    "one foot without geoms": (
        [(FEET["box"].format(side="right", y=-0.005), FEET["none"])],
        "the right foot 'right_foot' must have a geom that touches the floor, .* got none: add one",
    ),
    "feet that are only drawn": (
        {"foot": "visual"},
        "touches the floor, .* got only geoms that touch nothing",
    ),
    "feet of meshes": ({"foot": "mesh"}, "touches the floor, .* got only meshes: add one"),
    "tilted feet": (
        {"foot": "tilted"},
        "the sole of 'left_foot' must be level with all joints of the leg at zero, or else at the angles of "
        "crouch, got lowest points at zero that span 0.000 of its 0.180 m forwards and 0.090 of its 0.090 m "
        "sideways$",
    ),
    "feet tilted sideways": (
        [('size="0.09 0.045 0.01" mass', 'size="0.09 0.045 0.01" euler="0.2 0 0" mass')],
        "the sole of 'left_foot' must be level .* and 0.000 of its 0.0",
    ),
    "feet that are points": (
        [('type="box" pos="0.03 0.005 -0.03" size="0.09 0.045 0.01"', 'type="sphere" size="0.05"')],
        "the sole of 'left_foot' must have a length, got a single point of contact$",
    ),
    "feet that are rows of points": (
        [
            (
                sole,
                "".join(
                    f'<geom type="sphere" pos="0 {y} -0.03" size="0.01" mass="0.1"/>' for y in (-0.03, 0.03)
                ),
            )
            for sole in (
                FEET["box"].format(side=side, y=y) for side, y in (("left", 0.005), ("right", -0.005))
            )
        ],
        "the sole of 'left_foot' must have a length, got a row of points from left to right$",
    ),
    "soles above the ankles": (
        [('-0.03" size="0.09', '0.3" size="0.09')],
        "the height of the ankle above the sole of 'left_foot' must be above 0 and below the length of the "
        "leg, 0.401 m, got -0.270 m: correct the place or the size of its geoms$",
    ),
    "soles just above the ankles": (
        [('-0.03" size="0.09', '0.031" size="0.09')],
        "the height of the ankle above the sole of 'left_foot' must be above 0 and .* got -0.001 m",
    ),
    "feet in millimetres": (
        [('size="0.09 0.045 0.01"', 'size="90 45 10"')],
        "the height of the ankle above the sole of 'left_foot' must be .* 0.401 m, got 10.050 m",
    ),
    "one foot in millimetres": (
        [
            (
                'name="right_sole" type="box" pos="0.03 -0.005 -0.03" size="0.09 0.045 0.01"',
                'name="right_sole" type="box" size="90 45 10"',
            )
        ],
        "the height of the ankle above the sole of 'right_foot' must be .* 0.401 m, got 10.020 m",
    ),
    "legs in one line": (
        [
            (
                'body name="right_hip_yaw_link" pos="0.01 -0.06 -0.02"',
                'body name="right_hip_yaw_link" pos="0.01 0.3 0"',
            )
        ],
        "left_leg must be on the left side, where y is positive, and right_leg on the right, got "
        "ankles at y = "
        "0.070 and 0.290 m$",
    ),
    "degrees for radians": (
        both_knees(0, 126),
        "the range of 'left_knee' must be within a turn, -6.28 to 6.28 rad, got 0 to 126 rad: if the model "
        'states degrees, its compiler must have angle="degree"$',
    ),
    "degrees of one joint": (
        [
            (
                '"right_ankle_roll" axis="-1 0 0" range="-0.6 0.6"',
                '"right_ankle_roll" axis="-1 0 0" range="-20 20"',
            )
        ],
        "the range of 'right_ankle_roll' must be within a turn, .* got -20 to 20 rad: if the model",
    ),
    "radians for degrees": (
        [('angle="radian"', 'angle="degree"')],
        "the range of 'left_hip_pitch' must be wider than 0.11 rad, got -0.02793 to 0.01745 rad: if the "
        'model states radians, its compiler must have angle="radian"$',
    ),
    "no XML": ([("<worldbody>", "<worldbody")], "small.xml must be an MJCF file that MuJoCo can read: "),
    "no MJCF": ([("<freejoint", "<freejoin")], "small.xml must be an MJCF file that MuJoCo can read: "),
    "mass of a missing mesh": (
        [
            ("<asset>", '<asset><mesh name="shell" file="missing.stl"/>'),
            ('type="sphere" size="0.04" mass="0.3"', 'type="mesh" mesh="shell"'),
        ],
        "the mass of the body 'skull' must be stated in the model, or follow from meshes whose files "
        "are there: "
        "Error opening file '.*missing.stl'",
    ),
    "no mass at all": (
        [('type="sphere" size="0.04" mass="0.3"', 'type="sphere" size="0.04" mass="0"')],
        "small.xml must compile: .*mass and inertia of moving bodies",
    ),
    "no mass but a mesh": (
        [('type="sphere" size="0.04" mass="0.3"', 'type="mesh" mesh="foot" mass="0"')],
        "small.xml must compile without its meshes: .*mass and inertia of moving bodies",
    ),
}

ARGUMENTS = {
    "unknown joint": (
        {"left_leg": ["left_hip_yow", *LEFT[1:]]},
        "left_leg must name joints of the model, got 'left_hip_yow', did you mean 'left_hip_yaw'",
    ),
    "a name without its side": (
        {"right_leg": ["hip_yaw", *RIGHT[1:]]},
        "right_leg must name joints of the model, got 'hip_yaw', did you mean 'right_hip_yaw'",
    ),
    "unknown body": (
        {"feet": ["left_foot", "right_sole"]},
        "feet must name bodies of the model, got 'right_sole', did you mean 'right_foot'",
    ),
    "unknown held": (
        {"held": {"left_sholder": 0.1}},
        "held must name joints outside of the legs of the model, got 'left_sholder', did you mean "
        "'left_shoulder'",
    ),
    "held leg": (
        {"held": {"left_knee": 0.1}},
        "held must name joints outside of the legs of the model, got 'left_knee'",
    ),
    "held too far": ({"held": {"head": 1.5}}, "held of head must be from -1.00 to 1.00 rad, got 1.5$"),
    "held no number": ({"held": {"head": "a"}}, "held of head must be a number, got 'a'$"),
    "held no names": ({"held": [0.1]}, r"held must be numbers by joint, got \[0.1\]$"),
    "swing of a leg": (
        {"arm_swing": {"left_knee": 1.0}},
        "arm_swing must name joints outside of the legs of the model, got 'left_knee'",
    ),
    "swing no number": ({"arm_swing": {"head": None}}, "arm_swing of head must be a number, got None$"),
    "swing no names": ({"arm_swing": 3}, "arm_swing must be numbers by joint, got 3$"),
    "legs swapped": (
        {"left_leg": RIGHT, "right_leg": LEFT, "feet": SPEC["feet"][::-1]},
        "left_leg must be on the left side, where y is positive, and right_leg on the right, got "
        "ankles at y = "
        "-0.070 and 0.070 m: exchange the legs$",
    ),
    "legs swapped, feet not": (
        {"left_leg": RIGHT, "right_leg": LEFT},
        "left_leg must list the joints from hip to ankle, as they follow each other in the model: "
        "'left_foot' "
        "must come below 'right_ankle_roll'",
    ),
    "feet swapped": ({"feet": SPEC["feet"][::-1]}, "'right_foot' must come below 'left_ankle_roll'"),
    "one leg twice": ({"right_leg": LEFT}, "right_leg must list .* 'right_foot' must come below"),
    "one foot twice": (
        {"feet": ["left_foot", "left_foot"]},
        "feet must have each name once, got 'left_foot' repeatedly$",
    ),
    "foot above the ankle": (
        {"feet": ["left_knee_link", "right_foot"]},
        "left_leg must list .* 'left_knee_link' must come below 'left_ankle_roll'",
    ),
    "another order": (
        {"left_leg": swapped(LEFT, 2, 3)},
        "left_leg must list the joints from hip to ankle, .*: 'left_hip_pitch' must come below "
        "'left_knee', got "
        "the order left_hip_yaw, left_hip_roll, left_knee, left_hip_pitch",
    ),
    "from the ankle up": ({"left_leg": LEFT[::-1]}, "left_leg must list the joints from hip to ankle"),
    "a joint of the other leg": (
        {"left_leg": [*LEFT[:3], RIGHT[3], *LEFT[4:]]},
        "left_leg must list .* 'right_knee' must come below 'left_hip_pitch'",
    ),
    "an arm for a leg": ({"left_leg": ["left_shoulder", *LEFT[1:]]}, "left_leg must list"),
    "joint skipped": (
        {"left_leg": [*LEFT[:1], *LEFT[2:]]},
        "left_leg must list all joints from hip to foot; missing: left_hip_roll, which the model has between "
        "left_hip_yaw and left_foot$",
    ),
    "first joint skipped": (
        {"left_leg": LEFT[1:]},
        r"both legs must have equally many joints, got \('left_hip_roll', ",
    ),
    "last joint skipped": (
        {"left_leg": LEFT[:-1], "right_leg": RIGHT[:-1]},
        "left_leg must list all joints from hip to foot; missing: left_ankle_roll",
    ),
    "joint twice": (
        {"left_leg": [*LEFT[:5], LEFT[4]]},
        "left_leg must have each name once, got 'left_ankle_pitch' repeatedly$",
    ),
    "two joints twice": (
        {"right_leg": [*RIGHT[:2], *RIGHT[1:3], RIGHT[2], RIGHT[2]]},
        "right_leg must have each name once, got 'right_hip_roll', 'right_hip_pitch' repeatedly$",
    ),
    "four joints": (
        {"left_leg": LEFT[1:5]},
        "left_leg must be the names of 5 or 6 joints, from hip to ankle, got",
    ),
    "seven joints": (
        {"right_leg": ["head", *RIGHT]},
        "right_leg must be the names of 5 or 6 joints, from hip to ankle, got",
    ),
    "leg as text": (
        {"left_leg": "left_hip"},
        "left_leg must be the names of 5 or 6 joints, from hip to ankle, got 'left_hip'$",
    ),
    "leg of numbers": (
        {"left_leg": [1, 2, 3, 4, 5]},
        r"left_leg must be the names of 5 or 6 joints, from hip to ankle, got \[1, 2",
    ),
    "leg None": (
        {"left_leg": None},
        "left_leg must be the names of 5 or 6 joints, from hip to ankle, got None$",
    ),
    "feet 3": ({"feet": 3}, "feet must be the names of 2 bodies, the left and the right foot, got 3$"),
    "three feet": (
        {"feet": ["left_foot", "right_foot", "trunk"]},
        "feet must be the names of 2 bodies, the left and the right foot, got",
    ),
    "name 3": ({"name": 3}, "name must be of type str, got 3$"),
    "name of two lines": (
        {"name": "my\nrobot"},
        "name must be one line of printable characters, got 'my.*robot'$",
    ),
    "blank name": ({"name": " "}, "name must be one line of printable characters, got ' '$"),
    "backward crouch": (
        {"crouch": [0.0, 0.0, 0.4, -0.8, 0.4, 0.0]},
        "crouch must have 'left_knee' from 0.00 to 2.20 rad, where the knee is bent forwards, got -0.8$",
    ),
    "crouch out of range": (
        {"crouch": [0.9, *UPRIGHT[1:]]},
        "crouch must have 'left_hip_yaw' from -1.00 to 0.80 rad, got 0.9$",
    ),
    "crouch of one leg too many": (
        {"crouch": UPRIGHT * 2},
        "crouch must have an angle for each of left_hip_yaw, left_hip_roll, .*, got",
    ),
    "crouch 0.3": ({"crouch": 0.3}, "crouch must have an angle for each of left_hip_yaw"),
    "crouch no numbers": (
        {"crouch": ["a"] * 6},
        "crouch must have an angle for each of left_hip_yaw, left_hip_roll, .*, got \\['a', ",
    ),
    "crouch of lists": ({"crouch": [[0.1], 0.2]}, "crouch must have an angle for each of left_hip_yaw"),
    "crouch not finite": ({"crouch": [float("nan")] * 6}, "crouch must be finite, got nan"),
    "kp a": ({"kp": "a"}, "kp must be a number, got 'a'$"),
    "kp 0": ({"kp": 0.0}, "kp must be finite and above 0, got 0.0$"),
    "kp of a spring": (
        {"kp": 0.4},
        "kp must be at least 2.48 N m/rad, a hundredth of its default, got 0.4: softer legs cannot carry the "
        "robot$",
    ),
    "kp that float32 rounds to 0": (
        {"kp": 1e-60},
        "kp must be finite and above 0, got 1e-60, which float32 cannot hold$",
    ),
    "kv below 0": ({"kv": -1.0}, "kv must be finite and at least 0, got -1.0$"),
    "max_speed a": ({"max_speed": "a"}, "max_speed must be a number, got 'a'$"),
    "max_speed 0": ({"max_speed": 0}, "max_speed must be finite and above 0, got 0$"),
    "max_speed of a joint": (
        {"max_speed": {"left_knee": 0.0}},
        "max_speed of left_knee must be finite and above 0, got 0.0$",
    ),
    "max_speed of nothing": (
        {"max_speed": {"left_kne": 3.0}},
        "max_speed must name joints of the model, got 'left_kne', did you mean 'left_knee'",
    ),
    "max_speed in degrees": (
        {"max_speed": 300},
        "max_speed must be at most 100 rad/s, got 300: convert degrees to radians$",
    ),
    "max_speed of a joint in degrees": (
        {"max_speed": {"left_knee": 3.0, "head": 180.0}},
        "max_speed of head must be at most 100 rad/s, got 180: convert",
    ),
    "max_torque 0": ({"max_torque": 0.0}, "max_torque must be finite and above 0, got 0.0$"),
    "max_torque a": ({"max_torque": "a"}, "max_torque must be a number, got 'a'$"),
    "foot_spacing 0": ({"foot_spacing": 0.0}, "foot_spacing must be finite and above 0, got 0.0$"),
    "foot_spacing a": ({"foot_spacing": "a"}, "foot_spacing must be a number, got 'a'$"),
    "feet far apart": (
        {"foot_spacing": 12},
        "foot_spacing must be below the length of the leg, 0.401 m, got 12$",
    ),
    "feet a leg apart": ({"foot_spacing": 0.41}, "foot_spacing must be below the length of the leg"),
    "feet that overlap": (
        {"foot_spacing": 0.02},
        "foot_spacing must be above 0.080 m, so that the feet, which reach 0.040 m inwards from the ankles, "
        "do not overlap, got 0.02$",
    ),
    "feet that touch": ({"foot_spacing": 0.0799}, "foot_spacing must be above 0.080 m, .* got 0.0799$"),
    "speeds of a car": (
        {"speeds": [5, 30]},
        r"speeds must be at most 1.98 m/s, the fastest walk of a leg of 0.401 m \(Froude number 1\), got 30$",
    ),
    "one speed too high": ({"speeds": (0.1, 2.0)}, "speeds must be at most 1.98 m/s, .* got 2$"),
    "speeds out of order": (
        {"speeds": (0.5, 0.1)},
        r"speeds must be two numbers, the lower first, got \(0.5, 0.1\)$",
    ),
    "speeds equal": ({"speeds": (0.5, 0.5)}, "speeds must be two numbers, the lower first, got"),
    "speeds from 0": ({"speeds": (0.0, 0.5)}, "speeds must be finite and above 0, got 0.0$"),
    "speeds of words": (
        {"speeds": ("slow", "fast")},
        r"speeds must be two numbers, the lower first, got \('slow', 'fast'\)$",
    ),
    "speeds as text": ({"speeds": ["0.05", "0.35"]}, "speeds must be two numbers, the lower first, got"),
    "speeds not finite": ({"speeds": [0.1, float("nan")]}, "speeds must be finite, got nan$"),
    "speed 0.3": ({"speeds": 0.3}, "speeds must be two numbers, the lower first, got 0.3$"),
    "three speeds": ({"speeds": (0.1, 0.2, 0.3)}, "speeds must be two numbers, the lower first, got"),
}


@pytest.fixture(autouse=True)
def as_users_call_it(monkeypatch):
    """Call the functions without the import hook of the tests, which would name wrong types before "
    "they do."""
    monkeypatch.setattr(mjcf, "humanoid_from_mjcf", inspect.unwrap(mjcf.humanoid_from_mjcf))
    monkeypatch.setattr(spec, "humanoid_from_toml", inspect.unwrap(spec.humanoid_from_toml))


def error_of(path, **arguments):
    """Return the message of the error, after checking that it is one sentence."""
    with pytest.raises(ValueError) as caught:
        mjcf.humanoid_from_mjcf(path, **{**SPEC, **arguments})
    message = str(caught.value)
    assert "\n" not in message and " must " in message, message
    return message


@pytest.mark.parametrize("wrong", MODELS)
def test_a_wrong_model_is_named(wrong, tmp_path):
    changes, message = MODELS[wrong]
    path = write_model(tmp_path, **changes) if isinstance(changes, dict) else write_model(tmp_path, *changes)
    assert re.search(message, error_of(path))


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    return write_model(tmp_path_factory.mktemp("small"))


@pytest.mark.parametrize("wrong", ARGUMENTS)
def test_a_wrong_argument_is_named(wrong, small):
    arguments, message = ARGUMENTS[wrong]
    assert re.search(message, error_of(small, **arguments))


def test_feet_that_are_tilted_in_the_crouch_too_are_named(tmp_path):
    path = write_model(tmp_path, foot="tilted")
    assert re.search(
        "the sole of 'left_foot' must be level with all joints of the leg at zero, or else at the angles of "
        "crouch, got lowest points at the crouch that span 0.000 of its 0.180 m forwards and 0.090 of its "
        "0.090 m sideways$",
        error_of(path, crouch=[0.0, 0.0, -0.4, 0.8, -0.4, 0.0]),
    )
    # A crouch that makes them level must have a knee that is bent forwards, as any.
    assert re.search("crouch must have 'left_knee'", error_of(path, crouch=[0.0, 0.0, 0.4, -0.4, -0.2, 0.0]))


NAMES = {
    "LHipPitch": ("LHipPich", ["RHipPitch", "LHipPitch", "LHipRoll"]),
    "l_ank_pitch": ("l_ankle_pitch", ["r_ank_pitch", "l_ank_roll", "l_ank_pitch", "r_ankle"]),
    "hip.R": ("hips.R", ["hip.L", "hip.R"]),
    "Left_Hip_Roll": ("Left_Hip_Rol", ["Right_Hip_Roll", "Left_Hip_Roll"]),
    "left_knee_joint": ("left_knee_right", ["right_knee_right", "left_knee_joint"]),
    "l_knee": ("l_knee_pitch", ["r_knee_pitch", "l_knee"]),
    "right_hip_roll": ("left_hip_roll", ["right_hip_roll", "torso"]),
    "waist": ("wast", ["left_hip", "waist"]),
}


@pytest.mark.parametrize("nearest", NAMES)
def test_the_nearest_name_is_one_of_the_same_side(nearest):
    name, known = NAMES[nearest]
    with pytest.raises(ValueError, match=f"must name joints of the model, got .*, did you mean {nearest!r}"):
        mjcf_settings.named("feet", "joints", name, known)


@pytest.mark.parametrize("argument", ["held", "arm_swing"])
def test_a_robot_without_other_joints_has_none_to_hold(argument, tmp_path):
    path = write_model(tmp_path, arms=False)
    message = error_of(path, **{argument: {"head": 0.1}})
    assert message == (
        f"{argument} must name joints outside of the legs of the model, which has none, got 'head'"
    )


def test_a_leg_of_four_joints_is_named(tmp_path):
    parts = ("hip_roll", "hip_pitch", "knee", "ankle_pitch")
    path = write_model(tmp_path, parts=parts)
    legs = {f"{side}_leg": [f"{side}_{part}" for part in parts] for side in ("left", "right")}
    assert re.search(
        "left_leg must be the names of 5 or 6 joints, from hip to ankle, got", error_of(path, **legs)
    )


@pytest.mark.parametrize("path", [None, 3, ["a"]])
def test_a_path_must_be_one(path):
    assert "path must be of type str or Path" in error_of(path)


def test_a_model_must_be_a_file(tmp_path):
    assert error_of(tmp_path / "no.xml").endswith("no.xml, which is no file")
    assert error_of(tmp_path).startswith("the model must be an MJCF file, got ")


TOML = f"""model = "small.xml"
left_leg = {LEFT}
right_leg = {RIGHT}
feet = ["left_foot", "right_foot"]
"""
TOMLS = {
    "broken": (TOML + "held = {", "the robot must be described by a TOML file, cannot read .*small.toml: "),
    "no text": (b"\xff\xfe\x00", "the robot must be described by a TOML file, cannot read .*small.toml: "),
    "unknown key": (TOML + "hold = 3", "small.toml has an unknown key 'hold', did you mean 'held'"),
    "missing": (
        'model = "small.xml"',
        "small.toml must have the keys model, left_leg, right_leg, feet; missing: left_leg, right_leg, feet$",
    ),
    "empty": ("", "must have the keys model, left_leg, right_leg, feet; missing: model, left_leg"),
    "key twice": (TOML + "kp = 1\nkp = 2", "cannot read .*small.toml: "),
    "key in a table": (
        TOML + "[held]\nhead = 0.1\nkp = 90\nspeeds = [0.1, 0.3]",
        r"small.toml must have its keys before its tables, got kp, speeds in the table \[held\]$",
    ),
    "key in another table": (
        TOML + "[arm_swing]\nkv = 9",
        r"small.toml must have its keys before its tables, got kv in the table \[arm_swing\]$",
    ),
    "table in a table": (
        TOML + "[max_speed]\nhead = 3\n[max_speed.held]\nhead = 0.1",
        r"must have its keys before its tables, got held in the table \[max_speed\]$",
    ),
    "all keys in a table": (
        "[held]\n" + TOML,
        r"must have its keys before its tables, got model, left_leg, right_leg, feet in the table \[held\]$",
    ),
    "model 3": (
        TOML.replace('"small.xml"', "3"),
        "model in .*small.toml must be a path, or package:path, got 3$",
    ),
    "a path of Windows": (
        TOML.replace("small.xml", "C:/no/big.xml"),
        "the model must be an MJCF file, got .*C:/no/big.xml",
    ),
    "no model": (TOML.replace("small.xml", "big.xml"), "the model must be an MJCF file, got .*big.xml"),
    "no package": (
        TOML.replace("small.xml", "no_such_package:small.xml"),
        "model in .*small.toml must be in an installed package, got 'no_such_package:small.xml': there is no "
        "package 'no_such_package'; install it, or name the path of the file \\(a file in a subpackage is "
        "package:folder/file\\)$",
    ),
    "no package name": (TOML.replace("small.xml", "C:small.xml"), "there is no package 'C'; install it"),
    "main": (TOML.replace("small.xml", "__main__:small.xml"), "there is no package '__main__'; install it"),
    "a module": (
        TOML.replace("small.xml", "tomllib.x:small.xml"),
        "there is no package 'tomllib.x'; install it, or",
    ),
    "a long path": (
        TOML.replace("small.xml", "a" * 5000),
        "the model must be an MJCF file, got .*a, which is no",
    ),
    "a path with a zero": (TOML.replace("small.xml", r"a\u0000.xml"), "the model must be an MJCF file, got "),
    "no file of a package": (
        TOML.replace("small.xml", "creps_jax:no.xml"),
        "creps_jax.no.xml, which is no file$",
    ),
    "feet 3": (
        TOML.replace('["left_foot", "right_foot"]', "3"),
        "small.toml: feet must be the names of 2 bodies, the left and the right foot, got 3$",
    ),
    "kp a": (TOML + 'kp = "a"', "small.toml: kp must be a number, got 'a'$"),
    "held a": (TOML + "[held]\nhead = 'a'", "small.toml: held of head must be a number, got 'a'$"),
    "held a number": (TOML + "held = 3", "small.toml: held must be numbers by joint, got 3$"),
    "speeds": (TOML + "speeds = [0.5, 0.1]", r"small.toml: speeds must be two numbers, the lower first, got"),
    "a date": (TOML + "kv = 2026-01-01", "small.toml: kv must be a number, got datetime.date"),
    "name": (TOML + "name = 3", "small.toml: name must be of type str"),
}


@pytest.mark.parametrize("wrong", TOMLS)
def test_a_wrong_description_is_named(wrong, tmp_path):
    text, message = TOMLS[wrong]
    write_model(tmp_path)
    path = tmp_path / "small.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UserError, match=message) as caught:
        spec.humanoid_from_toml(path)
    assert "\n" not in str(caught.value)


def test_a_description_must_be_a_file(tmp_path):
    for path in (tmp_path, tmp_path / "no.toml", str(tmp_path / "no.toml")):
        with pytest.raises(UserError, match="must be described by a TOML file, cannot read") as caught:
            spec.humanoid_from_toml(path)
        message = str(caught.value)
        assert message.count(str(path)) == 1 and "Errno" not in message
    assert message.endswith("no.toml: No such file or directory")
    with pytest.raises(ValueError, match="path must be of type str or Path, got 3"):
        spec.humanoid_from_toml(3)
