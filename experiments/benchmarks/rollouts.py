"""Compare the speed of walking rollouts: all devices, one device, bare C MuJoCo at the same setting.

    python -m experiments.benchmarks.rollouts

Each round runs all in turn; the ratios are medians over the rounds. Ours have the controller in the loop; C
MuJoCo replays the set-points of such a walk with `mujoco.rollout`, one thread a core. What C gains from all
threads over one tells how far this machine scales at all: cores that share a chip with others slow down
when all are busy.
"""

from experiments.process import import_mjx_quietly, prepare, usable_cores

prepare()
import_mjx_quietly()

import time  # noqa: E402
from collections.abc import Callable  # noqa: E402

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import mujoco  # noqa: E402
import mujoco.rollout  # noqa: E402
import numpy as np  # noqa: E402

from creps_jax.physics import c, mjx  # noqa: E402
from creps_jax.tasks import Task  # noqa: E402
from creps_jax.tasks.nao_walk import CONTROL_PERIOD, Physics, load_nao, nao_walk, record_walk  # noqa: E402
from creps_jax.train import evaluate  # noqa: E402
from experiments.walk import SETTINGS  # noqa: E402

BATCH = 96
DURATION = 2.0
ROUNDS = 5
# A gait of about .33 m/s.
THETA = (0.001, 0.176, 0.039, 0.224, 3.2, 0.46, 0.31, 0.074, 0.038, 0.11)
BALANCE = SETTINGS["best"].balance()


def main() -> None:
    """Measure and print."""
    model, cores = load_nao(), usable_cores()
    contestants = {
        "all devices": _ours(jax.devices()),
        "one device": _ours(jax.devices()[:1]),
        "all, stepped by C": _ours(jax.devices(), c.make_control_step),
        "C MuJoCo": _bare_c(model, cores),
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
    record = jax.jit(lambda key: record_walk(key, jnp.array(THETA), duration=DURATION, balance=BALANCE))
    walk = jax.tree.map(np.asarray, record(jax.random.key(0)))
    data = [mujoco.MjData(model) for _ in range(threads)]
    data[0].qpos[:] = walk.qpos[0]
    size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    state = np.empty(size)
    mujoco.mj_getState(model, data[0], state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    substeps = round(CONTROL_PERIOD / model.opt.timestep)
    shares = np.arange(1, substeps + 1)[:, None] / substeps
    before = np.concatenate([walk.set_point[:1], walk.set_point[:-1]])[:, None]
    change = walk.set_point[:, None] - before
    lead = -model.actuator_biasprm[:, 2] / model.actuator_gainprm[:, 0] / CONTROL_PERIOD
    control = (before + (shares + lead) * change).reshape(-1, model.nu)

    def run() -> None:
        states, controls = np.tile(state, (BATCH, 1)), np.tile(control, (BATCH, 1, 1))
        mujoco.rollout.rollout(model, data, states, controls)

    return run


if __name__ == "__main__":
    main()
