"""Evaluate a walking policy at the paper's 11 speeds, 50 fresh episodes each, beside the paper's Table 2.

    python -m experiments.benchmarks.policy [POLICY.npz] [--noise TIMES] [--placement-gain GAIN]

Without a file it is the shipped policy. The options show what more noise, or steps that answer to a sideways
tilt otherwise than those that the policy was learned with, do to it.
"""

from experiments.process import import_mjx_quietly, prepare

prepare()
import_mjx_quietly()

import sys  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

from creps_jax.tasks import Task  # noqa: E402
from creps_jax.tasks.nao_walk import WalkNoise, nao_walk  # noqa: E402
from creps_jax.train import evaluate  # noqa: E402
from experiments import tables  # noqa: E402
from experiments.errors import UserError  # noqa: E402
from experiments.policy_file import SavedPolicy, policies_folder  # noqa: E402
from experiments.walking_policy import balance_of, load_walking_policy  # noqa: E402

SEEDS = 50


def main(
    policy: tyro.conf.Positional[Path] = policies_folder() / "walk.npz",  # noqa: B008
    noise: float = 1.0,
    placement_gain: float | None = None,
) -> None:
    """Measure a policy and print its table.

    Args:
        policy: Policy file; the shipped one by default.
        noise: How many times the usual noise.
        placement_gain: In place of the one that the policy was learned with.
    """
    saved = load_walking_policy(policy)
    balance = balance_of(saved)
    if placement_gain is not None:
        balance = balance._replace(placement_gain=placement_gain)
    outcome = walk_at_all_speeds(saved, nao_walk(balance=balance, noise=WalkNoise().times(noise)), seed=2026)
    print(
        tables.to_markdown(
            tables.speed_table(np.asarray(tables.PAPER_SPEEDS), outcome.reward, outcome.speed, outcome.fell)
        )
    )
    print(f"mean reward {outcome.reward.mean():.4f}, falls {int(outcome.fell.sum())} of {outcome.fell.size}")


def walk_at_all_speeds(saved: SavedPolicy, task: Task, *, seed: int) -> Any:
    """Roll out a policy at the paper's speeds with fresh noise; the outcome has axes (speeds, seeds)."""
    speeds = np.asarray(tables.PAPER_SPEEDS, np.float32)
    thetas = jnp.stack([jnp.asarray(saved.theta(float(speed))) for speed in speeds])
    outcome = evaluate(jax.random.key(seed), task, jnp.asarray(speeds)[:, None], thetas, repeats=SEEDS)
    return jax.tree.map(np.asarray, outcome)


if __name__ == "__main__":
    try:
        tyro.cli(main)
    except UserError as error:
        sys.exit(f"error: {error}")
