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
# # The dual function and epsilon
#
# Relative entropy policy search (REPS) gives each sample a weight: a high reward gives a large weight.
# The bound `epsilon` (`kl_bound`, in nats) limits the KL divergence between these weights and equal
# weights. The weights follow from the minimum of a convex function, the dual. Its variables are a
# temperature and a baseline.

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
from creps_jax.policies import gaussian
from creps_jax.search.dual import dual_objective, sample_kl
from creps_jax.search.fit import WeightedSamples, weighted_ml
from creps_jax.tools import plots

# %% [markdown]
# ## One batch, three values of epsilon
#
# The batch has 150 random contexts `s` with random parameters `theta`. The reward is `-(theta - sin
# s)^2`. `solve_dual` finds the temperature `eta` and the baseline `V(s)`. The weight of a sample is
# proportional to `exp((reward - V(s)) / eta)`. With a small epsilon all samples have similar weights.
# With a large epsilon a few samples have most of the weight. The size of a dot shows the weight. The
# title gives the effective number of samples.

# %%
rng = np.random.default_rng(0)
s, theta = rng.uniform(0, 2 * np.pi, 150), rng.normal(0, 1, 150)
reward = jnp.float32(-((theta - np.sin(s)) ** 2))
baseline = jax.vmap(cj.rbf_features(0, 2 * np.pi, 5).apply)(jnp.float32(s[:, None]))
epsilons = np.float32([0.05, 0.5, 2.0])


@jax.jit
@jax.vmap
def weigh(epsilon):
    dual = cj.solve_dual(reward, baseline, kl_bound=epsilon)
    return dual, cj.sample_weights(dual, reward, baseline)


duals, weights = jax.device_get(weigh(epsilons))
figure, axes = plt.subplots(1, 3, figsize=(12, 3.4), sharey=True)
line = np.linspace(0, 2 * np.pi, 100)
for panel, epsilon, eta, d in zip(axes, epsilons, duals.temperature, weights, strict=True):
    panel.plot(line, np.sin(line), "k--", linewidth=1.2)
    panel.scatter(s, theta, s=3, color=plots.PAPER_COLOUR)
    panel.scatter(s, theta, s=3000 * d, alpha=0.5, linewidth=0)
    title = f"ε = {epsilon:g}, η = {eta:.2g}: {1 / np.sum(d**2):.0f} effective samples"
    panel.set(xlabel="context s (rad)", title=title)
axes[0].set_ylabel("theta")
plt.show()

# %% [markdown]
# ## At the minimum of the dual, the KL divergence equals the bound
#
# The derivative of the dual with respect to the temperature is `epsilon` minus the KL divergence of the
# weights. At the minimum this derivative is zero, so the KL divergence equals `epsilon`. This holds for
# any unit of the rewards.

# %%
temperatures = np.geomspace(0.01, 10, 200).astype(np.float32)


@jax.jit
@jax.vmap
def along_temperature(epsilon, dual):
    def at(eta):
        weights = cj.sample_weights(dual._replace(temperature=eta), reward, baseline)
        everything = jnp.ones(reward.shape, bool)
        coef = dual.baseline_coef
        return dual_objective(jnp.log(eta), coef, reward, baseline, everything, epsilon), sample_kl(weights)

    return jax.vmap(at)(temperatures)


values, kls = jax.device_get(along_temperature(epsilons, duals))
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.6))
for epsilon, eta, value, kl in zip(epsilons, duals.temperature, values, kls, strict=True):
    (curve,) = left.plot(temperatures, value - value.min(), label=f"ε = {epsilon:g}")
    left.plot(eta, 0, "o", color=curve.get_color())
    right.plot(temperatures, kl)
    right.axhline(epsilon, color=curve.get_color(), linestyle=":", linewidth=1.2)
    right.plot(eta, epsilon, "o", color=curve.get_color())
left.set(xscale="log", ylim=(-0.05, 1), xlabel="temperature η", ylabel="dual, above its minimum")
left.set_title("The dual, and its minimum (dots)")
left.legend()
right.set(xscale="log", yscale="log", xlabel="temperature η", ylabel="KL of the weights (nats)")
right.set_title("At the minimum, the KL is ε")
plt.show()

# %% [markdown]
# ## A whole search
#
# A search repeats four steps: draw samples, solve the dual, compute the weights, fit the policy. Here the
# four steps are written out. The task has ten parameters; the best value of each is linear in the
# context. An iteration has 100 samples.

# %%
linear = cj.linear_features(1)
start = cj.LinearGaussian(coef=jnp.zeros((2, 10)).at[0].set(2.0), cov_chol=jnp.eye(10))


def search(epsilon, key, fit):
    def update(policy, key):
        context_key, theta_key = jax.random.split(key)
        contexts = jax.random.uniform(context_key, (100, 1))
        features = jax.vmap(linear.apply)(contexts)
        theta = jax.vmap(gaussian.sample, (0, None, 0))(jax.random.split(theta_key, 100), policy, features)
        reward = -jnp.sum((theta - contexts * jnp.linspace(-1, 1, 10)) ** 2, axis=1)

        dual = cj.solve_dual(reward, features, kl_bound=epsilon)
        weights = cj.sample_weights(dual, reward, features)
        samples = WeightedSamples(features, theta, weights, jnp.ones(100, bool))
        new = fit(policy, samples, ridge=1e-4)
        return new, (
            jnp.mean(reward),
            jnp.mean(jax.vmap(gaussian.kl, (None, None, 0))(new, policy, features)),
        )

    return jax.lax.scan(update, start, jax.random.split(key, 60))[1]


searches = jax.jit(jax.vmap(jax.vmap(search, (None, 0, None)), (0, None, None)), static_argnums=2)
trials = jax.random.split(jax.random.key(0), 10)
found = searches(epsilons, trials, weighted_ml)
bounded = searches(epsilons[1:2], trials, cj.bounded_ml(mean_kl_bound=0.4, cov_kl_bound=0.1))

# %% [markdown]
# With a small epsilon the search is slow. With a large epsilon it follows a few samples with lucky
# rewards, and its covariance shrinks too early. With 0.5 it stops too early as well. The right figure
# shows why: epsilon bounds the weights, but the Gaussian that is fitted to the weighted samples moves
# farther than the bound (thin lines), because 100 samples determine the covariance only roughly.
# `bounded_ml` bounds the change of the mean and of the covariance themselves. With it the search
# continues to improve.

# %%
rewards, moves = (np.concatenate(pair) for pair in zip(found, bounded, strict=True))
figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4))
episodes, names = 100 * np.arange(1, 61), ("ε = 0.05", "ε = 0.5", "ε = 2", "ε = 0.5, bounded fit")
for name, reward, moved, bound in zip(names, rewards, moves, [*epsilons, 0.5], strict=True):
    plots.plot_learning_curve(left, episodes, reward, name)
    (curve,) = right.semilogy(episodes, np.median(moved, axis=0))
    right.axhline(bound, color=curve.get_color(), linewidth=0.6)
plots.reward_scale(left, rewards)
left.set(xlabel="episodes", ylabel="mean reward", title="Learning curves of ten trials")
left.legend(fontsize=8)
right.set(xlabel="episodes", ylabel="KL(new || old policy) (nats)", title="KL divergence of each update")
plt.show()
