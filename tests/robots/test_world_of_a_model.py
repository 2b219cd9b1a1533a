"""The walk of a robot depends on the robot alone: not on the world, options and defaults of its file."""

import mujoco
import numpy as np
import pytest

from creps_jax.robots.mjcf import humanoid_from_mjcf
from tests.robots.small_humanoid import FEET, SPEC, write_model

TRUNK, CHEST, GROUND = '<body name="trunk"', '<geom name="chest"', '<geom name="ground"'
TABLE = (TRUNK, f'<body name="table"><joint name="turn"/><geom name="top" size="1"/></body>{TRUNK}')
TARGET = (TRUNK, f'<body name="target" mocap="true"><site name="aim"/></body>{TRUNK}')
SITES = ((GROUND, f'<site name="hook"/>{GROUND}'), (CHEST, f'<site name="back"/>{CHEST}'))
CYLINDER = (GROUND, f'<geom name="post" type="cylinder" size="0.1 1" pos="2 0 0"/>{GROUND}')
CRANE = '<spatial name="crane" stiffness="100" damping="5"><site site="hook"/><site site="back"/></spatial>'
PARTS_OF_A_MODEL = ("body_", "jnt_", "dof_", "geom_", "actuator_", "eq_", "tendon_", "numeric_")


def before_actuators(text):
    return ("<actuator>", f"{text}<actuator>")


def before_bodies(text):
    return ("<worldbody>", f"{text}<worldbody>")


# What the file of a robot may have beside the robot: replacements in the model.
WORLDS = {
    "weld to the world": [before_actuators('<equality><weld body1="trunk"/></equality>')],
    "weld of the world": [before_actuators('<equality><weld body1="world" body2="skull"/></equality>')],
    "weld to a target": [
        TARGET,
        before_actuators('<equality><weld body1="target" body2="trunk"/></equality>'),
    ],
    "connect to the world": [
        before_actuators('<equality><connect body1="trunk" anchor="0 0 0"/></equality>')
    ],
    "connect sites": [*SITES, before_actuators('<equality><connect site1="back" site2="hook"/></equality>')],
    "weld sites": [*SITES, before_actuators('<equality><weld site1="hook" site2="back"/></equality>')],
    "crane": [*SITES, before_actuators(f"<tendon>{CRANE}</tendon>")],
    "crane with a motor": [
        *SITES,
        before_actuators(f"<tendon>{CRANE}</tendon>"),
        ("<actuator>", '<actuator><motor tendon="crane"/>'),
    ],
    "crane of fixed length": [
        *SITES,
        before_actuators(f'<tendon>{CRANE}</tendon><equality><tendon tendon1="crane"/></equality>'),
    ],
    "rope around a post": [
        CYLINDER,
        (CHEST, f'<site name="back"/><site name="front" pos="0.1 0 0"/>{CHEST}'),
        before_actuators(
            '<tendon><spatial stiffness="9"><site site="back"/><geom geom="post"/><site site="front"/>'
            "</spatial></tendon>"
        ),
    ],
    "table": [
        TABLE,
        before_actuators(
            '<contact><exclude body1="trunk" body2="table"/><pair geom1="chest" geom2="top"/></contact>'
            '<tendon><fixed><joint joint="turn" coef="1"/></fixed></tendon>'
            '<equality><joint joint1="head" joint2="turn"/><weld body1="trunk" body2="table"/></equality>'
        ),
        ("<actuator>", '<actuator><motor joint="turn" ctrlrange="-1 1"/>'),
    ],
    "camera and light at a table": [
        TABLE,
        (GROUND, f'<camera mode="targetbody" target="table"/>{GROUND}'),
        (CHEST, f'<light mode="targetbody" target="table"/>{CHEST}'),
    ],
    "gravity compensation": [
        (TRUNK, f'{TRUNK} gravcomp="1"'),
        ('<body name="skull"', '<body name="skull" gravcomp="1"'),
    ],
    "medium": [before_bodies('<option density="1000" viscosity="0.1" wind="3 0 0"/>')],
    "switched off": [before_bodies('<option actuatorgroupdisable="0 3"><flag gravity="disable"/></option>')],
    "gravity": [before_bodies('<option gravity="0 0 -1.6" magnetic="1 0 0"/>')],
    "solver": [
        before_bodies(
            '<option timestep="0.001" impratio="10" noslip_iterations="3" tolerance="1e-3" jacobian="sparse" '
            'cone="elliptic" solver="CG" ccd_iterations="9" ls_tolerance="0.1" integrator="RK4"/>'
        )
    ],
    "contacts overridden": [
        before_bodies('<option o_margin="0.1" o_solref="0.1 1"><flag override="enable"/></option>')
    ],
    "number of contacts limited": [
        before_bodies('<custom><numeric name="max_contact_points" data="2"/></custom>')
    ],
}
# Properties of the file that a robot has anyhow: replacements, and others that mean the same.
SHELL = ('type="sphere" size="0.04" mass="0.3"', 'type="mesh" mesh="foot" name="shell" mass="0.3"')
COVER = (CHEST, f'<geom type="mesh" mesh="foot" mass="0.4"/>{CHEST}')
STRAP = '<body{}><geom type="box" size="0.01 0.01 0.01" mass="0.5" pos="0.05 0 0.05"/></body>'
TOES = '<body{} pos="0.1 0 -0.03"><geom type="box" size="0.02 0.04 0.01" mass="0.05"/></body>'
SOLES = [FEET["box"].format(side=side, y=y) for side, y in (("left", 0.005), ("right", -0.005))]


def with_toes(*names):
    """Add a strap to the chest, and toes to the feet, each a body of its own."""
    toes = ((sole, sole + TOES.format(name)) for sole, name in zip(SOLES, names[1:], strict=True))
    return [(CHEST, STRAP.format(names[0]) + CHEST), *toes]


