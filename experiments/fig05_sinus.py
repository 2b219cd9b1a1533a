"""Learn the sine of the context, with linear and with RBF features (Abdolmaleki et al. 2016, 4.1, Fig. 5)."""

import dataclasses
import math
from functools import partial

import jax
import numpy as np
from matplotlib.figure import Figure

from creps_jax.contexts import context_grid
from creps_jax.policies.features import linear_features, quadratic_features, rbf_features
from creps_jax.tasks.sine import sinus
from creps_jax.tools import plots
from experiments.comparison import (
    LearnerSettings,
    compare,
    learning_panels,
    make_contender,
    mean_policy_curve,
    mean_thetas,
    p_value,
)
from experiments.learning import Session
from experiments.records import Arrays, Part, named
from experiments.registry import Claim

LOW, HIGH = 0.0, 5 * math.pi
LABELS = {"linear": "Linear features", "rbf": "RBF features"}


@dataclasses.dataclass(frozen=True)
class Settings(LearnerSettings):
    """Settings of the experiment.

    Few contexts are drawn near the ends of the range. Without a larger ridge some trials end with very large
    coefficients there.

    Attributes:
        num_centers: K; two centres for each half-wave and one more are enough to follow the sine.
    """

    iterations: int = 150
    ridge: float = 1e-3
    num_centers: int = 11


SETTINGS = {"paper": Settings(), "quick": Settings(iterations=60, trials=5)}


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn with both kinds of features.

    Returns:
        The arrays of `compare`, with the contenders linear and rbf, and the `mean` (trials, n) of their last
        policies over the grid.
    """
    rbf = rbf_features(LOW, HIGH, settings.num_centers)
    features = {"linear": (linear_features(1), quadratic_features(1)), "rbf": (rbf, rbf)}
    task = sinus(LOW, HIGH)
    contenders = {name: make_contender(task, pair, settings) for name, pair in features.items()}
    grid = context_grid(LOW, HIGH, 201)
    arrays = compare(contenders, settings, key, grid=grid, session=session)
    for name, contender in contenders.items():
        means = [mean_thetas(contender, coef, grid)[:, 0] for coef in Part(arrays, name)["coef"]]
        arrays |= named(name, {"mean": np.stack(means)})
    return arrays


def plot(arrays: Arrays) -> dict[str, Figure]:
    """Draw the learning curves and the learned policies."""
    policies, axes = plots.new_figure(1, 2, width=9.0, height=3.4, sharey=True)
    context = arrays["context"][:, 0]
    for column, (name, label) in enumerate(LABELS.items()):
        plots.plot_policy(
            axes[0, column],
            context,
            Part(arrays, name)["mean"],
            np.sin(context),
            title=label,
            labels=("context s (rad)", "parameter"),
        )
    panels = {"Mean policy over a grid": LABELS}
    return {
        "learning_curve": plots.learning_curves(learning_panels(arrays, panels, LABELS)),
        "policies": policies,
    }


CLAIMS = (
    Claim(
        "RBFs learn better than linear features: p of Wilcoxon's test",
        partial(p_value, better="rbf", worse="linear"),
        high=0.05,
    ),
    Claim(
        "RBF: reward of the mean policy, mean of trials",
        lambda arrays: mean_policy_curve(arrays, "rbf")[1][:, -1].mean(),
        low=-0.02,
    ),
    Claim(
        "linear: reward of the mean policy (the best affine policy has -0.48)",
        lambda arrays: mean_policy_curve(arrays, "linear")[1][:, -1].mean(),
        high=-0.3,
    ),
)
