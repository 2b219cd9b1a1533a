"""What is measured inside a walk: against the other physics, and where it can be told beforehand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from creps_jax.errors import UserError
from creps_jax.simulation import c
from creps_jax.simulation.models import load_nao
from creps_jax.simulation.state import initial_state
from experiments import walk_inside
from experiments.probe import Measured, Probe


def test_a_probe_steps_as_c_does_and_sees_a_robot_stand():
    model = load_nao()
    stand = jnp.asarray(model.key("stand").qpos, jnp.float32)
    joints = stand[7:]
    probe = Probe()
    states = []
    for make in (probe.make_control_step, c.make_control_step):
        control_step = jax.jit(make(model, 5))
        state = initial_state(stand, model.nv)
        for _ in range(50):
            state = control_step(state, joints, joints, jnp.zeros_like(joints))
        states.append(state)
    np.testing.assert_allclose(states[0].qpos, states[1].qpos, atol=1e-5)
    seen = probe.take()
    assert len(seen.time) == 250
    np.testing.assert_allclose(seen.time[-1], 249 * model.opt.timestep)
    # It stands: the pressure is below the mass, both soles carry it, nothing moves or strains.
    np.testing.assert_allclose(seen.zmp[-1], seen.com[-1, :2], atol=2e-3)
    assert seen.is_loaded[-1].all() and abs(seen.soles[-1, :, 2]).max() < 2e-3
    assert np.linalg.norm(seen.sole_velocity[-1]) < 0.01 and 0 < seen.torque_share[-1] < 0.9
    np.testing.assert_allclose(seen.soles[-1, :, 1], [0.055, -0.055], atol=2e-3)


class StandIn:
    """A walker of made-up walks, in which the bad gait falls with the third key and the good one does not."""

    def __init__(self, settings, balance):
        self.is_good, self.count = balance.placement_gain > 0, 0

    def __call__(self, key, theta):
        self.count += 1
        num = 500 if self.is_good else 250
        time = np.arange(num) * 0.004
        ahead = np.stack([0.5 * time, 0 * time, 0.3 + 0 * time], axis=1)
        soles = np.stack([ahead * [1, 1, 0] + [0, side, 0] for side in (0.05, -0.05)], axis=1)
        soles[:, 0, 2] = 0.03 * np.abs(np.sin(10 * time))
        measured = Measured(
            time=time,
            com=ahead + np.array([0, 0.01, 0]),
            zmp=ahead[:, :2],
            soles=soles,
            sole_velocity=np.ones((num, 2, 3)) * [[[0.1, 0, 0]]],
            is_loaded=np.tile([False, True], (num, 1)),
            joint_pos=np.full((num, 22), np.radians(1.0)),
            set_point=np.zeros((num, 22)),
            torque_share=np.where(time < 0.1, 1.0, 0.5),
            quat=np.tile([1.0, 0, 0, 0], (num, 1)),
        )
        return walk_inside._Walked(measured, fell=not self.is_good and self.count == 3)


def test_two_gaits_are_told_apart_drawn_and_tabled(monkeypatch):
    monkeypatch.setattr(walk_inside, "_Walker", StandIn)
    arrays = walk_inside.run(walk_inside.Settings(duration=2.0), jax.random.key(0))
    assert set(walk_inside.plot(arrays)) == {"inside"}
    table = walk_inside.table(arrays)
    good = dict(zip(table["measured"], table[walk_inside.GAITS["good"]], strict=True))
    assert good["forward, m/s"] == pytest.approx(0.5, rel=0.01)
    assert good["leg joints from their set-points, rms deg"] == pytest.approx(1.0)
    assert good["time with a torque at its limit, %"] == pytest.approx(5.0)
    assert good["loaded sole slides, mm for each m walked"] == pytest.approx(200.0, rel=0.01)
    assert good["swing sole's height, median of its maxima, mm"] == pytest.approx(30.0, rel=0.01)
    bad = dict(zip(table["measured"], table[walk_inside.GAITS["bad"]], strict=True))
    assert bad["upright, s"] == pytest.approx(1.0, rel=0.01)


def test_gaits_that_do_not_differ_are_an_error(monkeypatch):
    monkeypatch.setattr(walk_inside, "_Walker", StandIn)
    with pytest.raises(UserError, match="no seed of 2 tells the gaits apart"):
        walk_inside.run(walk_inside.Settings(duration=2.0, candidates=2), jax.random.key(0))
