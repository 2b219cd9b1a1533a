"""Evaluate a policy of a steered walk: at a grid of commands, by random commands, in more noise, by stops.

    python -m experiments.benchmarks.steering [POLICY.npz] [--drives N] [--seed SEED]

Without a file the policy is the shipped one.
"""

import dataclasses
import sys
from pathlib import Path

import jax
import tyro

from creps_jax.policies.learned import linear_policy
from creps_jax.tools import tables
from creps_jax.tools.command_line import answer
from creps_jax.tools.drive import default_policy
from creps_jax.tools.play import balance_of, load_walking_policy
from experiments import steer


def main(policy: tyro.conf.Positional[Path | None] = None, drives: int = 50, seed: int = 2026) -> None:
    """Measure a policy and print its table.

    Args:
        policy: Policy file; the shipped one by default.
        drives: Number of drives of a minute by random commands, and of stops.
        seed: Seed of the noise.
    """
    learned = load_walking_policy(policy or default_policy(), can_steer=True)
    balance = balance_of(learned)
    settings = dataclasses.replace(
        steer.SETTINGS["quick"],
        drives=drives,
        **balance._asdict(),
        com=learned.task["com"],
        acceleration=tuple(learned.task["acceleration"]),
    )
    keys = jax.random.split(jax.random.key(seed), 4)
    arrays = steer.evaluate_policy(settings, linear_policy(learned, "be compared"), tuple(keys))
    print(tables.to_markdown(steer.table(arrays)))
    columns = {
        "metric": [claim.metric for claim in steer.CLAIMS],
        "value": [f"{claim.measure(arrays):.4g}" for claim in steer.CLAIMS],
    }
    print(tables.to_markdown(columns))


if __name__ == "__main__":
    sys.exit(answer(lambda: tyro.cli(main)))
