"""Draw figures in one style: learning curves, and what a policy does and reaches for each context."""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from creps_jax import files

COLOURS = ("#0072b2", "#d55e00", "#e69f00", "#009e73", "#cc79a7", "#56b4e9")
"""Colours that colour-blind people can tell apart (Okabe and Ito 2008)."""
PAPER_COLOUR = "#8a8a8a"
FALL_COLOUR = COLOURS[1]

TRACES = {
    "kl": ("KL of the weights (nats)", False),
    "policy_kl": ("KL of the policy (nats)", True),
    "entropy": ("entropy of the policy (nats)", False),
    "effective_samples": ("effective samples", True),
    "p_value": ("p-value of the evidence", True),
}
"""What updates are watched by, fields of `CrepsInfo`: heading, and whether the axis is logarithmic."""

_STYLE: dict[Any, Any] = {
    "figure.dpi": 110,
    "savefig.dpi": 150,
    "figure.constrained_layout.use": True,
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.8,
    "legend.framealpha": 0.85,
    "legend.edgecolor": "none",
    "lines.linewidth": 1.8,
    "axes.prop_cycle": cycler(color=COLOURS),
}
matplotlib.rcParams.update(_STYLE)


def new_figure(
    rows: int = 1, columns: int = 1, *, width: float = 6.4, height: float = 4.0, **settings: Any
) -> tuple[Figure, np.ndarray]:
    """Make a figure in the house style, and its axes as an array of shape (rows, columns).

    pyplot knows nothing of it: no screen is needed, and nothing has to be closed.
    """
    figure = Figure(figsize=(width, height))
    return figure, figure.subplots(rows, columns, squeeze=False, **settings)


