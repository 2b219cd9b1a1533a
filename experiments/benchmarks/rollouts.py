"""Compare the speed of walking rollouts: all devices, one device, bare C MuJoCo at the same setting.

    python -m experiments.benchmarks.rollouts

Each round runs all in turn; the ratios are medians over the rounds. Ours have the controller in the loop; C
MuJoCo replays what it told the servos in as many such walks, noise and all (without noise the solver has less
to do), with `mujoco.rollout`, one thread a core, whole walks at once. It does so with the model as it is, and
without what ours leaves out by C: the sensors, and islands, of which one robot is one. What C gains from all
threads over one tells how far this machine scales at all: cores that share a chip with others slow down when
all are busy. As many walk at once as in an iteration of the preset `quick`.
"""

from creps_jax.tools.process import import_mjx_quietly, prepare, usable_cores

prepare()
import_mjx_quietly()

import functools  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import mujoco  # noqa: E402
import mujoco.rollout  # noqa: E402
import numpy as np  # noqa: E402
from jax.experimental import io_callback  # noqa: E402

from creps_jax.simulation import c, mjx  # noqa: E402
from creps_jax.simulation.models import load_nao  # noqa: E402
from creps_jax.simulation.servos import read_servos  # noqa: E402
from creps_jax.simulation.state import ControlStep, substep_shares  # noqa: E402
from creps_jax.tasks import Task  # noqa: E402
from creps_jax.tasks.walking import CONTROL_PERIOD, Physics, nao_walk, record_walk  # noqa: E402
from creps_jax.training import evaluate  # noqa: E402
from experiments.walk import SETTINGS  # noqa: E402

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
    start, told = _told()
    data = [mujoco.MjData(model) for _ in range(threads)]
    states = np.concatenate([np.zeros((BATCH, 1)), start, np.zeros((BATCH, model.nv))], axis=1)
    shares = substep_shares(round(CONTROL_PERIOD / model.opt.timestep))
    before, after, speed = np.split(told, 3, axis=-1)
    controls = read_servos(model).controls(shares, before, after, speed).reshape(BATCH, -1, model.nu)

    def run() -> None:
        mujoco.rollout.rollout(model, data, states, controls)

    return run


@functools.cache
def _told() -> tuple[np.ndarray, np.ndarray]:
    """Walk, and note where each robot starts (BATCH, nq) and what servos are told (BATCH, ticks, 3 nu)."""
    noted = []

    def noting(model: mujoco.MjModel, num_substeps: int) -> ControlStep:
        step = c.make_control_step(model, num_substeps)

        def control_step(robot, before, after, speed):
            row = jnp.concatenate([robot.qpos, before, after, speed])
            io_callback(lambda row: noted.append(np.array(row)), None, row, ordered=True)
            return step(robot, before, after, speed)

        return control_step

    def walk(key: jax.Array) -> jax.Array:
        theta = jnp.array(THETA)
        return record_walk(key, theta, duration=DURATION, balance=BALANCE, physics=noting).has_fallen.any()

    # One robot after the other: what is noted is in order. One device, as ordered callbacks want it.
    with jax.default_device(jax.devices()[0]):
        keys = jax.random.split(jax.random.key(0), BATCH)
        fell = jax.jit(lambda keys: jax.lax.map(walk, keys))(keys)
        jax.effects_barrier()
    if fell.any():
        raise RuntimeError(f"robots of the benchmark must not fall, but {int(fell.sum())} of {BATCH} did")
    rows = np.stack(noted).reshape(BATCH, round(DURATION / CONTROL_PERIOD), -1)
    qpos, told = np.split(rows, [load_nao().nq], axis=-1)
    return qpos[:, 0], told


if __name__ == "__main__":
    main()
