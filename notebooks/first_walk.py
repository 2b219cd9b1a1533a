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
# Contextual policy search learns not one solution but a rule: for every context (a speed, a target) the
# parameters that do it. First a task small enough to see through, learned in seconds. Then a humanoid
# that walks at the speed you choose.

# %%
import os
import sys
from pathlib import Path

ROOT = next(folder for folder in (Path.cwd(), *Path.cwd().parents) if (folder / "pyproject.toml").exists())
sys.path.insert(0, str(ROOT))

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import creps_jax as cj

# %% [markdown]
# ## 1. The sinus, in seconds
#
# The context is a number `s`, the parameter a number `theta`, the reward `-(theta - sin s)^2`. The policy
# is a Gaussian whose mean is a weighted sum of radial basis functions of `s`. Each iteration tries 40
# samples and moves the policy towards the better ones, but no further than the bound on the relative
# entropy allows.

# %%
low, high = 0.0, 2 * np.pi
task = cj.sinus(low, high)
features = cj.rbf_features(low, high, 7)
algorithm = cj.creps(features, features, kl_bound=0.5, archive_size=400)
start = cj.LinearGaussian(coef=jnp.zeros((features.size, 1)), cov_chol=jnp.eye(1))

state, log = cj.train(jax.random.key(0), task, algorithm, start, iterations=60, samples=40)
print(f"mean reward: {log.mean_reward[0]:.3f} at first, {log.mean_reward[-1]:.4f} at last")

# %%
contexts = jnp.linspace(low, high, 200)[:, None]
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3), layout="constrained")
left.semilogy(-np.asarray(log.mean_reward))
left.set(xlabel="iteration", ylabel="-reward", title="learning curve")
right.plot(contexts, np.sin(contexts), "--", label="sin s")
right.plot(contexts, algorithm.mean(state.policy, contexts), label="learned")
right.set(xlabel="context s", ylabel="theta", title="policy")
right.legend()

# %% [markdown]
# ## 2. A policy that walks
#
# The same algorithm, with the ten parameters of a walking engine for `theta` and the asked speed for the
# context. This policy was learned with `python -m experiments run walk --preset best`; on two cores that
# takes about a quarter of an hour, so here we load it.

# %%
from experiments.policy_file import load_policy

policy = load_policy(ROOT / "models" / "nao" / "policies" / "walk.npz")
print(policy.context_names, "from", policy.context_low, "to", policy.context_high, policy.context_units)
for name, unit, slow, fast in zip(
    policy.param_names, policy.param_units, policy.theta(0.1), policy.theta(0.5), strict=True
):
    print(f"{name:16} {slow:8.3f} -> {fast:8.3f} {unit}")

# %% [markdown]
# ## 3. Watch it walk
#
# Choose a speed.

# %%
speed = 0.4
seconds = float(os.environ.get("FIRST_WALK_SECONDS", "8"))

from experiments.walking_policy import record

(clip,) = record(policy, (speed,), seed=0, duration=seconds)
print(clip.caption)

figure, axes = plt.subplots(1, 2, figsize=(10, 3), layout="constrained")
time = clip.period * np.arange(1, len(clip.qpos) + 1)
axes[0].plot(time, clip.qpos[:, 0], label="walked")
axes[0].plot(time, speed * time, "--", label="asked speed")
axes[0].set(xlabel="time (s)", ylabel="forward (m)")
axes[0].legend()
axes[1].plot(clip.qpos[:, 0], clip.qpos[:, 1])
axes[1].set(xlabel="forward (m)", ylabel="left (m)", title="path of the torso", ylim=(-0.5, 0.5))

# %% [markdown]
# The video needs OpenGL; where it is missing, the message says what to install.

# %%
from IPython.display import Markdown, Video, display

from experiments.video import VideoError, write_video

try:
    path = ROOT / "results" / "first_walk.mp4"
    write_video(path, ROOT / "models" / "nao" / "nao.xml", [clip])
    display(Video(path, embed=True))
except VideoError as error:
    display(Markdown(str(error)))

# %% [markdown]
# ## And your robot?
#
# `ask` proposes parameters, you measure, `tell` learns: no simulator is needed. `contexts` and `rewards`
# below are yours.

# %%
ask, tell = algorithm.ask, algorithm.tell
state = algorithm.init(start)
for iteration in range(3):
    key = jax.random.fold_in(jax.random.key(1), iteration)
    contexts = jax.random.uniform(key, (40, 1), minval=low, maxval=high)
    thetas = ask(key, state, contexts)
    rewards = -(jnp.squeeze(thetas - jnp.sin(contexts)) ** 2)
    state, info = tell(state, cj.Batch(contexts, thetas, rewards))
    print(f"mean reward {rewards.mean():.3f}, moved by {info.policy_kl:.2f} nats")
