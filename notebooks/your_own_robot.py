# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#       format_version: '1.3'
#       jupytext_version: 1.19.6
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Your own robot
#
# The search does not need a task in JAX. It works with any source of rewards: another simulator, a real
# robot, or measurements by a person. `ask` proposes parameters, you measure their rewards, and `tell`
# updates the policy.

# %%
import sys
from pathlib import Path

ROOT = next(folder for folder in (Path.cwd(), *Path.cwd().parents) if (folder / "pyproject.toml").exists())
sys.path.insert(0, str(ROOT))

from creps_jax.tools.process import prepare

prepare()  # Keep compiled programs in a cache, so that the next run starts faster.

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import creps_jax as cj
from creps_jax.checkpoints import Checkpoint, load_checkpoint, save_checkpoint
from creps_jax.tools.plots import COLOURS, PAPER_COLOUR

# %% [markdown]
# ## A robot in plain Python
#
# The robot throws a ball over a wall. The ball should land at a given distance, the context. Speed and
# angle of each throw have noise. In one of ten throws the camera loses the ball. The reward of this throw
# is NaN, and the search ignores it.

# %%
WALL, TOP = 2.0, 2.5  # Position and height of the wall, m.
rng = np.random.default_rng(0)


def throw(speed, angle):
    """Return the path (n, 2) of a ball thrown at a speed (m/s) and angle (deg), 1 m above the ground."""
    path, step = [np.array([0.0, 1.0])], 0.01
    velocity = speed * np.array([np.cos(np.radians(angle)), np.sin(np.radians(angle))])
    while path[-1][1] > 0:
        velocity = velocity - step * (np.array([0, 9.81]) + 0.02 * np.hypot(*velocity) * velocity)
        path.append(path[-1] + step * velocity)
        if path[-2][0] < WALL <= path[-1][0] and path[-1][1] < TOP:
            velocity = velocity * [-0.2, 1.0]
            path[-1] = path[-2]
    return np.array(path)


def measure(wanted, speed, angle):
    """Return the reward of one throw: it is higher for a smaller distance error and a lower speed."""
    if rng.random() < 0.1:
        return np.nan
    landed = throw(speed + 0.05 * rng.normal(), angle + 0.5 * rng.normal())[-1, 0]
    return -((landed - wanted) ** 2) - 0.005 * speed**2


# %% [markdown]
# ## Learn from 20 throws at a time
#
# The search uses real numbers without bounds. `sigmoid_gate` maps them into the bounds of the arm. Give
# `tell` the numbers that `ask` returned, not the mapped ones.

# %%
near, far = 3.0, 8.0
LOW, HIGH = np.float32([4.0, 20.0]), np.float32([12.0, 80.0])  # Speed (m/s) and angle (deg).
features = cj.rbf_features(near, far, 4)
algorithm = cj.creps(features, features, kl_bound=0.5, archive_size=120)
start = cj.LinearGaussian(coef=jnp.zeros((features.size, 2)), cov_chol=jnp.eye(2))


def arm(thetas):
    return np.asarray(cj.sigmoid_gate(thetas, LOW, HIGH))


def learn(state, log, iterations):
    for _ in range(iterations):
        wanted = rng.uniform(near, far, (20, 1))
        thetas = algorithm.ask(jax.random.key(int(state.iteration)), state, wanted)
        rewards = np.array([measure(*trial) for trial in np.hstack([wanted, arm(thetas)])])
        state, _ = algorithm.tell(state, cj.Batch(wanted, thetas, rewards))
        log = np.vstack([log, rewards])
    return state, log


state, log = learn(algorithm.init(start), np.zeros((0, 20)), 15)

# %% [markdown]
# ## Stop, and continue later
#
# The state contains the whole search: policy, archive, number of iterations. `save_checkpoint` writes it
# to a file. An interrupted write leaves no incomplete file. `load_checkpoint` refuses the checkpoint of
# another run.

# %%
path, run = ROOT / "results" / "ball.npz", {"robot": "ball", "seed": 0}
save_checkpoint(path, Checkpoint(state, {"rewards": log}), run=run)

state, saved = load_checkpoint(path, algorithm.init(start), run=run)
state, log = learn(state, saved["rewards"], 25)
print(f"{state.iteration} iterations, {log.size} throws, {np.isnan(log).sum()} of them lost")

# %% [markdown]
# ## The learned policy

# %%
figure, (curve, speeds, angles) = plt.subplots(1, 3, figsize=(14, 3.6))
curve.plot(-log.ravel(), ".", color=COLOURS[0], alpha=0.4, markersize=4, label="one throw")
curve.plot(np.arange(20, 801, 20), -np.nanmedian(log, axis=1), color=COLOURS[1], label="median of 20")
curve.axvline(300, color=PAPER_COLOUR, linestyle="--", linewidth=1.2, label="saved and loaded")
curve.set(xlabel="throws", ylabel="-reward", title="Learning curve", yscale="log")
curve.legend(fontsize=8)

grid = np.linspace(near, far, 51)[:, None]
mean, std = np.asarray(algorithm.mean(state.policy, grid)), np.linalg.norm(state.policy.cov_chol, axis=1)
low, middle, high = (arm(jnp.asarray(mean + share * std)).T for share in (-2, 0, 2))
for index, (panel, name) in enumerate(((speeds, "speed (m/s)"), (angles, "angle (deg)"))):
    panel.fill_between(grid[:, 0], low[index], high[index], color=COLOURS[0], alpha=0.2, linewidth=0)
    panel.plot(grid[:, 0], middle[index], color=COLOURS[0])
    panel.set(xlabel="asked distance (m)", ylabel=name, ylim=(LOW[index], HIGH[index]))
speeds.set_title("Speed of the policy, ±2 std")
angles.set_title("Angle of the policy, ±2 std")
plt.show()

# %%
targets = np.linspace(3.5, 8.0, 4)
first = arm(algorithm.ask(jax.random.key(0), algorithm.init(start), np.zeros((20, 1))))
last = arm(algorithm.mean(state.policy, targets[:, None]))

figure, (before, after) = plt.subplots(1, 2, figsize=(13, 3.4), sharex=True, sharey=True)
for speed, angle in first:
    before.plot(*throw(speed, angle).T, color=PAPER_COLOUR, linewidth=1)
for target, (speed, angle), colour in zip(targets, last, COLOURS, strict=False):
    after.plot(*throw(speed, angle).T, color=colour)
    after.plot(target, 0, "v", color=colour, markersize=12, clip_on=False)
for panel, title in ((before, "Throws before learning"), (after, "Throws after learning, four distances")):
    panel.plot([WALL, WALL], [0, TOP], color="black", linewidth=4)
    panel.set(xlabel="distance (m)", title=title, xlim=(0, 9), ylim=(0, 5), aspect="equal")
before.set_ylabel("height (m)")
plt.show()
