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
# # Reaching into a hole
#
# An arm with three links stands upright. Its tip must reach the bottom of a hole, and the arm must not
# touch the ground. The hole is at a different place in each trial. The context is the place of the hole.
# The policy gives 18 parameters, which set the shape of the joint movements (dynamic movement primitives,
# DMPs).

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
from creps_jax.tasks.planar_arm import arm_points, hole_movement
from creps_jax.tools import plots

# %% [markdown]
# ## Learn with RBFs and with linear features
#
# 18 parameters are many for iterations of 50 samples. `bounded_ml` therefore keeps the updates small,
# especially of the covariance. Five trials learn at the same time. The means of their policies are stored
# every tenth iteration.

# %%
low, high, width, depth = 0.8, 2.0, 0.3, 1.0
task = cj.hole_reaching(low, high, width=width, depth=depth, sample_context=cj.uniform_contexts(low, high))
keys = jax.random.split(jax.random.key(1), 5)
m_step = cj.bounded_ml(mean_kl_bound=0.3, cov_kl_bound=0.005)


def learn(features):
    algorithm = cj.creps(features, features, archive_size=400, m_step=m_step)
    start = cj.LinearGaussian(coef=jnp.zeros((features.size, 18)), cov_chol=0.5 * jnp.eye(18))
    policies = [jnp.zeros((5, features.size, 18))]

    def keep(states, log):
        if states.iteration[0] % 10 == 0:
            policies.append(states.policy.coef)

    # One device is faster here, because the rollouts are short.
    run = {"iterations": 250, "samples": 50, "on_iteration": keep, "devices": jax.local_devices()[:1]}
    cj.train_trials(keys, task, algorithm, start, **run)
    return np.stack(policies)


rbf, line = cj.rbf_features(low, high, 4), cj.linear_features(1)
rbf_coefs, line_coefs = learn(rbf), learn(line)

# %% [markdown]
# ## How the policy improves
#
# The figure shows the mean policy of the first trial, for three holes. At first the arm stands. It then
# learns to move down without touching the ground, then to enter the hole, and at last to reach the
# bottom.

# %%
holes, shown = np.array([0.9, 1.4, 1.9], np.float32), (0, 2, 6, 25)


@jax.jit
def move(coefs):
    thetas = jnp.einsum("hp,kpd->khd", jax.vmap(rbf.apply)(holes[:, None]), coefs)
    return jax.vmap(jax.vmap(lambda theta: jax.vmap(arm_points)(hole_movement(theta).pos)))(thetas)


postures = np.asarray(move(rbf_coefs[shown, 0]))
figure, axes = plt.subplots(len(holes), len(shown), figsize=(11, 9), sharex=True, sharey=True)
for column, index in enumerate(shown):
    for panel, points, hole in zip(axes[:, column], postures[column], holes, strict=True):
        plots.plot_postures(panel, points, num=12)
        plots.plot_ground(panel, hole, width, depth)
        panel.set(xlim=(-0.8, 2.8), ylim=(-1.15, 3.1))
        panel.label_outer()
    axes[0, column].set_title(f"After {500 * index:,} episodes")
plt.show()

# %% [markdown]
# ## RBFs or linear features?
#
# The figure shows the stored policies of all trials at 25 holes. A cross means that the arm touched the
# ground. In the middle of the range the linear policy is nearly as good. At the far end it cannot follow,
# and the arm touches the edge. At the near end, where the arm must fold most, both policies touch the
# edge. In the range of the paper, 1.4 to 2 m, both are similar.

# %%
grid = np.linspace(low, high, 25, dtype=np.float32)


def judge(features, coefs):
    @jax.jit
    def reach(coefs):
        thetas = jnp.einsum("hp,ktpd->kthd", jax.vmap(features.apply)(grid[:, None]), coefs)
        rollouts = jax.vmap(jax.vmap(jax.vmap(task.rollout, (None, 0, 0)), (None, None, 0)), (None, None, 0))
        return rollouts(jax.random.key(0), grid[:, None], thetas)

    outcome = reach(coefs)
    return np.asarray(outcome.distance), np.asarray(outcome.num_collisions) > 0


figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4))
for name, features, coefs, colour in (
    ("4 RBFs", rbf, rbf_coefs, plots.COLOURS[0]),
    ("linear", line, line_coefs, plots.COLOURS[1]),
):
    distance, collides = judge(features, coefs)
    plots.plot_learning_curve(left, 500 * np.arange(26), distance.mean(2).T, name, colour=colour)
    for trial, hits in zip(distance[-1], collides[-1], strict=True):
        right.plot(grid, trial, color=colour, linewidth=1)
        right.plot(grid[hits], trial[hits], "x", color=colour, markersize=8)
    share = f"{name}: {collides[-1].mean():.0%} touch the ground"
    right.plot([], [], "x-", color=colour, label=share)
left.set(xlabel="episodes", ylabel="distance (m)", title="Mean distance to the bottom", yscale="log")
left.legend()
right.set(xlabel="middle of the hole (m)", ylabel="distance (m)", title="Distance after learning")
right.legend()
plt.show()
