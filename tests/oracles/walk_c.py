"""Walk the NAO in C MuJoCo, with a loop of its own around the same engine."""

import jax
import mujoco
import numpy as np

from creps_jax.robots.nao_geometry import MAX_JOINT_SPEED
from creps_jax.walking.engine import joint_targets, plan_walk
from creps_jax.walking.params import params_from_theta
from creps_jax.walking.posture import Balance

CONTROL_PERIOD = 0.02
NUM_STEPS = 60
BALANCE = Balance(heading_gain=0.3, placement_gain=0.6)


@jax.jit
def _targets(theta, time, measured):
    params = params_from_theta(theta)
    return joint_targets(params, plan_walk(params, NUM_STEPS), time, measured, balance=BALANCE)


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
    set_point, start_x = np.array(qpos[7:], float), 0.0
    miss = np.zeros(model.nu)
    for tick in range(round(duration / CONTROL_PERIOD)):
        measured = lean_of(data.qpos[3:7]) + noise * rng.standard_normal(3)
        time = np.float32((tick + 1) * CONTROL_PERIOD)
        target = np.asarray(_targets(theta, time, measured.astype(np.float32)), float)
        slew = MAX_JOINT_SPEED * CONTROL_PERIOD
        target = set_point + np.clip(target - set_point, -slew, slew)
        next_miss = noise * rng.standard_normal(model.nu)
        speed = (target - set_point) / CONTROL_PERIOD
        servo_step(model, data, set_point + miss, target + next_miss, speed)
        set_point, miss = target, next_miss
        if tick == round(2.0 / CONTROL_PERIOD) - 1:
            start_x = data.qpos[0]
        if data.qpos[2] < 0.2:
            return 0.0, True
    return (data.qpos[0] - start_x) / (duration - 2.0), False
