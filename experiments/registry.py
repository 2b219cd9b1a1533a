"""List the experiments by name, and load one when it is asked for."""

import importlib
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, cast

import numpy as np

from creps_jax.errors import UserError, suggest

DESCRIPTIONS = {
    "walk": "a NAO learns to walk at the speed you ask for (the main job)",
    "walk_slope": "the same up and down slopes: a context of speed and slope, learned from the shipped walk",
    "fig05_sinus": "learn the sine of the context, with linear and with RBF features (Fig. 5)",
    "fig06_reaching": "reach via-points with a planar arm (Fig. 6 and 7)",
    "fig08_hole": "reach into a hole with a planar arm (Fig. 8 and 9)",
    "fig11_walk": "ways to learn to walk: features, constraints, fits (Fig. 10, 11a and Table 2)",
    "walk_inside": "what is planned and what the robot does, in a walk that stays up and in one that falls",
    "updates": "the paper's fit of the policy against the bounded one, on all tasks but walking",
}
"""What each experiment shows; its module has the same name."""


ALL = "all"
"""Stands for `FIGURES`, one after the other."""

FIGURES = ("fig05_sinus", "fig06_reaching", "fig08_hole")


class Claim(NamedTuple):
    """Something that a figure or table of the paper says, and what we ask of ours.

    Attributes:
        metric: what is measured.
        paper: the paper's value; None where it prints none.
        measure: from an experiment's arrays to our value.
        low: the least that ours may be.
        high: the most that ours may be.
    """

    metric: str
    paper: float | None
    measure: Callable[[Mapping[str, np.ndarray]], float]
    low: float = -np.inf
    high: float = np.inf


class Experiment(Protocol):
    """What a module of an experiment has; it may also have `finish(settings, arrays, folder, say)`.

    Its settings may have `resolved()`, which returns them with all that defaults or the machine decide.
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
    if name not in DESCRIPTIONS:
        raise UserError(f"unknown experiment {name!r}{suggest(name, DESCRIPTIONS)}")


def load(name: str) -> Experiment:
    """Import the module of an experiment.

    Raises:
        UserError: if there is none of that name.
    """
    check_name(name)
    return cast(Experiment, importlib.import_module(f"experiments.{name}"))


def preset_settings(experiment: Experiment, preset: str) -> Any:
    """Return the settings of a preset.

    Raises:
        UserError: if the experiment has none of that name.
    """
    if preset not in experiment.SETTINGS:
        raise UserError(f"unknown preset {preset!r}{suggest(preset, experiment.SETTINGS)}")
    return experiment.SETTINGS[preset]
