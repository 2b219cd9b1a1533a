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
# # Drive a walk
#
# The shipped policy `steer` walks at any command: forward speed, sideways speed and turn rate. This
# notebook drives the simulated NAO along a figure of eight, lets it stop, and walks sideways.

# %%
import sys
from pathlib import Path

ROOT = next(folder for folder in (Path.cwd(), *Path.cwd().parents) if (folder / "pyproject.toml").exists())
sys.path.insert(0, str(ROOT))

from creps_jax.tools.process import import_mjx_quietly, prepare

prepare()  # Keep compiled programs in a cache, so that the next run starts faster.
import_mjx_quietly()

# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

import creps_jax as cj
from creps_jax.tools.drive import drive_by_commands
from creps_jax.walking.controller import Stage
from creps_jax.walking.gaits import learned_walker

# %% [markdown]
# ## The commands
#
# A turn rate of 0.5 rad/s for a full turn takes 12.6 s. The figure of eight is a full turn to the left, and
# a full turn to the right. Then the robot stops for 4 s, and walks to its left for 5 s.

# %%
PERIOD, RATE = 0.02, 0.5
turn = 2 * np.pi / RATE
parts = [
    (turn, (0.25, 0, RATE)),
    (turn, (0.25, 0, -RATE)),
    (4.0, (0, 0, 0)),
    (5.0, (0, 0.1, 0)),
    (2.0, (0, 0, 0)),
]
commands = np.concatenate([np.tile(command, (round(time / PERIOD), 1)) for time, command in parts])
walker = learned_walker(cj.load(ROOT / "models" / "nao" / "policies" / "steer.npz"))
drive = drive_by_commands(walker, commands.astype(np.float32), seed=0)
print("fell" if drive.has_fallen[-1] else "did not fall")

# %% [markdown]
# ## The path
#
# The path is that of the torso, which sways with each step.

# %%
x, y = drive.qpos[:, :2].T
plt.figure(figsize=(5, 4))
plt.plot(x, y)
plt.plot(x[0], y[0], "o", label="start")
plt.plot(x[-1], y[-1], "s", label="end")
plt.axis("equal")
plt.xlabel("x (m)")
plt.ylabel("y (m)")
plt.legend()

# %% [markdown]
# ## Asked and reached
#
# The walker limits how fast the command changes. The speeds are means over one second. The grey areas are the
# times in which the robot stands.

# %%
window = np.ones(50) / 50
time = np.asarray(drive.time)
fig, axes = plt.subplots(3, 1, figsize=(7, 5), sharex=True)
names = ("forward (m/s)", "to the left (m/s)", "turn rate (rad/s)")
for axis, (ax, name) in enumerate(zip(axes, names, strict=True)):
    ax.plot(time, drive.command[:, axis], label="asked")
    ax.plot(time, np.convolve(drive.speed[:, axis], window, mode="same"), label="reached")
    ax.fill_between(time, *ax.get_ylim(), where=drive.stage == Stage.STANDING, color="0.9")
    ax.set_ylabel(name)
axes[0].legend(loc="upper right")
axes[-1].set_xlabel("time (s)")
