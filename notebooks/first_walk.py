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
# # First walk
#
# A simulated NAO walks at the speed that you ask for. A learned policy gives the ten parameters of a
# walking engine for each speed. The notebook `walking_engine` shows the engine. The notebook
# `first_policy` shows the search that learned the policy.

# %%
import os
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
from creps_jax.tools.play import record
from creps_jax.tools.plots import PAPER_COLOUR, parameters_against_context

# %% [markdown]
# ## The policy
#
# `python -m experiments run walk --preset best` learns such a policy in a quarter of an hour on two
# cores. Its reward contains only the velocity of the robot and whether it fell. This notebook loads the
# shipped policy. Up to 0.3 m/s, a faster walk has longer steps. Above 0.3 m/s it has quicker steps. The
# dotted lines are the bounds.

# %%
policy = cj.load(ROOT / "models" / "nao" / "policies" / "walk.npz")
speeds = np.linspace(0.1, 0.6, 26)
parameters_against_context(
    speeds,
    np.stack([policy.theta(speed) for speed in speeds]),
    names=policy.parameters.names,
    units=policy.parameters.units,
    low=policy.parameters.low,
    high=policy.parameters.high,
    context_label="speed (m/s)",
    title="Ten parameters as functions of the speed",
)

# %% [markdown]
# ## Watch it walk
#
# Choose a speed. The first run compiles the physics, which takes half a minute.

# %%
speed = 0.4
seconds = float(os.environ.get("FIRST_WALK_SECONDS", "8"))
(clip,) = record(policy, (speed,), seed=0, duration=seconds)

time = clip.period * np.arange(1, len(clip.qpos) + 1)
forward, left = clip.qpos[:, :2].T
figure, axes = plt.subplots(1, 2, figsize=(11, 3.2))
axes[0].plot(time, forward, label="walked")
axes[0].plot(time, speed * time, "--", color=PAPER_COLOUR, label="asked")
axes[0].set(xlabel="time (s)", ylabel="forward (m)", title=clip.caption.capitalize())
axes[0].legend()
axes[1].plot(forward, left)
axes[1].set(xlabel="forward (m)", ylabel="left (m)", title="Path of the torso, from above", ylim=(-0.5, 0.5))
plt.show()

# %% [markdown]
# The video needs OpenGL. If it is missing, a message says what to install.

# %%
from IPython.display import Markdown, Video, display

from creps_jax.tools.video import VideoError, write_video

try:
    path = ROOT / "results" / "first_walk.mp4"
    write_video(path, ROOT / "models" / "nao" / "nao.xml", [clip])
    display(Video(path, embed=True))
except VideoError as error:
    display(Markdown(str(error)))

# %% [markdown]
# Next, learn a walk yourself: `python -m experiments run walk --preset quick` takes two minutes. The
# notebook `your_own_robot` shows how to learn with another robot.
