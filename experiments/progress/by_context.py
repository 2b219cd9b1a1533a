"""Group the samples of the last iterations by context."""

import collections
import math
from typing import NamedTuple

import numpy as np

_KEPT_ITERATIONS = 10
_MOST_GROUPS = 9
_ROUND_STEPS = (1.0, 2.0, 2.5, 5.0)


class PooledSamples(NamedTuple):
    """The new samples of an iteration, of all trials (leading axis n).

    Attributes:
        context: the first context variable.
        reward: rewards.
        speed: reached speeds, m/s, if the context is the asked speed; None otherwise.
        fall_share: share of the rollouts of a sample with a fall; None if nothing can fall.
    """

    context: np.ndarray
    reward: np.ndarray
    speed: np.ndarray | None = None
    fall_share: np.ndarray | None = None


class Group(NamedTuple):
    """Means over samples of similar contexts: NaN without samples, None as in `PooledSamples`."""

    context: float
    reward: float
    speed: float | None = None
    fall_share: float | None = None


class Recent:
    """The samples of the last iterations."""

    def __init__(self) -> None:
        self._kept: collections.deque[PooledSamples] = collections.deque(maxlen=_KEPT_ITERATIONS)
        self._low, self._high = math.inf, -math.inf

    def __len__(self) -> int:
        return len(self._kept)

    def add(self, samples: PooledSamples) -> None:
        """Add an iteration; the oldest one is dropped if there are too many."""
        # The range only grows, so that the groups are stable.
        self._low = min(self._low, float(samples.context.min()))
        self._high = max(self._high, float(samples.context.max()))
        self._kept.append(samples)

    def groups(self, most: int) -> list[Group]:
        """Return at most `most` groups, one for each round number within the range so far."""
        kept = tuple(self._kept)  # another thread draws the view
        if not kept or most < 1:
            return []
        step = _round_step(self._low, self._high, min(most, _MOST_GROUPS))
        context, reward, *others = (
            None if fields[0] is None else np.concatenate(fields) for fields in zip(*kept, strict=True)
        )
        nearest = np.rint(np.asarray(context) / step)

        def group(number: int) -> Group:
            mask = nearest == number
            means = (None if values is None else _mean(values[mask]) for values in others)
            return Group(number * step, _mean(np.asarray(reward)[mask]), *means)

        return [group(number) for number in range(round(self._low / step), round(self._high / step) + 1)]


def _round_step(low: float, high: float, most: int) -> float:
    """Return the smallest round step with which the range has at most `most` groups."""
    power = math.floor(math.log10(max(high - low, 1e-3 * abs(high), 1e-9) / most))
    steps = (factor * 10.0**exponent for exponent in range(power, power + 4) for factor in _ROUND_STEPS)
    widest = 4 * max(abs(low), abs(high), 1e-9)
    return next((step for step in steps if round(high / step) - round(low / step) < most), widest)


def _mean(values: np.ndarray) -> float:
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if kept.size else math.nan
