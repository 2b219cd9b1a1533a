"""Learn the sine of the context, with linear and with RBF features (Abdolmaleki et al. 2016, 4.1, Fig. 5)."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from creps_jax.contexts import context_grid
from creps_jax.creps import creps
from creps_jax.features import linear_features, quadratic_features, rbf_features
from creps_jax.policy import LinearGaussian
from creps_jax.tasks.sinus import sinus
from experiments import plots
from experiments.learning import Plan, Session, learn, trial_keys
from experiments.registry import Claim

LOW, HIGH = 0.0, 5 * math.pi
FEATURES = ("linear", "rbf")


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of the experiment; the paper gives samples, archive, KL bound and trials.

    Attributes:
        iterations: iterations of learning.
        trials: trials of each curve.
        samples: N, new samples of an iteration.
        archive_size: L, samples kept.
        kl_bound: epsilon, nats.
        num_centers: K; two centres a half-wave and one are enough to follow the sine.
        ridge: relative penalty on the policy's coefficients. Few contexts are drawn near the ends
            of the range, and without it some trials end with wild coefficients there.
        start_std: standard deviation of the first policy, whose mean is zero.
    """

    iterations: int = 150
    trials: int = 5
    samples: int = 40
    archive_size: int = 2000
    kl_bound: float = 0.5
    num_centers: int = 11
    ridge: float = 1e-3
    start_std: float = 1.0


SETTINGS = {"paper": Settings(), "quick": Settings(iterations=60, trials=3)}


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn with both kinds of features.

    Returns:
        Rewards of the new samples and of the mean policy over a grid, by iteration; policies over that grid.
    """
    task = sinus(LOW, HIGH)
    plan = Plan(settings.iterations, settings.samples)
    grid = context_grid(LOW, HIGH, 201)
    # Rollouts as short as these are not worth sharing out.
    one_device = jax.local_devices()[:1]
    arrays = {
        "episodes": plan.episodes(np.arange(1, settings.iterations + 1)),
        "context": np.asarray(grid[:, 0]),
    }
    for kind in FEATURES:
        policy_features, baseline_features = _features(kind, settings.num_centers)
        algorithm = creps(
            policy_features,
            baseline_features,
            kl_bound=settings.kl_bound,
            archive_size=settings.archive_size,
            ridge=settings.ridge,
        )
        start = LinearGaussian(jnp.zeros((policy_features.size, 1)), settings.start_std * jnp.eye(1))
        keys = trial_keys(key, settings.trials)
        _, log = learn(keys, task, algorithm, start, plan, session=session, name=kind, devices=one_device)
        features = np.asarray(jax.vmap(policy_features.apply)(grid))
        means = (features @ log["coef"])[..., 0]
        arrays[f"{kind}.sample_reward"] = log["mean_reward"]
        arrays[f"{kind}.grid_reward"] = -np.mean((means - np.sin(arrays["context"])) ** 2, axis=-1)
        arrays[f"{kind}.kl"] = log["info.kl"]
        arrays[f"{kind}.mean"] = means[:, -1]
    return arrays


def plot(arrays: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """Draw the learning curves and the learned policies."""
    labels = {"linear": "linear features", "rbf": "RBF features"}
    panels = {
        title: {labels[kind]: (arrays["episodes"], arrays[f"{kind}.{field}"]) for kind in FEATURES}
        for title, field in (("New samples", "sample_reward"), ("Mean policy over a grid", "grid_reward"))
    }
    policies, axes = plots.new_figure(1, 2, width=9.0, height=3.4, sharey=True)
    context = arrays["context"]
    for column, kind in enumerate(FEATURES):
        plots.plot_policy(
            axes[0, column],
            context,
            arrays[f"{kind}.mean"],
            np.sin(context),
            title=labels[kind].capitalize().replace("Rbf", "RBF"),
            labels=("context s (rad)", "parameter"),
        )
    return {
        "learning_curve": plots.learning_curves(panels),
        "policies": policies,
    }


CLAIMS = (
    Claim(
        "RBF: reward of the mean policy, mean of trials",
        None,
        lambda arrays: arrays["rbf.grid_reward"][:, -1].mean(),
        low=-0.02,
    ),
    Claim(
        "linear: reward of the mean policy (the best affine policy has -0.48)",
        None,
        lambda arrays: arrays["linear.grid_reward"][:, -1].mean(),
        high=-0.3,
    ),
)


def _features(kind: str, num_centers: int) -> tuple[Any, Any]:
    """Return policy and baseline features; the RBFs serve as both."""
    if kind == "linear":
        return linear_features(1), quadratic_features(1)
    features = rbf_features(LOW, HIGH, num_centers)
    return features, features
