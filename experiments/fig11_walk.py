"""Compare features, constraints and fits of a walk (Abdolmaleki et al. 2016, 4.3, Fig. 10, 11a, Table 2)."""

import dataclasses
from functools import partial
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure

from creps_jax.policies.feature_settings import Features
from creps_jax.tools import plots
from creps_jax.tools.tables import PAPER_LINEAR, PAPER_RBF
from experiments import comparison
from experiments.comparison import signed_rank_p
from experiments.learning import Session
from experiments.records import Arrays, Part, Walks, named
from experiments.registry import Claim
from experiments.walking import learning
from experiments.walking.settings import SETTINGS as WALK_SETTINGS
from experiments.walking.settings import Settings

_PAPER = {
    field.name: getattr(WALK_SETTINGS["paper"], field.name)
    for field in dataclasses.fields(Settings)
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
"""The settings that each contender changes; the paper compares constraints with linear policies.

`unbounded` has the paper's fit with our samples and archive. `plain` has the paper's algorithm. `paper` has
the paper's protocol: also its bounds, engine, noise, contexts and length of episodes. The last two have other
numbers of samples in an iteration, and therefore other episodes. With the preset `paper` they are the same as
`rbf`.
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
"""Rollouts over which rewards of samples are averaged: one fall among them is -0.2."""

SETTINGS = {
    "quick": dataclasses.replace(
        WALK_SETTINGS["best"],
        iterations=70,
        trials=5,
        samples=45,
        first_samples=45,
        repeats=2,
        archive_size=225,
        learning_duration=5.0,
        eval_seeds=10,
    ),
    "paper": WALK_SETTINGS["paper"],
    "best": dataclasses.replace(WALK_SETTINGS["best"], trials=5),
}


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Let all contenders learn from the same keys, and walk at the paper's speeds with fresh seeds.

    Returns:
        `speeds` (n,), and a part for each contender: `episodes` (iterations,), `sample_reward` and
        `sample_fell` (trials, iterations), and the fields of `Walks` (trials, n, seeds, ...). The part `rbf`
        also has `halfway_reward` (trials, n, seeds), after half of the episodes of `plain`.
    """
    evaluate_key, learn_key = jax.random.split(key)
    arrays, policies = {}, {}
    for name, changes in CONTENDERS.items():
        changed = dataclasses.replace(settings, **changes)
        states, log = learning.learn_to_walk(changed, learn_key, session=session, name=name)
        policies[name] = states.policy, log["coef"]
        speeds, outcome = learning.walk_at_all_speeds(changed, evaluate_key, states.policy)
        arrays["speeds"] = speeds
        # The log of a resumed run may be longer than the iterations of this one.
        curves = {
            "episodes": learning.make_plan(changed).episodes(np.arange(1, settings.iterations + 1)),
            "sample_reward": log["mean_reward"][:, : settings.iterations],
            "sample_fell": Part(log, "outcome")["fell"][:, : settings.iterations],
        }
        arrays |= named(name, {**curves, **Walks.of(outcome._asdict())._asdict()})
    rbf, plain = Part(arrays, "rbf"), Part(arrays, "plain")
    is_within = rbf["episodes"] <= plain["episodes"][-1] / 2
    final, coefs = policies["rbf"]
    halfway = final._replace(coef=coefs[:, max(is_within.sum() - 1, 0)])
    _, outcome = learning.walk_at_all_speeds(settings, evaluate_key, halfway)
    return arrays | named("rbf", {"halfway_reward": outcome.reward})


def final_reward(arrays: Arrays, name: str) -> np.ndarray:
    """Return the mean reward (trials,) of each trial's mean policy over all speeds and seeds."""
    return Part(arrays, name)["reward"].mean(axis=(1, 2))


def p_value(arrays: Arrays, better: str, worse: str) -> float:
    """Return the p-value of Wilcoxon's test that the rewards of `better` are higher."""
    return signed_rank_p(final_reward(arrays, better) - final_reward(arrays, worse))


def share_of_episodes(arrays: Arrays, reference: str) -> float:
    """Return the share of a contender's episodes after which the bounded fit reaches its last reward."""
    episodes, bounded = _smoothed(arrays, "rbf")
    others, rewards = _smoothed(arrays, reference)
    return comparison.share_of_episodes(episodes, bounded, rewards, total=others[-1])


def halfway_ratio(arrays: Arrays) -> float:
    """Return our reward after half of the episodes of plain C-REPS, divided by its last reward.

    Both are medians of the trials, and rewards of mean policies: rewards of samples depend on the covariance.
    """
    ours = -np.median(Part(arrays, "rbf")["halfway_reward"].mean(axis=(1, 2)))
    return float(ours / -np.median(final_reward(arrays, "plain")))


def _sample_curve(arrays: Arrays, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the episodes (iterations,), and the mean rewards of the new samples (trials, iterations)."""
    part = Part(arrays, name)
    return part["episodes"], part["sample_reward"]


def _smoothed(arrays: Arrays, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the episodes (k,), and the mean rewards (trials, k) of the last `_SMOOTHED` rollouts."""
    episodes, rewards = _sample_curve(arrays, name)
    # All iterations except the first have the same number of rollouts; a single one has no difference.
    in_iteration = np.diff(episodes).max(initial=1)
    width = max(1, min(round(_SMOOTHED / in_iteration), rewards.shape[1]))
    windows = np.lib.stride_tricks.sliding_window_view(rewards, width, axis=1)
    return episodes[width - 1 :], windows.mean(axis=2)


def table(arrays: Arrays) -> dict[str, list[object]]:
    """Return Table 2: medians and falls of our trials, and the paper's values."""
    columns: dict[str, list[object]] = {"asked m/s": [round(float(speed), 3) for speed in arrays["speeds"]]}
    for name, label in LABELS.items():
        walks = Walks.of(Part(arrays, name))
        columns[label] = [float(value) for value in np.median(walks.reward.mean(axis=2), axis=0)]
        columns[f"{label}: falls"] = [f"{int(row.sum())}/{row.size}" for row in walks.fell.swapaxes(0, 1)]
    columns |= {"paper RBF": list(PAPER_RBF), "paper linear": list(PAPER_LINEAR)}
    return columns


def plot(arrays: Arrays) -> dict[str, Figure]:
    """Draw Fig. 10 and 11a, and the last reward of each contender."""
    panels = {
        title: {LABELS[name]: _sample_curve(arrays, name) for name in names}
        for title, names in PANELS.items()
    }
    missing = {label: -final_reward(arrays, name) for name, label in LABELS.items()}
    return {
        "learning_curve": plots.learning_curves(panels),
        "final": plots.final_values(missing, label="negative mean reward", log=True),
    }


CLAIMS = (
    Claim(
        "squashed parameters walk better than penalised ones: p of Wilcoxon's test",
        partial(p_value, better="linear", worse="penalty"),
        high=0.05,
    ),
    Claim(
        "RBFs walk better than linear policies: p of the same test",
        partial(p_value, better="rbf", worse="linear"),
        high=0.05,
    ),
    Claim(
        "reward of the bounded fit after half of plain C-REPS's episodes, divided by its last reward",
        halfway_ratio,
        high=1.0,
    ),
    Claim(
        "share of plain C-REPS's episodes after which samples of the bounded fit reach its last reward",
        lambda arrays: share_of_episodes(arrays, "plain"),
        high=0.5,
    ),
    Claim(
        "the same for weighted ML with our samples and archive",
        lambda arrays: share_of_episodes(arrays, "unbounded"),
        high=0.5,
    ),
)
