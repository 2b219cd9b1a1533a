"""Compare ways to learn to walk (Abdolmaleki et al. 2016, 4.3, Fig. 10, 11a and Table 2)."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from creps_jax.policies.feature_settings import Features
from creps_jax.tools import plots
from creps_jax.tools.tables import PAPER_LINEAR, PAPER_RBF, save_table
from experiments import comparison, walk
from experiments.comparison import signed_rank_p
from experiments.learning import Session
from experiments.registry import Claim

_PAPER = {
    field.name: getattr(walk.SETTINGS["paper"], field.name)
    for field in dataclasses.fields(walk.Settings)
    if field.name not in ("robot", "low", "high", "iterations", "trials", "eval_seeds", "physics")
}
_PLAIN = (
    "samples",
    "first_samples",
    "repeats",
    "archive_size",
    "kl_bound",
    "mean_kl_bound",
    "cov_kl_bound",
    "significance",
)
CONTENDERS: dict[str, dict[str, Any]] = {
    "rbf": {},
    "linear": {"features": Features("linear")},
    "unbounded": {"mean_kl_bound": None, "cov_kl_bound": None, "significance": None},
    "penalty": {"features": Features("linear"), "constraint": "penalty"},
    "plain": {name: _PAPER[name] for name in _PLAIN},
    "paper": _PAPER,
}
"""What each changes of the settings; the paper compares constraints with linear policies.

`unbounded` has the paper's fit and our samples and archive, `plain` has all of the paper's algorithm, `paper`
its whole protocol: also its box of parameters, engine, noise, contexts and length of episodes. These two have
other numbers of samples in the first iteration and after it, so that their episodes are others, too. With the
settings of the preset `paper` they are `rbf`.
"""

LABELS = {
    "rbf": "RBFs",
    "linear": "linear",
    "penalty": "linear, penalty",
    "unbounded": "RBFs, weighted ML",
    "plain": "plain C-REPS",
    "paper": "the paper's protocol",
}
PANELS = {
    "Constraints (Fig. 10)": ("linear", "penalty"),
    "Features (Fig. 11a)": ("linear", "rbf"),
    "Fits": ("unbounded", "rbf"),
    "Protocols": ("paper", "plain", "rbf"),
}
_SMOOTHED = 450
"""Rollouts, the last ones, whose mean reward tells how far learning is: one fall in them is -0.2."""

Settings = walk.Settings
SETTINGS = {
    "quick": dataclasses.replace(walk.SETTINGS["quick"], iterations=70, trials=5),
    "paper": walk.SETTINGS["paper"],
    "best": dataclasses.replace(walk.SETTINGS["best"], trials=5),
}


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Let all contenders learn from the same keys, and walk at the paper's speeds with fresh seeds.

    Returns:
        `speeds` (n,), and for each NAME: `NAME.episodes` (iterations,), `NAME.sample_reward` and
        `NAME.sample_fell` (trials, iterations), `NAME.reward`, `NAME.fell` (trials, n, seeds) and
        `NAME.speed` (trials, n, seeds, 2). Also `rbf.halfway_reward` (trials, n, seeds), after half of the
        episodes of `plain`.
    """
    evaluate_key, learn_key = jax.random.split(key)
    arrays, policies = {}, {}
    for name, changes in CONTENDERS.items():
        changed = dataclasses.replace(settings, **changes)
        states, log = walk.learn_to_walk(changed, learn_key, session=session, name=name)
        policies[name] = states.policy, log["coef"]
        speeds, outcome = walk.walk_at_all_speeds(changed, evaluate_key, states.policy)
        arrays["speeds"] = speeds
        # A resumed run may have gone on for longer than is asked of it now.
        arrays[f"{name}.episodes"] = walk.make_plan(changed).episodes(np.arange(1, settings.iterations + 1))
        arrays[f"{name}.sample_reward"] = log["mean_reward"][:, : settings.iterations]
        arrays[f"{name}.sample_fell"] = log["outcome.fell"][:, : settings.iterations]
        for field in ("reward", "fell", "speed"):
            arrays[f"{name}.{field}"] = getattr(outcome, field)
    is_within = arrays["rbf.episodes"] <= arrays["plain.episodes"][-1] / 2
    final, coefs = policies["rbf"]
    halfway = final._replace(coef=coefs[:, max(is_within.sum() - 1, 0)])
    _, outcome = walk.walk_at_all_speeds(settings, evaluate_key, halfway)
    arrays["rbf.halfway_reward"] = outcome.reward
    return arrays


