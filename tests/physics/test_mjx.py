"""MJX steps the robot as C MuJoCo does."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from creps_jax.physics.mjx import initial_state, make_control_step
from creps_jax.tasks.nao_walk import load_nao
from tests.oracles.walk_c import servo_step


@pytest.fixture(scope="module")
def model():
    return load_nao()


@pytest.mark.usefixtures("relaxed_promotion")
def test_one_control_step_equals_c():
    rng = np.random.default_rng(0)
    # Enough iterations for both to converge: what is compared is the physics, not the rounding of the solver.
    model = load_nao()
    model.opt.iterations, model.opt.ls_iterations = 30, 30
    control_step = jax.jit(jax.vmap(make_control_step(model, 5)))
    num = 8
    qpos = np.tile(model.key("stand").qpos, (num, 1))
    qpos[:, 2] += rng.uniform(0.0, 0.003, num)
    qpos[:, 7:] += 0.02 * rng.standard_normal((num, model.nu))
    before = qpos[:, 7:].copy()
    # No torque reaches its limit: there C leaves the servo out of the implicit step, and MJX does not.
    after = before + 0.02 * rng.standard_normal(before.shape)
    states = jax.vmap(lambda q: initial_state(q, model.nv))(jnp.asarray(qpos, jnp.float32))
    ours = control_step(states, jnp.asarray(before, jnp.float32), jnp.asarray(after, jnp.float32))
    for i in range(num):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos[i]
        servo_step(model, data, before[i], after[i])
        np.testing.assert_allclose(ours.qpos[i], data.qpos, atol=2e-6)
        np.testing.assert_allclose(ours.qvel[i], data.qvel, atol=2e-4)


def test_no_substep_is_an_error(model):
    with pytest.raises(ValueError, match="at least 1, got 0"):
        make_control_step(model, 0)


def test_a_motor_that_is_no_servo_is_an_error():
    spec = mujoco.MjSpec.from_string(
        """<mujoco><worldbody><body><joint name="hinge"/><geom size=".1"/></body></worldbody>
        <actuator><motor name="bare" joint="hinge"/></actuator></mujoco>"""
    )
    with pytest.raises(ValueError, match="bare"):
        make_control_step(spec.compile(), 4)
