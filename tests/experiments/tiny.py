"""A small experiment to run, with everything that a real one has.

As a program it is the command line with this one experiment, which saves every iteration and runs on all
devices.
"""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax.policies.features import linear_features, quadratic_features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.search.creps import creps
from creps_jax.tasks.sine import sinus
from creps_jax.tools import plots
from experiments import learning, registry
from experiments.learning import Plan, learn, trial_keys
from experiments.registry import Claim

# Made once: every run of the tests shares one compilation.
TASK = sinus(0.0, 1.0)
ALGORITHM = creps(linear_features(1), quadratic_features(1), archive_size=40)


@dataclasses.dataclass(frozen=True)
class Settings:
    iterations: int = 4
    trials: int = 2
    speeds: tuple[float, ...] = (0.1, 0.2)


SETTINGS = {"quick": Settings(), "long": Settings(iterations=6)}
ENTRY = registry.Entry("a small experiment", tuple(SETTINGS))
CLAIMS = (Claim("last reward", lambda arrays: arrays["reward"][:, -1].mean(), low=-10.0, paper=-1.0),)


def run(settings, key, session):
    plan = Plan(settings.iterations, samples=10)
    start = LinearGaussian(jnp.zeros((2, 1)), jnp.eye(1))
    keys = trial_keys(key, settings.trials)
    devices = None if __name__ == "__main__" else jax.local_devices()[:1]
    _, log = learn(keys, TASK, ALGORITHM, start, plan, session=session, name="tiny", devices=devices)
    return {"reward": log["mean_reward"], "coef": log["coef"]}


def plot(arrays):
    episodes = np.arange(arrays["reward"].shape[1])
    return {"curve": plots.learning_curves({"tiny": {"samples": (episodes, arrays["reward"])}})}


if __name__ == "__main__":
    from experiments.cli import main

    sys.modules["experiments.tiny"] = sys.modules["__main__"]
    registry.EXPERIMENTS["tiny"] = ENTRY
    learning._SECONDS_BETWEEN_CHECKPOINTS = 0.0
    sys.exit(main(sys.argv[1:]))
