"""Draw learning curves, traces of the updates, and the values after learning."""

import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from creps_jax.tools.plots.style import COLOURS, PAPER_COLOUR, legend_entries, new_figure, new_panels

TRACES = {
    "kl": ("KL of the weights (nats)", False),
    "policy_kl": ("KL of the policy (nats)", True),
    "entropy": ("entropy of the policy (nats)", False),
    "effective_samples": ("effective samples", True),
    "p_value": ("p-value of the evidence", True),
}
"""Fields of `CrepsInfo` that are drawn: heading, and whether the axis is logarithmic."""


def plot_learning_curve(
    axes: Axes, episodes: np.ndarray, rewards: np.ndarray, label: str, *, colour: str | None = None
) -> None:
    """Draw trials, their mean and, for three trials or more, its 95 % interval.

    Args:
        axes: where to.
        episodes: (iterations,) rollouts so far.
        rewards: (trials, iterations) mean rewards; NaN leaves a gap.
        label: name of the curve; the number of trials is added.
        colour: the next colour by default.
    """
    rewards = np.atleast_2d(np.asarray(rewards, float))
    num_trials = len(rewards)
    mean = _mean_of_finite(rewards)
    (line,) = axes.plot(episodes, mean, color=colour, label=f"{label} (n = {num_trials})")
    if num_trials > 1:
        for trial in rewards:
            axes.plot(episodes, trial, color=line.get_color(), linewidth=0.6, alpha=0.35)
    if num_trials > 2:
        low, high = confidence_interval(rewards)
        axes.fill_between(episodes, low, high, color=line.get_color(), alpha=0.18, linewidth=0)


