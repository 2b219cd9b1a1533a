"""Lay out the progress of a run in lines that fit a terminal of any size."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from rich.text import Text

from experiments.progress.by_context import Recent
from experiments.progress.curve import draw_curve
from experiments.progress.table import draw_table

# Sizes in characters and lines, and a share of the width.
_WIDEST = 110
_HIGHEST_CURVE = 12
_LOWEST_CURVE = 5
_NARROWEST_CURVE = 36
_GAP = 3
_TABLE_SHARE = 0.42
_NARROWEST_TABLE = 24
_FEWEST_GROUPS = 3


class View(NamedTuple):
    """The content of the view.

    Attributes:
        title: name of the run.
        iterations: number of iterations of the run.
        done: number of iterations done.
        cells: names and values, as text.
        rewards: mean reward of each iteration so far.
        recent: the samples of the last iterations.
    """

    title: str
    iterations: int
    done: int
    cells: Sequence[tuple[str, str]]
    rewards: Sequence[float]
    recent: Recent


def draw(view: View, width: int, height: int, *, unicode: bool = True) -> list[Text]:
    """Draw the view in at most `height` lines of at most `width` characters.

    A short terminal shows no table, and a shorter one no curve.
    """
    width = min(width, _WIDEST)
    lines = [Text(view.title, style="bold"), _bar(view, width, unicode), *_flow(view.cells, width)]
    rows = height - len(lines) - 1
    body = _body(view, width, rows, unicode)
    if body:
        lines += [Text(), *body]
    lines = lines[: max(height, 1)]
    for line in lines:
        line.truncate(width)
    return lines


def _bar(view: View, width: int, unicode: bool) -> Text:
    full, empty = "━─" if unicode else "#."
    share = min(view.done / view.iterations, 1.0) if view.iterations else 1.0
    length = math.floor(share * width)
    return Text(full * length, style="green").append(empty * (width - length), style="bright_black")


def _flow(cells: Sequence[tuple[str, str]], width: int) -> list[Text]:
    """Lay out names and values side by side, in lines of at most `width` characters."""
    lines = [Text()]
    for name, value in cells:
        cell = Text.assemble((name, "dim"), " " * bool(name), value)
        if len(lines[-1]) and len(lines[-1]) + 3 + len(cell) > width:
            lines.append(Text())
        if len(lines[-1]):
            lines[-1].append("   ")
        lines[-1].append_text(cell)
    return lines


def _body(view: View, width: int, rows: int, unicode: bool) -> list[Text]:
    """Put the table beside the curve, or below it in a narrow terminal."""
    table_width = max(round(_TABLE_SHARE * width), _NARROWEST_TABLE)
    if width - table_width - _GAP < _NARROWEST_CURVE:
        rows_of_table = rows - max(_LOWEST_CURVE, rows // 2)
        table = _table(view.recent, width, rows_of_table, unicode)
        return [*_curve(view, width, min(rows - len(table), _HIGHEST_CURVE), unicode), *table]
    table = _table(view.recent, table_width, rows, unicode)
    curve_width = width - max(map(len, table), default=-_GAP) - _GAP
    lines = _curve(view, curve_width, min(rows, _HIGHEST_CURVE), unicode)
    for line, beside in zip(lines, table, strict=False):
        line.pad_right(curve_width + _GAP - len(line))
        line.append_text(beside)
    return lines


def _curve(view: View, width: int, height: int, unicode: bool) -> list[Text]:
    lines = draw_curve(view.rewards, width, height - 1, unicode=unicode)
    if not lines:
        return []
    drawn = [Text().append(line, style="dim") for line in lines]
    for line in drawn:
        line.highlight_regex("[\u2800-\u28ff*]+", "not dim green")
    return [Text().append("mean reward of an iteration", style="dim"), *drawn]


def _table(recent: Recent, width: int, rows: int, unicode: bool) -> list[Text]:
    most = rows - 2
    groups = recent.groups(most) if most >= _FEWEST_GROUPS else []
    lines = draw_table(groups, width, unicode=unicode)
    if not lines:
        return []
    span = f"last {len(recent)} iterations" if len(recent) > 1 else "last iteration"
    what = "by context" if groups[0].speed is None else "speeds in m/s"
    return [Text(f"{span}, {what}", style="dim"), *lines]
