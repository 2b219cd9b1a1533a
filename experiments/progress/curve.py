"""Draw a learning curve in characters, a few lines high, with both axes."""

import math
from collections.abc import Sequence

import numpy as np

_BRAILLE = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""The value of each dot in the code of a braille character."""
_SPAN_OF_LOG = 30.0
"""Negative rewards that differ by more than this factor are drawn on a logarithmic scale."""


def draw_curve(rewards: Sequence[float], width: int, height: int, *, unicode: bool = True) -> list[str]:
    """Draw rewards against iterations, on a logarithmic scale of negative rewards if they differ by much.

    Args:
        rewards: mean reward of each iteration; numbers that are not finite leave a gap.
        width: characters of each line, including the axis.
        height: number of lines, including the axis.
        unicode: whether the terminal can show braille and line characters.

    Returns:
        The lines; none without rewards or room.
    """
    rows = height - 1
    finite = [reward for reward in rewards if math.isfinite(reward)]
    if not finite or rows < 2:
        return []
    scale = _Scale(finite)
    labels = scale.labels(rows)
    margin = max(map(len, labels.values()))
    columns = width - margin - 2
    if columns < 8:
        return []
    dots = (2, 4) if unicode else (1, 1)
    heights = scale.to_unit(_resample(rewards, scale, columns * dots[0]))
    pixels = _trace(heights, rows * dots[1])
    tick, line, corner, dash = "┤│└─" if unicode else "+|+-"
    drawn = _braille(pixels) if unicode else ["".join(" *"[dot] for dot in row) for row in pixels]
    lines = [
        f"{labels.get(row, ''):>{margin}} {tick if row in labels else line}{text}"
        for row, text in enumerate(drawn)
    ]
    first, last = "1 ", f" {len(rewards):,}"
    name = f"{' iteration ' if columns > 24 else '':{dash}^{max(columns - len(first + last), 0)}}"
    return [*lines, f"{'':{margin}} {corner}{first}{name}{last}"[:width]]


class _Scale:
    """The vertical scale of the drawing, from 0 at the bottom to 1 at the top."""

    def __init__(self, rewards: Sequence[float]):
        losses = [-reward for reward in rewards if reward < 0]
        self._least_loss = min(losses, default=0.0)
        self._is_log = max(rewards) <= 0 and max(losses, default=0.0) > _SPAN_OF_LOG * self._least_loss
        self._low, self._high = (float(self.place(pick(rewards))) for pick in (min, max))

    def place(self, reward: np.ndarray | float) -> np.ndarray:
        """Return the places of rewards: the rewards, or minus the logarithm of negative rewards."""
        if not self._is_log:
            return np.asarray(reward, float)
        return -np.log10(np.maximum(-np.asarray(reward, float), self._least_loss))

    def to_unit(self, places: np.ndarray) -> np.ndarray:
        """Return places as shares of the height."""
        span = self._high - self._low
        return (places - self._low) / span if span > 0 else np.where(np.isfinite(places), 0.5, np.nan)

    def labels(self, rows: int) -> dict[int, str]:
        """Return the labels of rows, counted from the top: round numbers if at least two fit."""
        best: dict[int, str] = {}
        for ticks in self._tick_sets():
            shares = self.to_unit(self.place(np.array(ticks)))
            places = [round((1 - share) * (rows - 1)) for share in shares]
            is_spaced = np.all(np.abs(np.diff(places)) >= 2)
            if is_spaced and len(places) > len(best):
                best = {place: f"{tick:g}" for place, tick in zip(places, ticks, strict=True)}
        if len(best) >= 2:
            return best
        ends = {rows - 1: self._low, 0: self._high} if self._high > self._low else {rows // 2: self._low}
        return {row: f"{-(10**-place) if self._is_log else place:.3g}" for row, place in ends.items()}

    def _tick_sets(self) -> list[list[float]]:
        """List sets of round numbers within the scale."""
        span = self._high - self._low
        if not span > 1e-300:
            return []
        if self._is_log:
            decades = range(math.floor(-self._high), math.ceil(-self._low) + 1)
            sets = [[-(10.0**d) for d in decades if d % step == 0] for step in (3, 2, 1)]
            sets.append([-factor * 10.0**decade for decade in decades for factor in (1, 2, 5)])
        else:
            power = 10.0 ** math.floor(math.log10(span))
            steps = [factor * power for factor in (10, 5, 2, 1)]
            sets = [
                [k * step for k in range(math.ceil(self._low / step), math.floor(self._high / step) + 1)]
                for step in steps
            ]
        slack = 1e-6 * span
        places = [[(tick, float(self.place(tick))) for tick in ticks] for ticks in sets]
        return [
            [tick for tick, place in pairs if self._low - slack <= place <= self._high + slack]
            for pairs in places
        ]


def _resample(rewards: Sequence[float], scale: _Scale, columns: int) -> np.ndarray:
    """Return a place for each column: means of several rewards, or interpolated ones."""
    values = np.asarray(rewards, float)
    if len(values) > columns:
        chunks = np.split(values, np.arange(1, columns) * len(values) // columns)
        kept = [chunk[np.isfinite(chunk)] for chunk in chunks]
        return scale.place(np.array([chunk.mean() if chunk.size else np.nan for chunk in kept]))
    places = scale.place(np.where(np.isfinite(values), values, np.nan))
    return np.interp(np.linspace(0, len(values) - 1, columns), np.arange(len(values)), places)


def _trace(heights: np.ndarray, rows: int) -> np.ndarray:
    """Set the pixels (rows, n) of a line through heights (n,) between 0 and 1; NaN leaves a gap."""
    pixels = np.zeros((rows, len(heights)), int)
    before = None
    for column, height in enumerate(heights):
        if not math.isfinite(height):
            before = None
            continue
        row = round((1 - min(max(height, 0.0), 1.0)) * (rows - 1))
        # Start next to the last row, so that steep lines are one dot wide.
        start = row if before is None else before + int(np.sign(row - before))
        pixels[min(start, row) : max(start, row) + 1, column] = 1
        before = row
    return pixels


def _braille(pixels: np.ndarray) -> list[str]:
    """Pack pixels (4 rows, 2 columns) into characters."""
    blocks = pixels.reshape(pixels.shape[0] // 4, 4, -1, 2)
    codes = np.einsum("ridj,ij->rd", blocks, _BRAILLE)
    return ["".join(chr(0x2800 + code) if code else " " for code in row) for row in codes]
