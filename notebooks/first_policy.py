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
# # Your first policy, in five minutes
#
# An optimiser finds one parameter vector. A contextual policy is a function: it gives parameters `theta`
# for every context `s`. Here both are one number. The policy is a Gaussian distribution of `theta` for
# each context. It explores by drawing samples from this distribution.

# %%
import sys
from pathlib import Path

ROOT = next(folder for folder in (Path.cwd(), *Path.cwd().parents) if (folder / "pyproject.toml").exists())
sys.path.insert(0, str(ROOT))

from creps_jax.tools.process import prepare

prepare()  # Keep compiled programs in a cache, so that the next run starts faster.

from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import creps_jax as cj
from creps_jax.tools.plots import COLOURS

# %% [markdown]
# ## The task and the features
#
# The best parameter is `sin s`. The search does not know this function. It tries a `theta` and gets the
# reward `-(theta - sin s)^2`. The mean of the policy is a weighted sum of features. Here the features are
# radial basis functions (RBFs) of `s`. The search learns their weights.

# %%
low, high = 0.0, 5 * np.pi
task = replace(cj.sinus(low, high), sample_context=cj.uniform_contexts(low, high))
features = cj.rbf_features(low, high, 11)

grid = cj.context_grid(low, high, 201)
s, theta = np.asarray(grid[:, 0]), np.linspace(-2.5, 2.5, 101)
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3))
image = left.pcolormesh(s, theta, -((theta[:, None] - np.sin(s)) ** 2), cmap="cividis", vmin=-4)
figure.colorbar(image, label="reward", extend="min")
left.set(xlabel="context s (rad)", ylabel="theta", title="The reward (unknown to the search)")
right.plot(s, jax.vmap(features.apply)(grid), color=COLOURS[0], linewidth=1.2)
right.set(xlabel="context s (rad)", ylabel="feature", title="Eleven RBF features; their sum is one")
plt.show()

# %% [markdown]
# ## Learn
#
# Each iteration draws 40 contexts and samples a `theta` for each context. From the 40 rewards it updates
# the policy towards the samples with high reward. The KL bound limits the size of the update.
# `on_iteration` stores the state after each iteration, for the figure below.

# %%
algorithm = cj.creps(features, features, kl_bound=0.5, archive_size=400)
start = cj.LinearGaussian(coef=jnp.zeros((features.size, 1)), cov_chol=jnp.eye(1))
states = [algorithm.init(start)]
settings = {"iterations": 60, "samples": 40, "on_iteration": lambda state, log: states.append(state)}
state, log = cj.train(jax.random.key(0), task, algorithm, start, **settings)

# %%
figure, axes = plt.subplots(1, 4, figsize=(14, 3.2), sharex=True, sharey=True)
for panel, iteration in zip(axes, (1, 5, 15, 60), strict=True):
    policy, archive = states[iteration - 1].policy, states[iteration].archive
    mean, std = np.asarray(algorithm.mean(policy, grid))[:, 0], float(policy.cov_chol[0, 0])
    panel.fill_between(s, mean - 2 * std, mean + 2 * std, color=COLOURS[0], alpha=0.2, linewidth=0)
    panel.plot(s, mean, color=COLOURS[0], label="policy, ±2 std")
    panel.plot(s, np.sin(s), "k--", linewidth=1.2, label="sin s")
    tried = np.asarray(archive.age[: archive.size]) == 0
    context, theta = (np.asarray(x)[: archive.size][tried, 0] for x in archive.batch[:2])
    panel.plot(context, theta, ".", color=COLOURS[1], label="samples")
    panel.set(xlabel="context s (rad)", title=f"Iteration {iteration}: std {std:.2g}")
axes[0].set(ylabel="theta", ylim=(-2.7, 2.7))
axes[-1].legend(loc="lower center", ncols=3, fontsize=8)
plt.show()

# %% [markdown]
# The exploration decreases during learning. It follows no fixed schedule: each update fits the covariance
# to the weighted samples, like the mean.
#
# ## The features limit what can be learned
#
# The same search with the features `[1, s]` learns a straight line. Its reward stops improving. Its
# standard deviation stays as large as the error that remains for every line.

# %%
line = cj.linear_features(1)
line_algorithm = cj.creps(line, features, kl_bound=0.5, archive_size=400)
line_start = cj.LinearGaussian(coef=jnp.zeros((line.size, 1)), cov_chol=jnp.eye(1))
line_state, line_log = cj.train(
    jax.random.key(0), task, line_algorithm, line_start, iterations=60, samples=40
)

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2))
left.plot(s, np.sin(s), "k--", linewidth=1.2)
left.set(xlabel="context s (rad)", ylabel="theta", title="After 60 iterations: mean ±2 std, and sin s")
right.set(xlabel="episodes", ylabel="-mean reward", title="Learning curves", yscale="log")
for name, learner, final, curve in (
    ("RBF features", algorithm, state, log),
    ("linear features", line_algorithm, line_state, line_log),
):
    mean, std = np.asarray(learner.mean(final.policy, grid))[:, 0], float(final.policy.cov_chol[0, 0])
    left.plot(s, mean)
    left.fill_between(s, mean - 2 * std, mean + 2 * std, alpha=0.2, linewidth=0)
    right.plot(40 * np.arange(1, 61), -np.asarray(curve.mean_reward), label=name)
right.legend()
plt.show()
