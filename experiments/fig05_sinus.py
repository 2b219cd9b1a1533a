"""Learn the sine of the context, with linear and with RBF features (Abdolmaleki et al. 2016, 4.1, Fig. 5)."""

import dataclasses
import math
from collections.abc import Mapping

import jax
import numpy as np
from matplotlib.figure import Figure

from creps_jax.contexts import context_grid
from creps_jax.features import linear_features, quadratic_features, rbf_features
from creps_jax.tasks.sinus import sinus
from experiments import plots
from experiments.comparison import compare, make_contender, mean_policy_curve, p_value
from experiments.learning import Plan, Session
from experiments.registry import Claim

LOW, HIGH = 0.0, 5 * math.pi
LABELS = {"linear": "Linear features", "rbf": "RBF features"}


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of the experiment; the paper gives samples, archive and KL bound.

    Attributes:
        iterations: iterations of learning.
        trials: trials of each curve; the paper has 5.
        samples: N, new samples of an iteration.
        archive_size: L, samples kept.
        kl_bound: epsilon, nats.
        num_centers: K; two centres a half-wave and one are enough to follow the sine.
        ridge: relative penalty on the policy's coefficients. Few contexts are drawn near the ends
            of the range, and without it some trials end with wild coefficients there.
        start_std: standard deviation of the first policy, whose mean is zero.
    """

    iterations: int = 150
    trials: int = 20
    samples: int = 40
    archive_size: int = 2000
    kl_bound: float = 0.5
    num_centers: int = 11
    ridge: float = 1e-3
    start_std: float = 1.0


SETTINGS = {"paper": Settings(), "quick": Settings(iterations=60, trials=5)}


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn with both kinds of features.

    Returns:
        The arrays of `compare`, with the contenders linear and rbf, and their last policies over the grid.
    """
    rbf = rbf_features(LOW, HIGH, settings.num_centers)
    features = {"linear": (linear_features(1), quadratic_features(1)), "rbf": (rbf, rbf)}
    task = sinus(LOW, HIGH)
    contenders = {name: make_contender(task, pair, settings) for name, pair in features.items()}
    plan = Plan(settings.iterations, settings.samples)
    grid = context_grid(LOW, HIGH, 201)
    arrays = compare(contenders, plan, key, trials=settings.trials, grid=grid, session=session)
    for name, (policy_features, _) in features.items():
        varphi = np.asarray(jax.vmap(policy_features.apply)(grid))
        arrays[f"{name}.mean"] = (varphi @ arrays[f"{name}.coef"])[..., 0]
    return arrays


def plot(arrays: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """Draw the learning curves and the learned policies."""
    curves = {LABELS[name]: mean_policy_curve(arrays, name) for name in LABELS}
    policies, axes = plots.new_figure(1, 2, width=9.0, height=3.4, sharey=True)
    context = arrays["context"][:, 0]
    for column, (name, label) in enumerate(LABELS.items()):
        plots.plot_policy(
            axes[0, column],
            context,
            arrays[f"{name}.mean"],
            np.sin(context),
            title=label,
            labels=("context s (rad)", "parameter"),
        )
    return {
        "learning_curve": plots.learning_curves({"Mean policy over a grid": curves}),
        "policies": policies,
    }


CLAIMS = (
    Claim(
        "RBFs learn it better than linear features: p of Wilcoxon's test",
        None,
        lambda arrays: p_value(arrays, "rbf", "linear"),
        high=0.05,
    ),
    Claim(
        "RBF: reward of the mean policy, mean of trials",
        None,
        lambda arrays: mean_policy_curve(arrays, "rbf")[1][:, -1].mean(),
        low=-0.02,
    ),
    Claim(
        "linear: reward of the mean policy (the best affine policy has -0.48)",
        None,
        lambda arrays: mean_policy_curve(arrays, "linear")[1][:, -1].mean(),
        high=-0.3,
    ),
)
