"""Either physics steps the robot as a plain loop around C MuJoCo does."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from creps_jax.robots.robot import NAO, NAO_H25
from creps_jax.rollouts import share_rows
from creps_jax.simulation import c, mjx
from creps_jax.simulation.models import load_nao
from creps_jax.simulation.state import initial_state
from creps_jax.simulation.world import World, world_of
from tests.oracles.walk_c import servo_step

PHYSICS = {"mjx": mjx.make_control_step, "c": c.make_control_step}


@pytest.fixture(params=PHYSICS)
def make_control_step(request):
    return PHYSICS[request.param]


@pytest.fixture(scope="module")
def model():
    return load_nao()


NUM = 8


@pytest.fixture(scope="module")
def exact_model():
    # Enough iterations for both to converge: what is compared is the physics, not the rounding of the solver.
    model = load_nao()
    model.opt.iterations, model.opt.ls_iterations = 30, 30
    return model


@pytest.fixture(scope="module", params=PHYSICS)
def control_step(request, exact_model):
    return jax.jit(jax.vmap(PHYSICS[request.param](exact_model, 5)))


def starts(model, change):
    """Return positions (n, nq), and set-points before and after and their speeds (n, nu)."""
    rng = np.random.default_rng(0)
    qpos = np.tile(model.key("stand").qpos, (NUM, 1))
    qpos[:, 2] += rng.uniform(0.0, 0.003, NUM)
    qpos[:, 7:] += 0.02 * rng.standard_normal((NUM, model.nu))
    before = qpos[:, 7:].copy()
    after = before + change * rng.standard_normal(before.shape)
    return qpos, (before, after, (after - before) / 0.02)


def stepped(control_step, model, qpos, commands, *world):
    states = jax.vmap(lambda q: initial_state(q, model.nv))(jnp.asarray(qpos, jnp.float32))
    return control_step(states, *(jnp.asarray(x, jnp.float32) for x in commands), *world)


def stepped_by_c(model, qpos, commands):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    servo_step(model, data, *commands)
    return data


@pytest.mark.usefixtures("relaxed_promotion")
@pytest.mark.parametrize(("change", "saturates"), [(0.02, False), (0.12, True)])
def test_one_control_step_equals_c(control_step, exact_model, change, saturates):
    qpos, commands = starts(exact_model, change)
    # In the model's own world: MJX compiles long, and one program does for both tests. Without a world
    # either physics walks in the tests of the walking task.
    own = jax.tree.map(lambda x: jnp.tile(jnp.float32(x), (NUM,) + (1,) * jnp.ndim(x)), world_of(exact_model))
    ours = stepped(control_step, exact_model, qpos, commands, own)
    saturated = 0
    for i in range(NUM):
        data = stepped_by_c(exact_model, qpos[i], [x[i] for x in commands])
        np.testing.assert_allclose(ours.qpos[i], data.qpos, atol=2e-6)
        np.testing.assert_allclose(ours.qvel[i], data.qvel, atol=2e-4)
        saturated += np.sum(np.abs(data.actuator_force) >= exact_model.actuator_forcerange[:, 1])
    # A torque at its limit is left out of the implicit step.
    assert (saturated > 0) == saturates


@pytest.mark.parametrize("robot", [NAO, NAO_H25], ids=lambda robot: robot.name)
def test_what_c_leaves_out_changes_nothing(robot):
    model = load_nao(robot)
    qpos = np.float32(starts(model, 0.0)[0])
    commands = qpos[:, 7:], qpos[:, 7:], np.zeros((NUM, model.nu), np.float32)
    ours = stepped(jax.jit(jax.vmap(c.make_control_step(model, 5))), model, qpos, commands)
    assert model.nsensor and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ISLAND
    for i in range(NUM):
        data = stepped_by_c(model, qpos[i], [x[i] for x in commands])
        assert data.nisland == 1
        np.testing.assert_array_equal(ours.qpos[i], np.float32(data.qpos))
        np.testing.assert_array_equal(ours.qvel[i], np.float32(data.qvel))


@pytest.mark.usefixtures("relaxed_promotion")
def test_a_control_step_in_a_world_of_its_own_equals_c_with_another_model(control_step, exact_model):
    rng = np.random.default_rng(1)
    qpos, commands = starts(exact_model, 0.06)
    gravity = np.array([-2.0, 1.0, -9.0]) + rng.uniform(-1.0, 1.0, (NUM, 3))
    payload, friction = rng.uniform(0.5, 2.0, NUM), rng.uniform(0.1, 0.3, NUM)
    world = World(*(jnp.asarray(x, jnp.float32) for x in (gravity, payload, friction)))
    ours = stepped(control_step, exact_model, qpos, commands, world)

    def there(i, changes):
        model = copy.copy(exact_model)
        if "gravity" in changes:
            model.opt.gravity[:] = gravity[i]
        if "payload" in changes:
            model.body("torso").mass += payload[i]
        if "friction" in changes:
            model.geom_friction[:, 0] *= friction[i]
        return stepped_by_c(model, qpos[i], [x[i] for x in commands])

    names = {"gravity", "payload", "friction"}
    for i in range(NUM):
        data = there(i, names)
        np.testing.assert_allclose(ours.qpos[i], data.qpos, atol=1e-5)
        np.testing.assert_allclose(ours.qvel[i], data.qvel, atol=1e-3)
    # Each of the three counts.
    for name in names:
        assert np.abs(there(0, names - {name}).qvel - there(0, names).qvel).max() > 0.02, name


@pytest.mark.usefixtures("relaxed_promotion")
def test_numbers_of_a_world_may_stay_plain(make_control_step, model):
    control_step = make_control_step(model, 5)
    state, joints = initial_state(jnp.zeros(model.nq), model.nv), jnp.zeros(model.nu)
    moved = jax.eval_shape(lambda g: control_step(state, joints, joints, joints, World(g)), jnp.zeros(3))
    assert moved.qpos.shape == (model.nq,)


def test_no_substep_is_an_error(make_control_step, model):
    with pytest.raises(ValueError, match="at least 1, got 0"):
        make_control_step(model, 0)


HINGE = """<mujoco><option integrator="implicitfast" {option}/><worldbody><body><joint name="hinge"/>
<geom size="0.1"/><site name="site"/></body></worldbody><actuator>{actuator}</actuator></mujoco>"""


@pytest.mark.parametrize(
    "actuator",
    [
        '<motor name="bad" joint="hinge"/>',
        '<position name="bad" site="site"/>',
        '<position name="bad" joint="hinge" timeconst="0.1"/>',
        '<position name="bad" joint="hinge" gear="2"/>',
    ],
)
def test_an_actuator_that_is_no_plain_servo_is_an_error(make_control_step, actuator):
    with pytest.raises(ValueError, match="bad"):
        make_control_step(mujoco.MjModel.from_xml_string(HINGE.format(option="", actuator=actuator)), 4)


@pytest.mark.parametrize(
    ("option", "match"),
    [('solver="CG"', "solver must be mjSOL_NEWTON, got mjSOL_CG"), ('integrator="Euler"', "got mjINT_EULER")],
)
def test_another_solver_or_integrator_is_an_error(option, match):
    xml = HINGE.format(option=option, actuator='<position name="a" joint="hinge"/>')
    if "integrator" in option:
        xml = xml.replace('integrator="implicitfast" ', "")
    with pytest.raises(ValueError, match=match):
        mjx.make_control_step(mujoco.MjModel.from_xml_string(xml), 4)


def test_c_steps_a_batch_of_any_shape_from_any_state(model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # C writes its log there.
    control_step = c.make_control_step(model, 5)
    still = jnp.zeros(model.nu)
    state = initial_state(jnp.asarray(model.key("stand").qpos, jnp.float32), model.nv)
    alone = jax.jit(control_step)(state, still, still, still)
    # The set-points of a batch, shared or not, are those of its robots.
    states = jax.tree.map(lambda x: jnp.tile(x, (2, 3, 1)), state)
    batch = jax.vmap(jax.vmap(control_step, (0, None, None, None)), (0, None, None, None))
    moved = jax.jit(batch)(states, still, still, still)
    assert moved.qpos.shape == (2, 3, model.nq)
    np.testing.assert_array_equal(moved.qpos[1, 2], alone.qpos)
    nobody = jax.tree.map(lambda x: x[:0], states)
    assert jax.jit(batch)(nobody, still, still, still).qpos.shape == (0, 3, model.nq)
    # The model's own world is none, but for gravity in single precision.
    own = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), world_of(model))
    moved = jax.jit(control_step)(state, still, still, still, own)
    np.testing.assert_allclose(moved.qpos, alone.qpos, atol=1e-5)
    # One robot that is lost does not take the others with it.
    lost = states._replace(qpos=states.qpos.at[0, 0].set(jnp.nan))
    moved = jax.jit(batch)(lost, still, still, still)
    np.testing.assert_array_equal(moved.qpos[1, 2], alone.qpos)
    assert jnp.isnan(moved.qpos[0, 0]).all()
    for speed in (1e7, 1e12, 1e30):
        wild = states._replace(qvel=states.qvel.at[0, 0].set(speed))
        moved = jax.jit(batch)(wild, still, still, still)
        assert jnp.isnan(moved.qpos[0, 0]).all()
        np.testing.assert_array_equal(moved.qpos[1, 2], alone.qpos)
    commands = jnp.zeros((3, model.nu)).at[1, 0].set(jnp.nan)
    one_row = jax.tree.map(lambda x: x[0], states)
    moved = jax.jit(jax.vmap(control_step))(one_row, commands, commands, commands)
    assert jnp.isnan(moved.qpos).all(axis=1).tolist() == [False, True, False]


def test_devices_step_large_batches_by_c_at_the_same_time():
    # Through `jax.pure_callback` this waits for ever on jax 0.9.
    model = mujoco.MjModel.from_xml_string(HINGE.format(option="", actuator='<position joint="hinge"/>'))
    control_step = c.make_control_step(model, 1)
    still = jnp.zeros(1)

    def swing(angle):
        start = initial_state(angle, 1)
        return jax.lax.fori_loop(0, 20, lambda _, state: control_step(state, still, still, still), start).qpos

    assert len(jax.devices()) == 2
    angles = jnp.linspace(-1.0, 1.0, 20_000)[:, None]
    ends = jax.jit(share_rows(jax.vmap(swing), tuple(jax.devices())))(angles)
    np.testing.assert_array_equal(ends, jax.jit(jax.vmap(swing))(angles))
    assert np.unique(ends).size > 10_000


def test_other_devices_than_a_cpu_call_c_with_the_same_numbers(model, monkeypatch):
    still = jnp.zeros((3, model.nu))
    qpos = jnp.asarray(starts(model, 0.0)[0][:3], jnp.float32)
    states = jax.vmap(lambda q: initial_state(q, model.nv))(qpos)
    here = jax.jit(jax.vmap(c.make_control_step(model, 5)))(states, still, still, still)
    monkeypatch.setattr(c.lax, "platform_dependent", lambda packed, *, cpu, default: default(packed))
    there = jax.jit(jax.vmap(c.make_control_step(model, 5)))(states, still, still, still)
    jax.tree.map(np.testing.assert_array_equal, there, here)
