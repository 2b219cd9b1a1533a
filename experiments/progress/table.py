"""Draw groups of samples as a table with bars."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from rich.text import Text

from experiments.progress.by_context import Group

_EIGHTHS = ("", "▏", "▎", "▍", "▌", "▋", "▊", "▉")
_LONGEST_BAR = 14
_SHORTEST_BAR = 4


class _Bar(NamedTuple):
    """The length of a bar and the place of a mark, as shares of the longest bar; NaN draws none."""

    share: float
    mark: float = math.nan


class _Column(NamedTuple):
    name: str
    texts: list[str]
    bars: list[_Bar]
    style: str = ""


def draw_table(groups: Sequence[Group], width: int, *, unicode: bool = True) -> list[Text]:
    """Lay out groups in lines: context, speed or reward, falls, and bars if there is room for them.

    The bar of a speed below the asked speed has a mark at the asked speed.

    Args:
        groups: the groups, all with the same fields.
        width: greatest length of a line, characters.
        unicode: whether the terminal can show block characters.

    Returns:
        The lines; the first one is the header. None without groups or room.
    """
    columns = _columns(groups) if groups else []
    widths = [max(map(len, (column.name, *column.texts))) for column in columns]
    free = width - sum(widths) - 2 * (len(columns) - 1)
    if not columns or free < 0:
        return []
    num_barred = sum(bool(column.bars) for column in columns)
    length = min(free // num_barred - 1, _LONGEST_BAR)
    lines = [Text(style="dim"), *(Text() for _ in groups)]
    for column, column_width in zip(columns, widths, strict=True):
        cells = [f"{text:>{column_width}}" for text in (column.name, *column.texts)]
        bars = [""] * len(cells)
        if column.bars and length >= _SHORTEST_BAR:
            bars = [" " * (length + 1), *(f" {_draw(bar, length, unicode)}" for bar in column.bars)]
        for line, cell, bar in zip(lines, cells, bars, strict=True):
            line.append(("  " if line else "") + cell).append(bar, style=column.style)
    return lines


def _columns(groups: Sequence[Group]) -> list[_Column]:
    contexts = [group.context for group in groups]
    columns = [_Column("context", [f"{context:g}" for context in contexts], [])]
    speeds = [group.speed for group in groups if group.speed is not None]
    if speeds:
        top = max(abs(value) for value in (*contexts, *speeds, 1e-9) if math.isfinite(value))
        bars = [_Bar(speed / top, asked / top) for speed, asked in zip(speeds, contexts, strict=True)]
        columns[0] = columns[0]._replace(name="asked")
        columns.append(_Column("walked", [_number(speed, ".2f") for speed in speeds], bars, "cyan"))
    else:
        rewards = [group.reward for group in groups]
        worst = min((reward for reward in rewards if reward < 0), default=-math.inf)
        bars = [_Bar(reward / worst) for reward in rewards]
        columns.append(_Column("reward", [_number(reward, "#.3g") for reward in rewards], bars, "yellow"))
    falls = [group.fall_share for group in groups if group.fall_share is not None]
    if falls:
        columns.append(
            _Column("falls", [_number(fall, ".0%") for fall in falls], list(map(_Bar, falls)), "red")
        )
    return columns


def _number(value: float, form: str) -> str:
    return f"{value:{form}}" if math.isfinite(value) else "-"


def _draw(bar: _Bar, length: int, unicode: bool) -> str:
    share = min(max(bar.share, 0.0), 1.0) if math.isfinite(bar.share) else 0.0
    full, rest = divmod(round(8 * length * share), 8)
    text = "█" * full + _EIGHTHS[rest] if unicode else "#" * (full + rest // 4)
    if math.isfinite(bar.mark) and math.isfinite(bar.share):
        place = min(max(round(bar.mark * length) - 1, 0), length - 1)
        if place >= len(text):
            text = f"{text:{place}}" + ("│" if unicode else "|")
    return f"{text:{length}}"