def confidence_interval(samples: np.ndarray, *, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Return the percentile bootstrap interval of the mean over the first axis, of the finite samples.

    Unlike Student's interval it stays within the samples: if they are negative, a logarithmic scale can show
    it.
    """
    samples = np.asarray(samples, float)
    rows = np.random.default_rng(0).integers(len(samples), size=(len(samples), 1000))
    means = _mean_of_finite(samples[rows])
    tail = 50 * (1 - level)
    is_known = np.isfinite(means).all(axis=0)
    bounds = np.percentile(np.where(is_known, means, 0.0), (tail, 100 - tail), axis=0)
    low, high = np.where(is_known, bounds, np.nan)
    return low, high


def reward_scale(axes: Axes, rewards: Sequence[np.ndarray]) -> None:
    """Scale the vertical axis as the paper does: by the logarithm of the negative reward.

    Positive rewards, and rewards within a factor of ten, keep a linear axis.
    """
    values = np.concatenate([np.ravel(np.asarray(reward, float)) for reward in rewards])
    values = values[np.isfinite(values)]
    if not len(values) or values.max() > 0:
        return
    missing = -values[values < 0]
    if not len(missing) or missing.max() < 10 * missing.min():
        return
    # Rewards above a millionth of the worst one are drawn as zero.
    threshold = max(missing.min(), 1e-6 * missing.max())
    axes.set_yscale("symlog", linthresh=threshold, linscale=0.3)
    decades = np.arange(math.floor(math.log10(threshold)), math.ceil(math.log10(missing.max())) + 1)
    decades = decades[:: math.ceil(len(decades) / 7)]
    axes.set_yticks([-(10.0**decade) for decade in decades])
    axes.set_ylim(-missing.max() * 1.5, -threshold * 0.5)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())


def learning_curves(
    panels: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]],
    *,
    references: Mapping[str, float] | None = None,
    columns: int | None = None,
    share: bool = True,
) -> Figure:
    """Draw learning curves of one or more algorithms, in panels.

    Args:
        panels: by title, curves: by name, (episodes (iterations,), rewards (trials, iterations)).
        references: horizontal lines by name, for example the paper's result.
        columns: panels side by side; all by default.
        share: whether all panels have the same scales.
    """
    columns = columns or len(panels)
    width = 6.4 if len(panels) == 1 else min(5.0, 14.0 / columns + 0.5)
    figure, grid, places = new_panels(
        len(panels), columns, width=width, height=3.4, margin=0.6, sharex=share, sharey=share
    )
    labels = dict.fromkeys(label for curves in panels.values() for label in curves)
    colours = dict(zip(labels, itertools.cycle(COLOURS), strict=False))
    for axes, (title, curves) in zip(places, panels.items(), strict=True):
        for label, (episodes, rewards) in curves.items():
            plot_learning_curve(axes, episodes, rewards, label, colour=colours[label])
        for label, value in (references or {}).items():
            axes.axhline(value, color=PAPER_COLOUR, linestyle="--", linewidth=1.2, label=label)
        _over_episodes(axes, title)
        if not share:
            reward_scale(axes, [rewards for _, rewards in curves.values()])
    for axes in grid[:, 0]:
        axes.set_ylabel("mean reward")
    # One legend for all panels, below them, where it hides no curve.
    lines, names = legend_entries(places)
    in_a_row = min(len(names), max(2, round(width * columns / 2.0)))
    figure.legend(lines, names, loc="outside lower center", ncols=in_a_row)
    if share:
        curves = [rewards for curves in panels.values() for _, rewards in curves.values()]
        reward_scale(grid[0, 0], curves)
    return figure


def update_traces(episodes: np.ndarray, traces: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """Draw traces of the updates: KL of the weights and of the policy, entropy, effective samples, p-value.

    Args:
        episodes: (iterations,) rollouts so far.
        traces: by name of the learner, and then of the field in `TRACES`, (trials, iterations).
    """
    figure, _, places = new_panels(len(TRACES), len(TRACES), width=3.6, height=3.4, margin=0.0)
    for axes, (field, (label, is_log)) in zip(places, TRACES.items(), strict=True):
        for name, fields in traces.items():
            plot_learning_curve(axes, episodes, fields[field], name)
        _over_episodes(axes, label)
        if is_log:
            axes.set_yscale("log")
    # A KL that is constant at its bound would be scaled to its rounding errors.
    highest = max(np.nanmax(fields[next(iter(TRACES))]) for fields in traces.values())
    places[0].set_ylim(0.0, 1.5 * highest + 1e-9)
    places[0].legend(loc="best", fontsize=8)
    return figure


def final_values(values: Mapping[str, np.ndarray], *, label: str, log: bool = False) -> Figure:
    """Draw a value of each trial of each contender, with the mean and its 95 % interval.

    Args:
        values: (trials,) by name of the contender.
        label: name of the value, with its unit.
        log: whether the axis is logarithmic.
    """
    figure, axes = new_figure(width=6.4, height=0.6 * len(values) + 1.6)
    axes = axes[0, 0]
    for row, trials in enumerate(values.values()):
        low, high = confidence_interval(trials)
        colour = COLOURS[row % len(COLOURS)]
        axes.plot(trials, np.full(len(trials), row), "o", color=colour, alpha=0.35, markersize=4)
        mean = float(np.mean(trials))
        axes.errorbar(mean, row, xerr=[[mean - low], [high - mean]], fmt="D", color=colour, capsize=4)
        axes.annotate(f"{mean:.3g}", (mean, row), xytext=(0, 7), textcoords="offset points", ha="center")
    positive = [value for trials in values.values() for value in trials if value > 0]
    if log and positive:
        # Zero can be drawn, too.
        axes.set_xscale("symlog", linthresh=min(positive))
    num_trials = len(next(iter(values.values())))
    axes.set_yticks(range(len(values)), labels=list(values))
    axes.set(xlabel=label, title=f"After learning (n = {num_trials}, mean and 95 % interval)")
    axes.margins(y=0.25)
    axes.invert_yaxis()
    return figure


def _over_episodes(axes: Axes, title: str) -> None:
    axes.set(xlabel="episodes of each trial", title=title)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))


def _mean_of_finite(samples: np.ndarray) -> np.ndarray:
    is_finite = np.isfinite(samples)
    total = np.where(is_finite, samples, 0.0).sum(axis=0)
    return np.where(is_finite.any(axis=0), total / np.maximum(is_finite.sum(axis=0), 1), np.nan)
