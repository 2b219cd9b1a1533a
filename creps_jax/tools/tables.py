"""Tables of results and of the paper, as CSV or Markdown."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from creps_jax import files

# Table 2 of Abdolmaleki et al. 2016: asked speeds (m/s), and the rewards of both policies.
PAPER_SPEEDS = (0.10, 0.15, 0.20, 0.25, 0.30, 0.35, 0.40, 0.45, 0.50, 0.55, 0.60)
PAPER_LINEAR = (
    -1.057,
    -0.800,
    -0.043,
    -0.139,
    -0.633,
    -0.353,
    -3338.082,
    -0.168,
    -0.77,
    -3336.321,
    -3339.157,
)
PAPER_RBF = (-0.166, -0.011, -0.0196, -0.077, -0.026, -0.546, -0.220, -0.206, -0.366, -1.221, -0.911)


def to_csv(columns: Mapping[str, Sequence[object]]) -> str:
    """Write columns of equal length as CSV."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()


def to_markdown(columns: Mapping[str, Sequence[object]]) -> str:
    """Write columns of equal length as a Markdown table; floats get three decimals."""
    rows = [[_cell(value) for value in row] for row in zip(*columns.values(), strict=True)]
    widths = [max([len(name), *(len(row[i]) for row in rows)]) for i, name in enumerate(columns)]

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.rjust(width) for cell, width in zip(cells, widths, strict=True)) + " |"

    rule = "|" + "|".join("-" * (width + 1) + ":" for width in widths) + "|"
    return "\n".join([line(list(columns)), rule, *map(line, rows)]) + "\n"


def save_table(columns: Mapping[str, Sequence[object]], folder: Path, say: Callable[[str], None]) -> None:
    """Write a table into a result folder as Markdown, and print it."""
    text = to_markdown(columns)
    files.save_text(folder / "table.md", text)
    say(text)


def speed_table(
    asked: np.ndarray, reward: np.ndarray, speed: np.ndarray, fell: np.ndarray
) -> dict[str, list[object]]:
    """Return the evaluation of a walking policy as columns, at the paper's speeds with its rewards.

    Args:
        asked: (n,) asked speeds, m/s.
        reward: (n, seeds) rewards.
        speed: (n, seeds, 2) forward and leftward speed, m/s.
        fell: (n, seeds) whether the robot fell.
    """
    columns: dict[str, list[object]] = {
        "asked m/s": [round(float(value), 3) for value in asked],
        "reached m/s": [float(value) for value in speed[..., 0].mean(axis=1)],
        "sideways m/s": [float(value) for value in np.abs(speed[..., 1]).mean(axis=1)],
        "falls": [f"{int(row.sum())}/{len(row)}" for row in fell],
        "reward": [float(value) for value in reward.mean(axis=1)],
    }
    if are_the_papers(asked):
        columns |= {"paper RBF": list(PAPER_RBF), "paper linear": list(PAPER_LINEAR)}
    return columns


def are_the_papers(asked: np.ndarray) -> bool:
    """Return whether speeds (m/s) are the speeds of the paper's Table 2."""
    return len(asked) == len(PAPER_SPEEDS) and np.allclose(asked, PAPER_SPEEDS, atol=1e-4)


def _cell(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)
