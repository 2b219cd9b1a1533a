"""Evaluate a walking policy at 11 speeds, 50 fresh episodes each; the NAO's beside the paper's Table 2.

    python -m experiments.benchmarks.policy [POLICY.npz] [--robot NAME] [--noise TIMES]
                                            [--placement-gain GAIN] [--seed SEED]

Without a file it is the shipped policy of the robot. The last options show what more noise, or steps that
answer to a sideways tilt otherwise than those that the policy was learned with, do to it.
"""

from creps_jax.tools.process import import_mjx_quietly, prepare

prepare()
import_mjx_quietly()

import sys  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

from creps_jax.errors import UserError  # noqa: E402
from creps_jax.policies.learned import Learned  # noqa: E402
from creps_jax.tasks import Task  # noqa: E402
from creps_jax.tasks.walking import WalkNoise, nao_walk  # noqa: E402
from creps_jax.tools import tables  # noqa: E402
from creps_jax.tools.play import balance_of, load_walking_policy, robot_of, shipped_policy  # noqa: E402
from creps_jax.training import evaluate  # noqa: E402
from experiments.walk import NUM_SPEEDS  # noqa: E402

SEEDS = 50


def main(
    policy: tyro.conf.Positional[Path | None] = None,
    robot: str | None = None,
    noise: float = 1.0,
    placement_gain: float | None = None,
    seed: int = 2026,
) -> None:
    """Measure a policy and print its table.

    Args:
        policy: Policy file; the shipped one by default.
        robot: Whose policy; nao by default, or the one of the file.
        noise: How many times the usual noise.
        placement_gain: In place of the one that the policy was learned with.
        seed: Seed of the noise.
    """
    saved = load_walking_policy(policy or shipped_policy(robot), robot)
    balance = balance_of(saved)
    if placement_gain is not None:
        balance = balance._replace(placement_gain=placement_gain)
    task = nao_walk(robot=robot_of(saved), balance=balance, noise=WalkNoise().times(noise))
    outcome = walk_at_all_speeds(saved, task, seed=seed)
    print(
        tables.to_markdown(tables.speed_table(speeds_of(saved), outcome.reward, outcome.speed, outcome.fell))
    )
    print(f"mean reward {outcome.reward.mean():.4f}, falls {int(outcome.fell.sum())} of {outcome.fell.size}")


def speeds_of(saved: Learned) -> np.ndarray:
    """Return 11 speeds over the range of a policy, m/s: for the NAO the paper's."""
    return np.linspace(saved.contexts.low[0], saved.contexts.high[0], NUM_SPEEDS, dtype=np.float32)


def walk_at_all_speeds(saved: Learned, task: Task, *, seed: int) -> Any:
    """Roll out a policy at 11 speeds with fresh noise; the outcome has axes (speeds, seeds)."""
    speeds = speeds_of(saved)
    thetas = jnp.stack([jnp.asarray(saved.theta(float(speed))) for speed in speeds])
    outcome = evaluate(jax.random.key(seed), task, jnp.asarray(speeds)[:, None], thetas, repeats=SEEDS)
    return jax.tree.map(np.asarray, outcome)


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        sys.exit(f"error: {error}")
