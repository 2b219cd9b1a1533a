"""Reach via-points with a planar arm (Abdolmaleki et al. 2016, 4.2, Fig. 6 and 7)."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from creps_jax.contexts import context_grid, gaussian_contexts, uniform_contexts
from creps_jax.policies.features import FeatureMap, linear_features, quadratic_features, rbf_features
from creps_jax.tasks.planar_arm import arm_points, via_point_movement, via_point_reaching
from creps_jax.tools import plots
from experiments.comparison import (
    LearnerSettings,
    compare,
    last_regrets,
    learning_panels,
    make_contender,
    p_value,
    postures,
)
from experiments.learning import Session
from experiments.records import Arrays, Part
from experiments.registry import Claim

LOW, HIGH = (-1.5, -1.5), (-0.5, -0.5)
SHOWN = ((-1.25, -0.75), (-0.75, -1.25))
LABELS = {
    "linear": "linear",
    "rbf": "RBFs",
    "quadratic": "quadratic",
    "uniform": "linear, uniform contexts",
}


@dataclasses.dataclass(frozen=True)
class Settings(LearnerSettings):
    """Settings of the experiment; the unit of parameters, and so of `start_std`, is rad.

    Attributes:
        num_centers: K, along each of the two contexts; the paper has 2 RBFs and does not say how they lie.
        bandwidth: width sigma of the RBFs, m; as printed its square is (max - min) / K.
    """

    iterations: int = 2000
    first_samples: int | None = 2000
    num_centers: int = 2
    bandwidth: float = 0.5**0.5


# RBFs need half of the iterations to catch up: with fewer iterations or trials the claims do not hold.
SETTINGS = {"paper": Settings(), "quick": Settings(trials=10)}


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn with linear and RBF features, with quadratic ones, and with uniform contexts.

    The paper has no quadratic policies. Their features are the linear features and the squares of the
    contexts: they contain the linear policies, and show how much a better policy can gain.

    Returns:
        The arrays of `compare`, with the contenders linear, rbf, quadratic and uniform.
    """
    linear = (linear_features(2), quadratic_features(2))
    quadratic = _linear_and_squares()
    rbf = rbf_features(LOW, HIGH, settings.num_centers, bandwidth=settings.bandwidth)
    gaussian, uniform = gaussian_contexts(LOW, HIGH, clip=True), uniform_contexts(LOW, HIGH)
    contenders = {
        name: make_contender(via_point_reaching(LOW, HIGH, sample_context=sampler), features, settings)
        for name, features, sampler in (
            ("linear", linear, gaussian),
            ("rbf", (rbf, rbf), gaussian),
            ("quadratic", (quadratic, quadratic), gaussian),
            ("uniform", linear, uniform),
        )
    }
    grid = context_grid(LOW, HIGH, 6)
    arrays = compare(contenders, settings, key, grid=grid, session=session)
    shown = {name: contenders[name] for name in ("linear", "rbf")}
    return arrays | postures(
        arrays, shown, jnp.array(SHOWN), lambda theta: jax.vmap(arm_points)(via_point_movement(theta).pos)
    )


def _linear_and_squares() -> FeatureMap:
    """Make the features [1, u, u^2] of contexts u that are scaled to [-1, 1]."""
    middle, half = (0.5 * (np.array(HIGH) + sign * np.array(LOW)) for sign in (1, -1))

    def apply(context: jax.Array) -> jax.Array:
        scaled = (context - jnp.asarray(middle, context.dtype)) / jnp.asarray(half, context.dtype)
        return jnp.concatenate([jnp.ones_like(scaled[:1]), scaled, scaled**2])

    return FeatureMap(apply, 5, 2)


def plot(arrays: Arrays) -> dict[str, Figure]:
    """Draw Fig. 6a and 6b, the last regrets, and the arm's postures (Fig. 7)."""
    panels = {
        "Policies": ("linear", "rbf", "quadratic"),
        "Contexts": ("linear", "uniform"),
    }
    figure, axes = plots.new_figure(2, len(SHOWN), width=8.0, height=7.4)
    for row, name in enumerate(("linear", "rbf")):
        for column, point in enumerate(SHOWN):
            plots.plot_postures(axes[row, column], Part(arrays, name)["postures"][column])
            axes[row, column].plot(*point, "x", color=plots.FALL_COLOUR, markersize=10, markeredgewidth=2)
            axes[row, column].set_title(f"{LABELS[name]}: via-point ({point[0]:g}, {point[1]:g})")
    return {
        "learning_curve": plots.learning_curves(learning_panels(arrays, panels, LABELS)),
        "final": plots.final_values(last_regrets(arrays, LABELS), label="regret over the grid", log=True),
        "postures": figure,
    }


CLAIMS = (
    Claim(
        "RBFs reach as well as linear policies: p of Wilcoxon's test that they are worse",
        partial(p_value, better="linear", worse="rbf"),
        low=0.05,
    ),
    Claim(
        "quadratic policies reach better than linear ones: p of the same test",
        partial(p_value, better="quadratic", worse="linear"),
        high=0.05,
    ),
    Claim(
        "Gaussian contexts are better than uniform ones: p of the same test",
        partial(p_value, better="linear", worse="uniform"),
        high=0.05,
    ),
)
