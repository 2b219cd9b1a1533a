"""Walk with a policy by MJX and in a finer physics, side by side.

    python -m experiments.benchmarks.fidelity [POLICY.npz] [--robot NAME]

The finer one is C MuJoCo with a fifth of the time step and a solver that runs until it has converged. The
seeds of the noise are used nowhere else. Without a file it is the shipped policy of the robot.
"""

from creps_jax.tools.process import import_mjx_quietly, prepare

prepare()
import_mjx_quietly()

import sys  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402
import tyro  # noqa: E402

from creps_jax.errors import UserError  # noqa: E402
from creps_jax.simulation import c  # noqa: E402
from creps_jax.simulation.models import load_nao  # noqa: E402
from creps_jax.tasks.walking import nao_walk  # noqa: E402
from creps_jax.tools import tables  # noqa: E402
from creps_jax.tools.play import balance_of, load_walking_policy, robot_of, shipped_policy  # noqa: E402
from experiments.benchmarks.policy import speeds_of, walk_at_all_speeds  # noqa: E402

SEED = 90_000
FINER = 5
ITERATIONS, LS_ITERATIONS = 100, 50


def main(policy: tyro.conf.Positional[Path | None] = None, robot: str | None = None) -> None:
    """Measure a policy in both, and print speeds, falls and differences.

    Args:
        policy: Policy file; the shipped one by default.
        robot: Whose policy; nao by default, or the one of the file.
    """
    saved = load_walking_policy(policy or shipped_policy(robot), robot)
    walker = robot_of(saved)
    fine = load_nao(walker)
    fine.opt.timestep /= FINER
    fine.opt.iterations, fine.opt.ls_iterations = ITERATIONS, LS_ITERATIONS
    learned_in = nao_walk(robot=walker, balance=balance_of(saved))
    finer = nao_walk(robot=walker, balance=balance_of(saved), model=fine, physics=c.make_control_step)
    ours, other = (walk_at_all_speeds(saved, task, seed=SEED) for task in (learned_in, finer))
    means = [outcome.speed.mean(axis=1) for outcome in (ours, other)]
    columns = {
        "asked m/s": [f"{speed:.2f}" for speed in speeds_of(saved)],
        "MJX": [f"{speed:.3f}" for speed in means[0][:, 0]],
        "finer": [f"{speed:.3f}" for speed in means[1][:, 0]],
        "difference": [f"{difference:+.3f}" for difference in (means[1] - means[0])[:, 0]],
        "sideways, finer": [f"{speed:+.3f}" for speed in means[1][:, 1]],
        "falls": [f"{a} and {b}" for a, b in zip(ours.fell.sum(axis=1), other.fell.sum(axis=1), strict=True)],
    }
    print(f"{ours.fell.shape[1]} walks a speed; finer: {1e3 * fine.opt.timestep:g} ms, Newton {ITERATIONS}\n")
    print(tables.to_markdown(columns))
    largest = np.abs(means[1] - means[0])[:, 0].max()
    print(f"largest difference {largest:.3f} m/s, falls {ours.fell.sum()} and {other.fell.sum()}")


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        sys.exit(f"error: {error}")