def plot_learning_curve(
    axes: Axes, episodes: np.ndarray, rewards: np.ndarray, label: str, *, colour: str | None = None
) -> None:
    """Draw trials, their mean and, of three trials or more, its 95 % interval.

    Args:
        axes: where to.
        episodes: (iterations,) rollouts so far.
        rewards: (trials, iterations) mean rewards; NaN leaves a gap.
        label: the name of the curve; the number of trials is added.
        colour: by default the next one.
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
    """Return the percentile bootstrap interval of the mean over the first axis, ignoring what is not finite.

    Unlike Student's it stays among the samples: below zero, where a logarithmic scale has a place for it.
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
    """Scale the vertical axis as the paper does: the logarithm of what is missing to a reward of zero.

    Rewards that reach above zero, or span less than a factor of ten, keep a linear axis.
    """
    values = np.concatenate([np.ravel(np.asarray(reward, float)) for reward in rewards])
    values = values[np.isfinite(values)]
    if not len(values) or values.max() > 0:
        return
    missing = -values[values < 0]
    if not len(missing) or missing.max() < 10 * missing.min():
        return
    # Below a millionth of the worst reward a curve is as good as at zero.
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
        references: horizontal lines by name, the paper's result for example.
        columns: panels side by side; all by default.
        share: whether the panels share their scales.
    """
    columns = columns or len(panels)
    rows = math.ceil(len(panels) / columns)
    width = 6.4 if len(panels) == 1 else min(5.0, 14.0 / columns + 0.5) * columns
    figure, grid = new_figure(rows, columns, width=width, height=3.4 * rows + 0.6, sharex=share, sharey=share)
    labels = dict.fromkeys(label for curves in panels.values() for label in curves)
    colours = dict(zip(labels, itertools.cycle(COLOURS), strict=False))
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    for axes, (title, curves) in zip(grid.flat, panels.items(), strict=False):
        for label, (episodes, rewards) in curves.items():
            plot_learning_curve(axes, episodes, rewards, label, colour=colours[label])
        for label, value in (references or {}).items():
            axes.axhline(value, color=PAPER_COLOUR, linestyle="--", linewidth=1.2, label=label)
        _over_episodes(axes, title)
        if not share:
            reward_scale(axes, [rewards for _, rewards in curves.values()])
    for axes in grid[:, 0]:
        axes.set_ylabel("mean reward")
    # One for all panels, and below them, where it hides no curve.
    drawn = [axes.get_legend_handles_labels() for axes in grid.flat]
    handles = {label: handle for lines, names in drawn for handle, label in zip(lines, names, strict=True)}
    in_a_row = min(len(handles), max(2, round(width / 2.0)))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=in_a_row)
    if share:
        curves = [rewards for curves in panels.values() for _, rewards in curves.values()]
        reward_scale(grid[0, 0], curves)
    return figure


def update_traces(episodes: np.ndarray, traces: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """Draw how updates went: relative entropy of the weights and of the policy, entropy, effective samples.

    Args:
        episodes: (iterations,) rollouts so far.
        traces: by name of the learner, and then of the field in `TRACES`, (trials, iterations).
    """
    figure, grid = new_figure(1, len(TRACES), width=3.6 * len(TRACES), height=3.4)
    for axes, (field, (label, is_log)) in zip(grid[0], TRACES.items(), strict=True):
        for name, fields in traces.items():
            plot_learning_curve(axes, episodes, fields[field], name)
        _over_episodes(axes, label)
        if is_log:
            axes.set_yscale("log")
    # At the bound its rounding would fill the axes.
    highest = max(np.nanmax(fields[next(iter(TRACES))]) for fields in traces.values())
    grid[0, 0].set_ylim(0.0, 1.5 * highest + 1e-9)
    grid[0, 0].legend(loc="best", fontsize=8)
    return figure


def parameters_against_context(
    context: np.ndarray,
    theta: np.ndarray,
    *,
    names: Sequence[str],
    units: Sequence[str],
    low: Sequence[float] | np.ndarray,
    high: Sequence[float] | np.ndarray,
    context_label: str,
    title: str,
    chosen: int = 0,
) -> Figure:
    """Draw each parameter of a policy against its context, in its own units, as small multiples.

    Args:
        context: (n,) values of the context.
        theta: (trials, n, d) or (n, d) physical parameters.
        names: the d parameters, with `units` and the bounds `low` and `high`.
        units: an empty string is a number without a unit.
        low: lower bounds, drawn as thin lines, as are the upper ones.
        high: upper bounds.
        context_label: name and unit of the context.
        title: heading of the figure.
        chosen: the trial whose policy is drawn thick, where there are several.
    """
    theta = np.asarray(theta, float)
    theta = theta[None] if theta.ndim == 2 else theta
    others = np.delete(theta, chosen, axis=0)
    columns = min(5, len(names))
    rows = math.ceil(len(names) / columns)
    figure, grid = new_figure(rows, columns, width=2.6 * columns, height=2.1 * rows + 0.5, sharex=True)
    for index, axes in enumerate(grid.flat):
        if index >= len(names):
            axes.set_visible(False)
            continue
        for bound in (low[index], high[index]):
            axes.axhline(bound, color=PAPER_COLOUR, linewidth=0.8, linestyle=":")
        thin = {"linewidth": 0.8, "alpha": 0.5, "label": "of another trial"}
        thick = {"linewidth": 1.8, "label": "the policy that is kept"}
        axes.plot(context, others[..., index].T, color=COLOURS[0], **thin)
        axes.plot(context, theta[chosen, :, index], color=COLOURS[0], **thick)
        unit = f" ({units[index]})" if units[index] else ""
        axes.set_title(f"{names[index]}{unit}", fontsize=9)
    # The last row that is there labels each column.
    for column in range(columns):
        last = max(row for row in range(rows) if row * columns + column < len(names))
        grid[last, column].set_xlabel(context_label)
        grid[last, column].tick_params(labelbottom=True)
    if len(others):
        handles, labels = grid[0, 0].get_legend_handles_labels()
        once = dict(zip(labels, handles, strict=True))
        figure.legend(once.values(), once.keys(), loc="outside upper right", ncols=2)
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def reached_against_asked(
    asked: np.ndarray,
    reached: np.ndarray,
    fell: np.ndarray,
    *,
    title: str,
    paper: np.ndarray | None = None,
) -> Figure:
    """Draw the speed reached against the speed asked for: each seed, the median, and the falls.

    Args:
        asked: (n,) asked speeds, m/s.
        reached: (n, seeds) forward speeds, m/s.
        fell: (n, seeds) whether the robot fell.
        title: heading of the figure.
        paper: (n,) lowest speeds that the paper's rewards allow for, m/s.
    """
    asked, reached, fell = np.asarray(asked, float), np.asarray(reached, float), np.asarray(fell, bool)
    figure, axes = new_figure(width=5.4, height=4.6)
    axes = axes[0, 0]
    axes.plot(asked, asked, color="black", linewidth=1.0, linestyle="--", label="asked for")
    if paper is not None:
        axes.plot(asked, paper, color=PAPER_COLOUR, linewidth=1.2, label="paper, at least (from its rewards)")
    spacing = np.diff(asked).min() if len(asked) > 1 else 0.1
    # Seeds stand side by side, or they would hide each other.
    offset = np.linspace(-0.25, 0.25, reached.shape[1]) * spacing if reached.shape[1] > 1 else np.zeros(1)
    position = asked[:, None] + offset
    axes.scatter(
        position[~fell], reached[~fell], s=12, color=COLOURS[0], alpha=0.55, linewidth=0, label="a walk"
    )
    if fell.any():
        axes.scatter(
            position[fell], reached[fell], s=26, color=FALL_COLOUR, marker="x", label=f"a fall ({fell.sum()})"
        )
    median = np.array(
        [np.median(row[np.isfinite(row)]) if np.isfinite(row).any() else np.nan for row in reached]
    )
    axes.plot(asked, median, color=COLOURS[0], label=f"median of {reached.shape[1]} seeds")
    axes.set(xlabel="asked speed (m/s)", ylabel="reached speed (m/s)", title=title)
    axes.legend(loc="upper left")
    return figure


class Map(NamedTuple):
    """A number over two context variables.

    Attributes:
        values: (nx, ny).
        title: what it is, with its unit.
        limits: the values at both ends of the colours; by default the lowest and the highest.
        cell: how a number is written into its cell, "{:.0f}" for example; None leaves it to the colours.
        colours: a colour map of matplotlib.
    """

    values: np.ndarray
    title: str
    limits: tuple[float, float] | None = None
    cell: str | None = None
    colours: str = "viridis"


def context_maps(
    maps: Sequence[Map],
    x: np.ndarray,
    y: np.ndarray,
    *,
    labels: tuple[str, str],
    title: str,
    columns: int | None = None,
) -> Figure:
    """Draw numbers over two context variables as coloured cells, one map beside the other.

    Args:
        maps: what to draw.
        x: (nx,) values of the first context variable, equally spaced.
        y: (ny,) values of the second one.
        labels: names and units of the two.
        title: heading of the figure.
        columns: maps side by side; all by default.
    """
    columns = columns or len(maps)
    rows = math.ceil(len(maps) / columns)
    figure, grid = new_figure(
        rows,
        columns,
        width=min(4.4, 15.0 / columns) * columns,
        height=2.7 * rows + 0.5,
        sharex=True,
        sharey=True,
    )
    for axes in grid.flat[len(maps) :]:
        axes.set_visible(False)
    for axes, (values, heading, limits, cell, colours) in zip(grid.flat, maps, strict=False):
        low, high = limits or (np.nanmin(values), np.nanmax(values))
        mesh = axes.pcolormesh(x, y, values.T, vmin=low, vmax=high, cmap=colours, shading="nearest")
        figure.colorbar(mesh, ax=axes)
        axes.grid(False)
        axes.set_title(heading, fontsize=9)
        for (i, j), value in np.ndenumerate(values if cell is not None else np.empty((0, 0))):
            axes.text(
                x[i],
                y[j],
                str(cell).format(value),
                ha="center",
                va="center",
                fontsize=7,
                color=_ink(mesh, value),
            )
    for axes in grid[-1]:
        axes.set_xlabel(labels[0])
    for axes in grid[:, 0]:
        axes.set_ylabel(labels[1])
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)
    return figure


def _ink(mesh: QuadMesh, value: float) -> str:
    """Return the colour, black or white, in which text can be read on the colour of a value."""
    red, green, blue, _ = mesh.to_rgba(np.array([value]))[0]
    return "black" if 0.3 * red + 0.59 * green + 0.11 * blue > 0.5 else "white"


def plot_policy(
    axes: Axes,
    context: np.ndarray,
    means: np.ndarray,
    wanted: np.ndarray,
    *,
    title: str,
    labels: tuple[str, str],
) -> None:
    """Draw the mean of learned policies of one parameter over the context, beside the best answer.

    Args:
        axes: where to.
        context: (n,) contexts.
        means: (trials, n) means of the policies.
        wanted: (n,) the best parameter.
        title: heading of the axes.
        labels: names of the context and of the parameter.
    """
    axes.plot(context, wanted, color="black", linestyle="--", linewidth=1.2, label="optimum")
    for trial, mean in enumerate(np.atleast_2d(means)):
        label = f"learned (n = {len(means)})" if trial == 0 else None
        axes.plot(context, mean, color=COLOURS[0], linewidth=1.2, alpha=0.8, label=label)
    axes.set(xlabel=labels[0], ylabel=labels[1], title=title)
    axes.margins(y=0.2)
    axes.legend(loc="upper center", ncols=2)


def final_values(values: Mapping[str, np.ndarray], *, label: str, log: bool = False) -> Figure:
    """Draw one number of each trial of each contender, with the mean and its 95 % interval.

    Args:
        values: (trials,) by name.
        label: name of the number, with its unit.
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
        # Zero keeps its place.
        axes.set_xscale("symlog", linthresh=min(positive))
    num_trials = len(next(iter(values.values())))
    axes.set_yticks(range(len(values)), labels=list(values))
    axes.set(xlabel=label, title=f"After learning (n = {num_trials}, mean and 95 % interval)")
    axes.margins(y=0.25)
    axes.invert_yaxis()
    return figure


