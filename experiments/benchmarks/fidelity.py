"""Compare the walks of a policy in MJX and in a finer simulation.

    python -m experiments.benchmarks.fidelity [POLICY.npz] [--robot NAME]

The finer simulation is C MuJoCo with a fifth of the time step and a solver that runs until it converges. No
other command uses these seeds of the noise. Without a file the policy is the shipped one of the robot.
"""

import sys
from pathlib import Path

import numpy as np
import tyro

from creps_jax.simulation import c
from creps_jax.simulation.models import load_nao
from creps_jax.tasks.walking import nao_walk
from creps_jax.tools import tables
from creps_jax.tools.command_line import answer
from creps_jax.tools.play import balance_of, load_walking_policy, robot_of, shipped_policy
from experiments.benchmarks.policy import speeds_of, walk_at_all_speeds

SEED = 90_000
FINER = 5
ITERATIONS, LS_ITERATIONS = 100, 50


def main(policy: tyro.conf.Positional[Path | None] = None, robot: str | None = None) -> None:
    """Measure a policy in both, and print speeds, falls and differences.

    Args:
        policy: Policy file; the shipped one by default.
        robot: Robot of the policy; by default the robot of the file, or nao.
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
    sys.exit(answer(lambda: tyro.cli(main)))
