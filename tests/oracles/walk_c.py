"""Walk the NAO in C MuJoCo, with a loop of its own around the same walker."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from creps_jax.walking.gaits import AHEAD, straight_walker
from creps_jax.walking.posture import Balance

CONTROL_PERIOD = 0.02
BALANCE = Balance(heading_gain=0.3, placement_gain=0.6)


def _walker(theta):
    return straight_walker(theta, period=CONTROL_PERIOD, balance=BALANCE)


@jax.jit
def _next(theta, state, measured):
    return _walker(theta).step(state, jnp.array(AHEAD), measured)


def servo_step(model, data, before, after, speed):
    """Move the set-points evenly through one control step, and tell the servos a speed."""
    substeps = round(CONTROL_PERIOD / model.opt.timestep)
    lead = -model.actuator_biasprm[:, 2] / model.actuator_gainprm[:, 0] * speed
    for k in range(1, substeps + 1):
        data.ctrl[:] = before + k / substeps * (after - before) + lead
        mujoco.mj_step(model, data)


def lean_of(quat):
    """Return roll, pitch and yaw of a wxyz quaternion."""
    w, x, y, z = quat
    return np.array(
        [
            np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            np.arcsin(np.clip(2 * (w * y - z * x), -1, 1)),
            np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        ]
    )


def walk(model, qpos, theta, *, duration, noise, seed):
    """Walk from a position; return forward speed after 2 s and whether the robot fell."""
    rng = np.random.default_rng(seed)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    data.qpos[7:] += noise * rng.standard_normal(model.nu)
    state, set_point, start_x = _walker(theta).start(), np.array(qpos[7:], float), 0.0
    miss = np.zeros(model.nu)
    for tick in range(round(duration / CONTROL_PERIOD)):
        measured = lean_of(data.qpos[3:7]) + noise * rng.standard_normal(3)
        state, target = _next(theta, state, measured.astype(np.float32))
        target = np.asarray(target, float)
        next_miss = noise * rng.standard_normal(model.nu)
        speed = (target - set_point) / CONTROL_PERIOD
        servo_step(model, data, set_point + miss, target + next_miss, speed)
        set_point, miss = target, next_miss
        if tick == round(2.0 / CONTROL_PERIOD) - 1:
            start_x = data.qpos[0]
        if data.qpos[2] < 0.2:
            return 0.0, True
    return (data.qpos[0] - start_x) / (duration - 2.0), False
