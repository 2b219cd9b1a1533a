"""Draw policies, and what they reach, over the context."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure

from creps_jax.tools.plots.style import (
    COLOURS,
    FALL_COLOUR,
    PAPER_COLOUR,
    head,
    label_columns,
    legend_entries,
    new_figure,
    new_panels,
)


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
    """Draw each parameter of a policy against its context, in a panel of its own.

    Args:
        context: (n,) values of the context.
        theta: (trials, n, d) or (n, d) physical parameters.
        names: names of the d parameters.
        units: their units; an empty string is none.
        low: their lower bounds, drawn as thin lines.
        high: their upper bounds, drawn as thin lines.
        context_label: name and unit of the context.
        title: heading of the figure.
        chosen: the trial whose policy is drawn as a thick line.
    """
    theta = np.asarray(theta, float)
    theta = theta[None] if theta.ndim == 2 else theta
    others = np.delete(theta, chosen, axis=0)
    figure, grid, panels = new_panels(len(names), min(5, len(names)), width=2.6, height=2.1, sharex=True)
    for index, axes in enumerate(panels):
        for bound in (low[index], high[index]):
            axes.axhline(bound, color=PAPER_COLOUR, linewidth=0.8, linestyle=":")
        thin = {"linewidth": 0.8, "alpha": 0.5, "label": "another trial"}
        thick = {"linewidth": 1.8, "label": "saved policy"}
        axes.plot(context, others[..., index].T, color=COLOURS[0], **thin)
        axes.plot(context, theta[chosen, :, index], color=COLOURS[0], **thick)
        unit = f" ({units[index]})" if units[index] else ""
        axes.set_title(f"{names[index]}{unit}", fontsize=9)
    label_columns(grid, len(names), context_label)
    if len(others):
        figure.legend(*legend_entries(panels[:1]), loc="outside upper right", ncols=2)
    head(figure, title)
    return figure


def reached_against_asked(
    asked: np.ndarray,
    reached: np.ndarray,
    fell: np.ndarray,
    *,
    title: str,
    paper: np.ndarray | None = None,
) -> Figure:
    """Draw the reached speed against the asked speed: each seed, the median, and the falls.

    Args:
        asked: (n,) asked speeds, m/s.
        reached: (n, seeds) forward speeds, m/s.
        fell: (n, seeds) whether the robot fell.
        title: heading of the figure.
        paper: (n,) lowest speeds that are possible with the paper's rewards, m/s.
    """
    asked, reached, fell = np.asarray(asked, float), np.asarray(reached, float), np.asarray(fell, bool)
    figure, axes = new_figure(width=5.4, height=4.6)
    axes = axes[0, 0]
    axes.plot(asked, asked, color="black", linewidth=1.0, linestyle="--", label="asked speed")
    if paper is not None:
        axes.plot(
            asked, paper, color=PAPER_COLOUR, linewidth=1.2, label="paper: lower limit, from its rewards"
        )
    spacing = np.diff(asked).min() if len(asked) > 1 else 0.1
    # Seeds are drawn side by side, so that they do not hide each other.
    offset = np.linspace(-0.25, 0.25, reached.shape[1]) * spacing if reached.shape[1] > 1 else np.zeros(1)
    position = asked[:, None] + offset
    axes.scatter(
        position[~fell], reached[~fell], s=12, color=COLOURS[0], alpha=0.55, linewidth=0, label="walk"
    )
    if fell.any():
        axes.scatter(
            position[fell], reached[fell], s=26, color=FALL_COLOUR, marker="x", label=f"fall ({fell.sum()})"
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
        title: name of the number, with its unit.
        limits: the values at both ends of the colour map; by default the lowest and the highest.
        cell: format of the number in its cell, for example "{:.0f}"; None writes none.
        colours: name of a colour map of matplotlib.
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
        maps: the maps.
        x: (nx,) values of the first context variable, equally spaced.
        y: (ny,) values of the second context variable, equally spaced.
        labels: names and units of both.
        title: heading of the figure.
        columns: maps side by side; all by default.
    """
    columns = columns or len(maps)
    width = min(4.4, 15.0 / columns)
    figure, grid, panels = new_panels(len(maps), columns, width=width, height=2.7, sharex=True, sharey=True)
    for axes, (values, heading, limits, cell, colours) in zip(panels, maps, strict=True):
        low, high = limits or (np.nanmin(values), np.nanmax(values))
        mesh = axes.pcolormesh(x, y, values.T, vmin=low, vmax=high, cmap=colours, shading="nearest")
        figure.colorbar(mesh, ax=axes)
        axes.grid(False)
        axes.set_title(heading, fontsize=9)
        if cell is not None:
            for (i, j), value in np.ndenumerate(values):
                place = float(x[i]), float(y[j])
                text = axes.text(*place, cell.format(value), ha="center", va="center", fontsize=7)
                text.set_color(_ink(mesh, value))
    label_columns(grid, len(maps), labels[0])
    for axes in grid[:, 0]:
        axes.set_ylabel(labels[1])
    head(figure, title)
    return figure


def _ink(mesh: QuadMesh, value: float) -> str:
    """Return black or white: the colour of a text that is readable on the colour of a value."""
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
    """Draw the means of learned policies of one parameter over the context, and the optimum.

    Args:
        axes: where to.
        context: (n,) contexts.
        means: (trials, n) means of the policies.
        wanted: (n,) the optimal parameter.
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
