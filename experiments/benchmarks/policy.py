"""Evaluate a walking policy at the paper's 11 speeds, 50 fresh episodes each, beside the paper's Table 2.

python -m experiments.benchmarks.policy [POLICY.npz]; without a file, the shipped policy.
"""

from experiments.process import import_mjx_quietly, prepare

prepare()
import_mjx_quietly()

import sys  # noqa: E402
from pathlib import Path  # noqa: E402

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from creps_jax.tasks.nao_walk import nao_walk  # noqa: E402
from creps_jax.train import evaluate  # noqa: E402
from experiments import tables  # noqa: E402
from experiments.errors import UserError  # noqa: E402
from experiments.policy_file import policies_folder  # noqa: E402
from experiments.walking_policy import balance_of, load_walking_policy  # noqa: E402

SEEDS = 50


def main(path: Path) -> None:
    """Measure and print."""
    policy = load_walking_policy(path)
    speeds = np.asarray(tables.PAPER_SPEEDS, np.float32)
    thetas = jnp.stack([jnp.asarray(policy.theta(float(speed))) for speed in speeds])
    task = nao_walk(balance=balance_of(policy))
    outcome = evaluate(jax.random.key(2026), task, jnp.asarray(speeds)[:, None], thetas, repeats=SEEDS)
    reward, speed, fell = (np.asarray(field) for field in (outcome.reward, outcome.speed, outcome.fell))
    print(tables.to_markdown(tables.speed_table(speeds, reward, speed, fell)))
    print(f"mean reward {reward.mean():.4f}, falls {int(fell.sum())} of {fell.size}")


if __name__ == "__main__":
    try:
        main(Path(sys.argv[1]) if len(sys.argv) > 1 else policies_folder() / "walk.npz")
    except UserError as error:
        sys.exit(f"error: {error}")
