"""Draw the planar arm and the ground."""

import numpy as np
from matplotlib.axes import Axes

from creps_jax.tools.plots.style import COLOURS, FALL_COLOUR


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
