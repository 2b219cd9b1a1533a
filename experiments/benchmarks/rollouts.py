"""Compare the speed of walking rollouts: all devices, one device, bare C MuJoCo at the same setting.

    python -m experiments.benchmarks.rollouts

Each round runs all contestants in turn; the ratios are medians over the rounds. Our rollouts have the
controller in the loop. Bare C MuJoCo replays the recorded set-points of the servos of as many walks, with
their noise (without noise the solver has less work), by `mujoco.rollout` with one thread for each core. "no
extras" is without sensors and islands, which our physics by C does not compute either. The ratio of all
threads to one thread shows how the machine itself scales: cores of one chip slow down when all are busy. The
batch has the size of an iteration of the preset `quick`.
"""

import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from jax.experimental import io_callback

from creps_jax.simulation import c, mjx
from creps_jax.simulation.models import load_nao
from creps_jax.simulation.servos import read_servos
from creps_jax.simulation.state import ControlStep, Physics, substep_shares
from creps_jax.tasks import Task
from creps_jax.tasks.closed_loop import CONTROL_PERIOD
from creps_jax.tasks.walking import nao_walk, record_walk
from creps_jax.tools.process import usable_cores
from creps_jax.training import evaluate
from experiments.walking.settings import SETTINGS

_QUICK = SETTINGS["quick"]
BATCH = _QUICK.trials * _QUICK.samples * _QUICK.repeats
DURATION = 2.0
ROUNDS = 5
# A gait of about 0.33 m/s.
THETA = (0.001, 0.176, 0.039, 0.224, 3.2, 0.46, 0.31, 0.074, 0.038, 0.11)
BALANCE = SETTINGS["best"].balance()


def main() -> None:
    """Measure and print."""
    model, no_extras, cores = load_nao(), load_nao(), usable_cores()
    no_extras.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR | mujoco.mjtDisableBit.mjDSBL_ISLAND
    contestants = {
        "all devices": _ours(jax.devices()),
        "one device": _ours(jax.devices()[:1]),
        "all, stepped by C": _ours(jax.devices(), c.make_control_step),
        "C MuJoCo": _bare_c(model, cores),
        "C, no extras": _bare_c(no_extras, cores),
        "C, one thread": _bare_c(model, 1),
    }
    for run in contestants.values():
        run()
    steps = BATCH * round(DURATION / model.opt.timestep)
    rates = {name: [] for name in contestants}
    for _ in range(ROUNDS):
        for name, run in contestants.items():
            begin = time.perf_counter()
            run()
            rates[name].append(steps / (time.perf_counter() - begin))
    print(f"{cores} cores, {jax.device_count()} devices, batch {BATCH}, {ROUNDS} rounds")
    print("physics steps a second, median (least to most):")
    for name, values in rates.items():
        print(f"  {name:18} {np.median(values):10,.0f}   ({min(values):,.0f} to {max(values):,.0f})")
    for one, other in (
        ("all devices", "one device"),
        ("all devices", "C MuJoCo"),
        ("all, stepped by C", "C MuJoCo"),
        ("all, stepped by C", "C, no extras"),
        ("all, stepped by C", "one device"),
        ("C MuJoCo", "C, one thread"),
    ):
        print(f"{one} / {other}: {np.median(np.divide(rates[one], rates[other])):.2f}")


def walking_batch(size: int, duration: float, physics: Physics) -> tuple[Task, jax.Array, jax.Array]:
    """Return the walking task with episodes of this duration, s, and contexts and parameters of a batch."""
    task = nao_walk(duration=duration, start_up=duration / 4, balance=BALANCE, physics=physics)
    return task, jnp.full((size, 1), 0.3), jnp.tile(jnp.array(THETA), (size, 1))


def _ours(devices: list[jax.Device], physics: Physics = mjx.make_control_step) -> Callable[[], None]:
    task, contexts, thetas = walking_batch(BATCH, DURATION, physics)

    def run() -> None:
        jax.block_until_ready(evaluate(jax.random.key(0), task, contexts, thetas, devices=devices))

    return run


def _bare_c(model: mujoco.MjModel, threads: int) -> Callable[[], None]:
    start, inputs = _recorded()
    data = [mujoco.MjData(model) for _ in range(threads)]
    states = np.concatenate([np.zeros((BATCH, 1)), start, np.zeros((BATCH, model.nv))], axis=1)
    shares = substep_shares(round(CONTROL_PERIOD / model.opt.timestep))
    before, after, speed = np.split(inputs, 3, axis=-1)
    controls = read_servos(model).controls(shares, before, after, speed).reshape(BATCH, -1, model.nu)

    def run() -> None:
        mujoco.rollout.rollout(model, data, states, controls)

    return run


@functools.cache
def _recorded() -> tuple[np.ndarray, np.ndarray]:
    """Walk, and record first positions (BATCH, nq) and inputs of the servos (BATCH, ticks, 3 nu)."""
    rows_seen = []

    def recording(model: mujoco.MjModel, num_substeps: int) -> ControlStep:
        step = c.make_control_step(model, num_substeps)

        def control_step(robot, before, after, speed):
            row = jnp.concatenate([robot.qpos, before, after, speed])
            io_callback(lambda row: rows_seen.append(np.array(row)), None, row, ordered=True)
            return step(robot, before, after, speed)

        return control_step

    def walk(key: jax.Array) -> jax.Array:
        theta = jnp.array(THETA)
        return record_walk(key, theta, duration=DURATION, balance=BALANCE, physics=recording).has_fallen.any()

    # One robot after the other, so that rows are recorded in order; ordered callbacks need one device.
    with jax.default_device(jax.devices()[0]):
        keys = jax.random.split(jax.random.key(0), BATCH)
        fell = jax.jit(lambda keys: jax.lax.map(walk, keys))(keys)
        jax.effects_barrier()
    if fell.any():
        raise RuntimeError(f"robots of the benchmark must not fall, but {int(fell.sum())} of {BATCH} did")
    rows = np.stack(rows_seen).reshape(BATCH, round(DURATION / CONTROL_PERIOD), -1)
    qpos, inputs = np.split(rows, [load_nao().nq], axis=-1)
    return qpos[:, 0], inputs


if __name__ == "__main__":
    main()
