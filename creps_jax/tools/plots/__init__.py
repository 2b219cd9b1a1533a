"""Draw figures in one style: learning curves, and what a policy does and reaches for each context."""

from creps_jax.tools.plots.arm import plot_ground, plot_postures
from creps_jax.tools.plots.contexts import (
    Map,
    context_maps,
    parameters_against_context,
    plot_policy,
    reached_against_asked,
)
from creps_jax.tools.plots.learning import (
    TRACES,
    confidence_interval,
    final_values,
    learning_curves,
    plot_learning_curve,
    reward_scale,
    update_traces,
)
from creps_jax.tools.plots.style import (
    COLOURS,
    FALL_COLOUR,
    PAPER_COLOUR,
    new_figure,
    new_panels,
    save_figure,
)

__all__ = [
    "COLOURS",
    "FALL_COLOUR",
    "PAPER_COLOUR",
    "TRACES",
    "Map",
    "confidence_interval",
    "context_maps",
    "final_values",
    "learning_curves",
    "new_figure",
    "new_panels",
    "parameters_against_context",
    "plot_ground",
    "plot_learning_curve",
    "plot_policy",
    "plot_postures",
    "reached_against_asked",
    "reward_scale",
    "save_figure",
    "update_traces",
]