def plot_postures(axes: Axes, points: np.ndarray, *, num: int = 21) -> None:
    """Draw postures of an arm over time, later ones darker.

    Args:
        axes: where to.
        points: (n, k, 2) ends of the links at each time, m.
        num: number of postures, equally spaced in time, the last one among them.
    """
    shown = np.linspace(0, len(points) - 1, num).round().astype(int)
    for share, index in zip(np.linspace(0.1, 1.0, num), shown, strict=True):
        axes.plot(
            *points[index].T, color=COLOURS[0], alpha=share**1.5, linewidth=2.0, marker="o", markersize=3
        )
    axes.plot(*points[:, -1].T, color=COLOURS[2], linewidth=1.0)
    axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")


def plot_ground(axes: Axes, center: float, width: float, depth: float) -> None:
    """Draw the ground with its hole, m."""
    left, right = center - 0.5 * width, center + 0.5 * width
    low, high = axes.get_xlim()
    x = [min(low, -1.0), left, left, right, right, max(high, 3.0)]
    axes.plot(x, [0.0, 0.0, -depth, -depth, 0.0, 0.0], color=FALL_COLOUR, linewidth=1.5)


def _over_episodes(axes: Axes, title: str) -> None:
    axes.set(xlabel="episodes of each trial", title=title)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))


def _mean_of_finite(samples: np.ndarray) -> np.ndarray:
    is_finite = np.isfinite(samples)
    total = np.where(is_finite, samples, 0.0).sum(axis=0)
    return np.where(is_finite.any(axis=0), total / np.maximum(is_finite.sum(axis=0), 1), np.nan)


def save_figure(path: Path, figure: Any) -> None:
    """Write a matplotlib figure as PNG, atomically."""
    files.write_atomically(path, lambda file: figure.savefig(file, format="png"))
