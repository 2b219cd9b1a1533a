"""Evaluate a walking policy at 11 speeds, with 50 new episodes each, and compare it with the paper's Table 2.

    python -m experiments.benchmarks.policy [POLICY.npz] [--robot NAME] [--speeds N] [--episodes N]
                                            [--noise TIMES] [--placement-gain GAIN]
                                            [--forward-placement-gain GAIN] [--seed SEED]

Without a file the policy is the shipped one of the robot. `--robot` may be the .toml file that describes a
humanoid. The last options test a policy in more noise, or with another gain of the foot placement than it was
learned with.
"""

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from creps_jax.policies.learned import Learned
from creps_jax.tasks import Task
from creps_jax.tasks.closed_loop import WalkNoise
from creps_jax.tasks.walking import nao_walk
from creps_jax.tools import tables
from creps_jax.tools.command_line import answer
from creps_jax.tools.play import balance_of, load_walking_policy, robot_of, shipped_policy
from creps_jax.training import evaluate
from experiments.walking.settings import NUM_SPEEDS, PHYSICS

SEEDS = 50


def main(
    policy: tyro.conf.Positional[Path | None] = None,
    robot: str | None = None,
    speeds: int = NUM_SPEEDS,
    episodes: int = SEEDS,
    noise: float = 1.0,
    placement_gain: float | None = None,
    forward_placement_gain: float | None = None,
    seed: int = 2026,
) -> None:
    """Measure a policy and print its table.

    Args:
        policy: Policy file; the shipped one by default.
        robot: Robot of the policy, or the file that describes it; by default the robot of the policy, or nao.
        speeds: Number of speeds, equally spaced over the range of the policy.
        episodes: Number of episodes at each speed.
        noise: Factor of the usual noise.
        placement_gain: Gain of the foot placement; by default the one that the policy was learned with.
        forward_placement_gain: The same for the foot placement forwards.
        seed: Seed of the noise.
    """
    saved = load_walking_policy(policy or shipped_policy(robot), robot)
    gains = {"placement_gain": placement_gain, "forward_placement_gain": forward_placement_gain}
    balance = balance_of(saved)._replace(**{name: gain for name, gain in gains.items() if gain is not None})
    asked = speeds_of(saved, speeds)
    task = nao_walk(
        float(asked[0]),
        float(asked[-1]),
        robot=robot_of(saved, robot),
        balance=balance,
        noise=WalkNoise().times(noise),
        physics=PHYSICS["auto"],
        com=saved.task.get("com", "one_step"),
    )
    outcome = walk_at_all_speeds(saved, task, seed=seed, speeds=speeds, episodes=episodes)
    print(tables.to_markdown(tables.speed_table(asked, outcome.reward, outcome.speed, outcome.fell)))
    error = np.abs(outcome.speed[..., 0].mean(axis=1) - asked).max()
    print(
        f"mean reward {outcome.reward.mean():.4f}, falls {int(outcome.fell.sum())} of {outcome.fell.size}, "
        f"largest error of the speed {error:.3f} m/s"
    )


def speeds_of(saved: Learned, num: int = NUM_SPEEDS) -> np.ndarray:
    """Return equally spaced speeds over the range of a policy, m/s; by default 11, as in the paper."""
    return np.linspace(saved.contexts.low[0], saved.contexts.high[0], num, dtype=np.float32)


def walk_at_all_speeds(
    saved: Learned, task: Task, *, seed: int, speeds: int = NUM_SPEEDS, episodes: int = SEEDS
) -> Any:
    """Roll out a policy at several speeds; the outcome has axes (speeds, episodes)."""
    asked = speeds_of(saved, speeds)
    thetas = jnp.stack([jnp.asarray(saved.theta(float(speed))) for speed in asked])
    outcome = evaluate(jax.random.key(seed), task, jnp.asarray(asked)[:, None], thetas, repeats=episodes)
    return jax.tree.map(np.asarray, outcome)


if __name__ == "__main__":
    sys.exit(answer(lambda: tyro.cli(main)))
