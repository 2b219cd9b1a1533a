"""Measure the claims of an experiment on its results, and compare them with the paper's."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.tools import results
from creps_jax.tools.tables import to_markdown
from experiments import registry
from experiments.registry import Claim
from experiments.request import resolved_settings, settings_of

CLAIMS = "claims.md"


class Judged(NamedTuple):
    """A claim, and our value of its metric."""

    claim: Claim
    ours: float

    @property
    def holds(self) -> bool:
        """Whether our value is within the limits of the claim."""
        return self.claim.low <= self.ours <= self.claim.high


def check(names: tuple[str, ...], *, say: Callable[[str], None]) -> bool:
    """Print the claims of experiments with the values of their latest results; return whether all hold.

    Args:
        names: the experiments; all if empty. One without results is named, and its claims are not judged.
        say: prints one text.
    """
    all_hold = True
    for name in names or tuple(registry.EXPERIMENTS):
        experiment = registry.load(name)
        folder = results.latest_folder(name, status="finished", robot=registry.PAPER_ROBOT)
        if folder is None:
            say(f"{name}: no results yet (python -m experiments run {name})\n")
            continue
        with results.complete(folder):
            judged = judge(experiment, files.load_arrays(folder / results.ARRAYS))
        all_hold &= all(each.holds for each in judged)
        note = settings_note(experiment, results.load_manifest(folder))
        say(f"{name}: {folder}\n{note}\n\n{_table(judged)}")
    return all_hold


def judge(experiment: registry.Experiment, arrays: Mapping[str, np.ndarray]) -> list[Judged]:
    """Measure the claims of an experiment on the arrays of a result."""
    return [Judged(claim, float(claim.measure(arrays))) for claim in experiment.CLAIMS]


def save(experiment: registry.Experiment, manifest: Mapping[str, Any], arrays: Mapping, folder: Path) -> None:
    """Write the claims of an experiment into a result folder; nothing if it has none."""
    if experiment.CLAIMS:
        table = _table(judge(experiment, arrays))
        files.save_text(folder / CLAIMS, f"{settings_note(experiment, manifest)}\n\n{table}")


def settings_note(experiment: registry.Experiment, manifest: Mapping[str, Any]) -> str:
    """Say in one line whether a result has the settings of its preset, and name those that differ.

    The claims are judged with any settings: only the reader can tell which settings matter for a claim.
    """
    preset = str(manifest.get("preset"))
    if preset not in experiment.SETTINGS:
        return f"settings: not from a preset, but from {preset}; the claims are judged all the same"
    try:
        settings = settings_of(experiment, Path(results.MANIFEST), manifest)
    except UserError:
        return f"settings: preset {preset} of another version; the claims are judged all the same"
    changes = _changes(settings, experiment.SETTINGS[preset])
    if not changes:
        return f"settings: preset {preset}"
    return f"settings: preset {preset}, but {', '.join(changes)}; the claims are judged all the same"


def _changes(settings: Any, preset: Any) -> list[str]:
    """Name the settings that differ from a preset; what the preset leaves to the machine does not differ."""
    ours, wanted, printed = (_flat(each) for each in (settings, resolved_settings(preset), preset))
    return [
        f"{name} {value} (preset: {wanted[name]})"
        for name, value in ours.items()
        if value not in (wanted[name], printed[name]) and printed[name] != "auto"
    ]


def _flat(settings: Any, prefix: str = "") -> dict[str, Any]:
    """Return settings, and settings within them, by the names of their options."""
    flat: dict[str, Any] = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            flat |= _flat(value, f"{prefix}{field.name}.")
        else:
            flat[prefix + field.name] = value
    return flat


def _table(judged: list[Judged]) -> str:
    def number(value: float | None) -> str:
        return "-" if value is None or not np.isfinite(value) else f"{value:.4g}"

    columns = {
        "metric": [claim.metric for claim, _ in judged],
        "paper": [number(claim.paper) for claim, _ in judged],
        "ours": [number(ours) for _, ours in judged],
        "at least": [number(claim.low) for claim, _ in judged],
        "at most": [number(claim.high) for claim, _ in judged],
        "holds": ["yes" if each.holds else "NO" for each in judged],
    }
    return to_markdown(columns)