def final_reward(arrays: Mapping[str, np.ndarray], name: str) -> np.ndarray:
    """Return the mean reward (trials,) of each trial's mean policy over all speeds and seeds."""
    return arrays[f"{name}.reward"].mean(axis=(1, 2))


def p_value(arrays: Mapping[str, np.ndarray], better: str, worse: str) -> float:
    """Return how likely rewards so much in favour of `better` are if it is no better, by Wilcoxon's test."""
    return signed_rank_p(final_reward(arrays, better) - final_reward(arrays, worse))


def share_of_episodes(arrays: Mapping[str, np.ndarray], reference: str) -> float:
    """Return after which share of another's episodes the bounded fit is as good as that is after all."""
    episodes, bounded = _smoothed(arrays, "rbf")
    others, rewards = _smoothed(arrays, reference)
    return comparison.share_of_episodes(episodes, bounded, rewards, total=others[-1])


def halfway_lack(arrays: Mapping[str, np.ndarray]) -> float:
    """Return what our policies lack to reward zero after half of plain C-REPS's episodes, over its own lack.

    Of mean policies, by the medians of the trials: samples tell less, as each search explores by its own
    covariance.
    """
    ours = -np.median(arrays["rbf.halfway_reward"].mean(axis=(1, 2)))
    return float(ours / -np.median(final_reward(arrays, "plain")))


def _smoothed(arrays: Mapping[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return how many rollouts there were (k,), and the mean rewards (trials, k) of the last `_SMOOTHED`."""
    episodes, rewards = arrays[f"{name}.episodes"], arrays[f"{name}.sample_reward"]
    # All iterations but the first have as many; a single one has no difference.
    in_iteration = np.diff(episodes).max(initial=1)
    width = max(1, min(round(_SMOOTHED / in_iteration), rewards.shape[1]))
    windows = np.lib.stride_tricks.sliding_window_view(rewards, width, axis=1)
    return episodes[width - 1 :], windows.mean(axis=2)


def table(arrays: Mapping[str, np.ndarray]) -> dict[str, list[object]]:
    """Return Table 2 with the medians of our trials, and their falls, beside the paper's."""
    columns: dict[str, list[object]] = {"asked m/s": [round(float(speed), 3) for speed in arrays["speeds"]]}
    for name, label in LABELS.items():
        columns[label] = [float(value) for value in np.median(arrays[f"{name}.reward"].mean(axis=2), axis=0)]
        falls = arrays[f"{name}.fell"]
        columns[f"{label}: falls"] = [f"{int(fell.sum())}/{fell.size}" for fell in np.swapaxes(falls, 0, 1)]
    columns |= {"paper RBF": list(PAPER_RBF), "paper linear": list(PAPER_LINEAR)}
    return columns


def plot(arrays: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """Draw Fig. 10 and 11a, and what each way came to."""
    panels = {
        title: {LABELS[name]: (arrays[f"{name}.episodes"], arrays[f"{name}.sample_reward"]) for name in names}
        for title, names in PANELS.items()
    }
    missing = {label: -final_reward(arrays, name) for name, label in LABELS.items()}
    return {
        "learning_curve": plots.learning_curves(panels),
        "final": plots.final_values(missing, label="what the mean reward lacks to zero", log=True),
    }


def finish(settings: Settings, arrays: Mapping[str, np.ndarray], folder: Path, say: Callable) -> None:
    """Write and say the table."""
    del settings
    save_table(table(arrays), folder, say)


CLAIMS = (
    Claim(
        "squashed parameters walk better than penalised ones: p of Wilcoxon's test",
        None,
        lambda arrays: p_value(arrays, "linear", "penalty"),
        high=0.05,
    ),
    Claim(
        "RBFs walk better than linear policies: p of the same test",
        None,
        lambda arrays: p_value(arrays, "rbf", "linear"),
        high=0.05,
    ),
    Claim(
        "lack of the bounded fit's policies at half of plain C-REPS's episodes, over that one's in the end",
        None,
        halfway_lack,
        high=1.0,
    ),
    Claim(
        "share of the episodes of plain C-REPS after which samples of the bounded fit are as good",
        None,
        lambda arrays: share_of_episodes(arrays, "plain"),
        high=0.5,
    ),
    Claim(
        "the same, for weighted ML with our samples and archive",
        None,
        lambda arrays: share_of_episodes(arrays, "unbounded"),
        high=0.5,
    ),
)
