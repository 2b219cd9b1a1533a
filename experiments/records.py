"""Name the arrays of a result: the one place that knows how names are put together.

A file of results is flat: the array `reward` of the contender `rbf` has the name `rbf.reward`. A `Part` shows
the arrays of one contender under their own names.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from creps_jax.tools import plots

Arrays = Mapping[str, np.ndarray]


class Part(Mapping[str, np.ndarray]):
    """The arrays of a part of a result by their own names; a KeyError has the full name."""

    def __init__(self, arrays: Arrays, name: str, separator: str = "."):
        self._arrays, self._prefix = arrays, name + separator

    def __getitem__(self, field: str) -> np.ndarray:
        return self._arrays[self._prefix + field]

    def __iter__(self) -> Iterator[str]:
        return (name.removeprefix(self._prefix) for name in self._arrays if name.startswith(self._prefix))

    def __len__(self) -> int:
        return sum(1 for _ in self)


def named(name: str, fields: Mapping[str, Any], separator: str = ".") -> dict[str, np.ndarray]:
    """Return the arrays of a part by their full names."""
    return {f"{name}{separator}{field}": np.asarray(values) for field, values in fields.items()}


def parts_with(arrays: Arrays, field: str) -> list[str]:
    """Return the names of the parts that have an array, in the order of the file."""
    return [name.removesuffix(f".{field}") for name in arrays if name.endswith(f".{field}")]


def traces(arrays: Arrays) -> dict[str, np.ndarray]:
    """Return the arrays (trials, iterations) that `plots.update_traces` draws."""
    return {field: arrays[field] for field in plots.TRACES}


class Learning(NamedTuple):
    """How learning went.

    Attributes:
        episodes: (iterations,) rollouts of a trial so far.
        mean_reward: (trials, iterations) mean reward of the new samples.
        traces: fields of `plots.TRACES`, (trials, iterations).
    """

    episodes: np.ndarray
    mean_reward: np.ndarray
    traces: dict[str, np.ndarray]

    @classmethod
    def of(cls, arrays: Arrays) -> "Learning":
        """Read it from a result that has a log."""
        log = Part(arrays, "log")
        return cls(arrays["episodes"], log["mean_reward"], traces(Part(log, "info")))


class Walks(NamedTuple):
    """The outcome of walks; the last of the leading axes are the seeds.

    Attributes:
        reward: rewards.
        speed: forward and leftward speed (..., 2), m/s.
        fell: whether the robot fell.
    """

    reward: np.ndarray
    speed: np.ndarray
    fell: np.ndarray

    @classmethod
    def of(cls, arrays: Arrays, trial: int | None = None) -> "Walks":
        """Read the walks of a result or of a part of it, for all trials or for one."""
        rows = (arrays[field] for field in cls._fields)
        return cls(*(values if trial is None else values[trial] for values in rows))
