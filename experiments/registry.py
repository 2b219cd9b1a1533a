"""List the experiments by name, and import one when a command needs it."""

import importlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, cast

import numpy as np

from creps_jax.errors import UserError, suggest


class Entry(NamedTuple):
    """What `list` shows of an experiment without importing its module.

    Attributes:
        description: one line.
        presets: the names of its SETTINGS; the first one is the default.
    """

    description: str
    presets: tuple[str, ...]


EXPERIMENTS = {
    "walk": Entry(
        "a robot learns to walk at a given speed (the main experiment)",
        ("quick", "humanoid", "paper", "author", "best"),
    ),
    "walk_slope": Entry(
        "the same up and down slopes: the context is speed and slope; starts from the shipped walk",
        ("quick", "best"),
    ),
    "steer": Entry(
        "learn to walk at any command: forward, backward, sideways and turning, from scratch", ("quick",)
    ),
    "fig05_sinus": Entry(
        "learn the sine of the context, with linear and with RBF features (Fig. 5)", ("paper", "quick")
    ),
    "fig06_reaching": Entry("reach via-points with a planar arm (Fig. 6 and 7)", ("paper", "quick")),
    "fig08_hole": Entry("reach into a hole with a planar arm (Fig. 8 and 9)", ("paper", "quick")),
    "fig11_walk": Entry(
        "compare features, constraints and fits of a walk (Fig. 10, 11a and Table 2)",
        ("quick", "paper", "best"),
    ),
    "walk_inside": Entry("measure plan and motion of a walk that stays up and of one that falls", ("quick",)),
    "updates": Entry(
        "compare the paper's fit of the policy with the bounded fit, on all tasks but walking",
        ("best", "quick"),
    ),
    "policies": Entry(
        "compare RBFs, polynomials, a Gaussian process and a network on the paper's four tasks",
        ("quick", "full"),
    ),
}
"""The experiments by name, which is also the name of the module."""

PAPER_ROBOT = "nao"
"""The robot of the paper: claims are judged on its walks."""

ALL = "all"
"""Stands for `FIGURES`, one after the other."""

FIGURES = ("fig05_sinus", "fig06_reaching", "fig08_hole")


class Claim(NamedTuple):
    """A statement of a figure or table of the paper, and the limits within which our value must be.

    Attributes:
        metric: what is measured.
        measure: from an experiment's arrays to our value.
        low: lower limit.
        high: upper limit.
        paper: the paper's value; None if it prints none.
    """

    metric: str
    measure: Callable[[Mapping[str, np.ndarray]], float]
    low: float = -np.inf
    high: float = np.inf
    paper: float | None = None


class Experiment(Protocol):
    """What the module of an experiment must have.

    It may also have `table(arrays)`, the columns of table.md, and `finish(settings, arrays, folder, say)`,
    which writes more files. Its settings may have `resolved()`, which returns them with a value in place of
    each default that depends on the robot or the machine.
    """

    Settings: type[Any]
    SETTINGS: Mapping[str, Any]
    CLAIMS: tuple[Claim, ...]

    def run(self, settings: Any, key: Any, session: Any) -> dict[str, np.ndarray]:
        """Compute the arrays of the experiment."""
        ...

    def plot(self, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """Draw its figures, by file name without ending."""
        ...


def check_name(name: str) -> None:
    """Refuse a name that no experiment has.

    Raises:
        UserError: with the nearest name, and all of them.
    """
    if name not in EXPERIMENTS:
        raise UserError(f"unknown experiment {name!r}{suggest(name, EXPERIMENTS)}")


def check_preset(name: str, preset: str) -> None:
    """Refuse a preset that an experiment does not have.

    Raises:
        UserError: with the nearest preset, and all of them.
    """
    if preset not in EXPERIMENTS[name].presets:
        raise UserError(f"unknown preset {preset!r}{suggest(preset, EXPERIMENTS[name].presets)}")


def load(name: str) -> Experiment:
    """Import the module of an experiment.

    Raises:
        UserError: if there is none of that name.
    """
    check_name(name)
    return cast(Experiment, importlib.import_module(f"experiments.{name}"))