NAMED = with_toes(' name="strap"', ' name="left_toes"', ' name="right_toes"')
MEANINGS = {
    "bodies without names": (with_toes("", "", ""), NAMED),
    "static bodies fused": ([*NAMED, ("<compiler ", '<compiler fusestatic="true" ')], NAMED),
    "static bodies without names fused": (
        [*with_toes("", "", ""), ("<compiler ", '<compiler fusestatic="true" ')],
        NAMED,
    ),
    "masses from geoms": ([COVER, ("<compiler ", '<compiler inertiafromgeom="true" ')], [COVER]),
    "a contact of a mesh": (
        [SHELL, before_actuators('<contact><pair geom1="shell" geom2="ground"/></contact>')],
        [SHELL],
    ),
}
# Defaults of the file: they must change neither the servos nor the floor.
DEFAULTS = {
    "motors": '<motor gear="5" group="3"/>',
    "activation": '<general dyntype="filter" dynprm="0.1" gear="3"/>',
    "geoms": '<geom condim="1" group="3" priority="3" margin="0.05" solref="0.1 1" rgba="1 0 0 0"/>',
    "drawing": '<light diffuse="0 0 0"/><material rgba="1 0 0 0"/>',
}


def read(folder, replacements=()):
    return humanoid_from_mjcf(write_model(folder, *replacements), **SPEC)


def assert_same(model, expected):
    """Check that two models have equal parts and options; unlike parts their sites and lights may differ."""
    for ours, theirs, starts in ((model, expected, PARTS_OF_A_MODEL), (model.opt, expected.opt, ("",))):
        for field in dir(theirs):
            value = getattr(theirs, field)
            if (
                field.startswith(starts)
                and not field.startswith("_")
                and isinstance(value, np.ndarray | int | float)
            ):
                np.testing.assert_array_equal(getattr(ours, field), value, err_msg=field)


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return read(tmp_path_factory.mktemp("small"))


@pytest.mark.parametrize("world", WORLDS)
def test_the_world_and_the_options_of_the_file_do_not_act_on_the_robot(world, robot, tmp_path):
    other = read(tmp_path, WORLDS[world])
    assert_same(other.model, robot.model)
    assert_same(other.film_model, robot.film_model)
    assert other.posture == robot.posture


@pytest.mark.parametrize("meaning", MEANINGS)
def test_a_robot_that_is_written_in_another_way_is_the_same(meaning, tmp_path):
    written, expected = (read(tmp_path, changes) for changes in MEANINGS[meaning])
    assert_same(written.model, expected.model)
    assert written.posture == expected.posture and written.foot_spacing == expected.foot_spacing


@pytest.mark.parametrize("default", DEFAULTS)
def test_defaults_of_the_file_change_neither_servos_nor_floor(default, robot, tmp_path):
    other = read(tmp_path, [before_bodies(f"<default>{DEFAULTS[default]}</default>")])
    for ours, theirs in ((other.model, robot.model), (other.film_model, robot.film_model)):
        floor = theirs.geom("creps_jax_floor").id
        for field in dir(theirs):
            value = getattr(theirs, field)
            if not isinstance(value, np.ndarray) or field in ("geom_contype", "geom_conaffinity"):
                continue
            if field.startswith("geom_"):
                np.testing.assert_array_equal(getattr(ours, field)[floor], value[floor], err_msg=field)
            elif field.startswith(
                (
                    "actuator_gear",
                    "actuator_gain",
                    "actuator_bias",
                    "actuator_dyn",
                    "actuator_group",
                    "light_",
                    "mat_",
                )
            ):
                np.testing.assert_array_equal(getattr(ours, field), value, err_msg=field)


def test_the_mass_of_a_missing_mesh_is_named_although_the_body_states_one(tmp_path):
    changes = [
        ("<asset>", '<asset><mesh name="shell" file="missing.stl"/>'),
        ("<compiler ", '<compiler inertiafromgeom="true" '),
        (
            'type="sphere" size="0.04" mass="0.3"/>',
            'type="mesh" mesh="shell"/><inertial pos="0 0 0" mass="0.3" diaginertia="0.1 0.1 0.1"/>',
        ),
    ]
    with pytest.raises(ValueError, match="the mass of the body 'skull' must be stated in the model"):
        read(tmp_path, changes)
    read(tmp_path, [changes[0], changes[2]])


def test_couplings_within_the_robot_are_kept(tmp_path):
    robot = read(
        tmp_path,
        [
            before_actuators(
                '<tendon><fixed name="both"><joint joint="left_shoulder" coef="1"/>'
                '<joint joint="right_shoulder" coef="1"/></fixed></tendon>'
                '<equality><joint joint1="head" joint2="left_shoulder"/><weld body1="skull" body2="trunk"/>'
                '<tendon tendon1="both"/></equality>'
            )
        ],
    )
    assert robot.model.ntendon == 1 and robot.model.neq == 3
    kinds = [mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_WELD, mujoco.mjtEq.mjEQ_TENDON]
    assert robot.model.eq_type.tolist() == [int(kind) for kind in kinds]


def test_a_coupling_of_a_joint_that_has_the_name_of_a_tendon_of_the_world_is_kept(tmp_path):
    tendon = CRANE.replace('name="crane"', 'name="head"')
    assert tendon != CRANE
    coupling = '<equality><joint joint1="head" joint2="left_shoulder"/></equality>'
    robot = read(tmp_path, [*SITES, before_actuators(f"<tendon>{tendon}</tendon>{coupling}")])
    assert robot.model.ntendon == 0 and robot.model.neq == 1
