"""The style of all figures, and what they are put together from."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from creps_jax import files

COLOURS = ("#0072b2", "#d55e00", "#e69f00", "#009e73", "#cc79a7", "#56b4e9")
"""Colours that colour-blind people can distinguish (Okabe and Ito 2008)."""
PAPER_COLOUR = "#8a8a8a"
FALL_COLOUR = COLOURS[1]

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
    """Make a figure, and its axes as an array of shape (rows, columns).

    It is made without pyplot: it needs no screen, and need not be closed.
    """
    figure = Figure(figsize=(width, height))
    return figure, figure.subplots(rows, columns, squeeze=False, **settings)


def new_panels(
    num: int, columns: int, *, width: float, height: float, margin: float = 0.5, **settings: Any
) -> tuple[Figure, np.ndarray, list[Axes]]:
    """Make a figure of panels, and return it, its axes (rows, columns), and the axes of the panels.

    Args:
        num: number of panels; the places after the last one stay empty.
        columns: panels side by side.
        width: width of a panel, inches.
        height: height of a panel, inches.
        margin: height for what belongs to no panel, inches.
        settings: further settings of `Figure.subplots`.
    """
    rows = math.ceil(num / columns)
    figure, grid = new_figure(rows, columns, width=width * columns, height=height * rows + margin, **settings)
    for axes in grid.flat[num:]:
        axes.set_visible(False)
    return figure, grid, list(grid.flat[:num])


def label_columns(grid: np.ndarray, num: int, label: str) -> None:
    """Write a label below the last panel of each column."""
    for column, axes in enumerate(grid.T):
        last = axes[(num - 1 - column) // len(grid.T)]
        last.set_xlabel(label)
        last.tick_params(labelbottom=True)


def head(figure: Figure, title: str) -> None:
    """Write a heading above all panels."""
    figure.suptitle(title, x=0.01, ha="left", fontweight="bold", fontsize=11)


def legend_entries(panels: Iterable[Axes]) -> tuple[list[Any], list[str]]:
    """Return the lines and the labels of panels, each label once, for a legend of the figure."""
    drawn = [axes.get_legend_handles_labels() for axes in panels]
    lines = {label: line for lines, labels in drawn for line, label in zip(lines, labels, strict=True)}
    return list(lines.values()), list(lines)


def save_figure(path: Path, figure: Any) -> None:
    """Write a matplotlib figure as PNG, atomically."""
    files.write_atomically(path, lambda file: figure.savefig(file, format="png"))
