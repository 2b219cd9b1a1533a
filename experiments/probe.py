"""Measure contact, torques, soles and joints of a walk by C MuJoCo, at every physics step."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental import io_callback

from creps_jax.robots.nao_geometry import NUM_JOINTS
from creps_jax.simulation.servos import read_servos
from creps_jax.simulation.state import ControlStep, RobotState, substep_shares

SOLES = ("left_sole", "right_sole")


class Measured(NamedTuple):
    """Measurements of a walk (leading axis n physics steps), in the world frame, in m, s, rad and N m.

    Attributes:
        time: time since the first step.
        com: centre of mass.
        zmp: centre of pressure of both soles together; NaN if none touches the floor.
        soles: positions of the left and the right sole, below the ankle.
        sole_velocity: velocities of the soles.
        is_loaded: whether each sole carries weight.
        joint_pos: positions of the joints.
        set_point: set-points of their servos, with the noise.
        torque_share: largest torque of a leg's servo, divided by its limit.
        quat: orientation of the torso, wxyz.
    """

    time: np.ndarray
    com: np.ndarray
    zmp: np.ndarray
    soles: np.ndarray
    sole_velocity: np.ndarray
    is_loaded: np.ndarray
    joint_pos: np.ndarray
    set_point: np.ndarray
    torque_share: np.ndarray
    quat: np.ndarray


class Probe:
    """A physics for one robot that records measurements, for `record_walk`."""

    def __init__(self) -> None:
        self._rows: list[Measured] = []

    def take(self) -> Measured:
        """Return the measurements since the last call."""
        jax.effects_barrier()
        rows, self._rows = self._rows, []
        measured = Measured(*(np.stack(column) for column in zip(*rows, strict=True)))
        return measured._replace(time=measured.time - measured.time[0])

    def make_control_step(self, model: mujoco.MjModel, num_substeps: int) -> ControlStep:
        """Return a control step like `creps_jax.simulation.c`, of single steps; it cannot be vmapped."""
        shares, servos = substep_shares(num_substeps), read_servos(model)
        data = mujoco.MjData(model)

        def step(qpos, qvel, warmstart, before, after, speed):
            data.qpos, data.qvel, data.qacc_warmstart = qpos, qvel, warmstart
            # NumPy arrays: jax must not be called in a callback.
            before, after, speed = (np.asarray(x) for x in (before, after, speed))
            ahead = servos.lead * speed
            for control in servos.controls(shares, before, after, speed):
                data.ctrl = control
                mujoco.mj_step(model, data)
                self._rows.append(_measure(model, data, np.asarray(control - ahead)))
            return [np.float32(x) for x in (data.qpos, data.qvel, data.qacc_warmstart)]

        def control_step(state, before, after, speed):
            shapes = [jax.ShapeDtypeStruct(leaf.shape, jnp.float32) for leaf in state]
            return RobotState(*io_callback(step, shapes, *state, before, after, speed, ordered=True))

        return control_step


def _measure(model: mujoco.MjModel, data: mujoco.MjData, set_point: np.ndarray) -> Measured:
    """Measure after a step: positions at its end, forces during it."""
    sites = [model.site(name) for name in SOLES]
    pressure, moment, loads = 0.0, np.zeros(2), np.zeros(len(SOLES))
    force = np.zeros(6)
    for index, contact in enumerate(data.contact):
        mujoco.mj_contactForce(model, data, index, force)
        load = force[0]
        pressure += load
        moment += load * contact.pos[:2]
        bodies = model.geom_bodyid[list(contact.geom)]
        loads += [load * (site.bodyid[0] in bodies) for site in sites]
    velocity, spatial = np.zeros((len(SOLES), 3)), np.zeros(6)
    for row, site in enumerate(sites):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, site.id, spatial, 0)
        velocity[row] = spatial[3:]
    legs = slice(-12, None)
    limits = model.actuator_forcerange[legs, 1]
    return Measured(
        time=np.array(data.time),
        com=data.subtree_com[1].copy(),
        zmp=moment / pressure if pressure > 0 else np.full(2, np.nan),
        soles=np.stack([data.site_xpos[site.id] for site in sites]),
        sole_velocity=velocity,
        is_loaded=loads > 0,
        joint_pos=data.qpos[-NUM_JOINTS:].copy(),
        set_point=set_point,
        torque_share=np.max(np.abs(data.actuator_force[legs]) / limits),
        quat=data.qpos[3:7].copy(),
    )
