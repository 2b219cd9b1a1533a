"""Reach into a hole with a planar arm (Abdolmaleki et al. 2016, 4.2, Fig. 8 and 9)."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from creps_jax.contexts import context_grid
from creps_jax.errors import UserError
from creps_jax.policies.features import linear_features, quadratic_features, rbf_features
from creps_jax.tasks.planar_arm import arm_points, hole_movement, hole_reaching
from creps_jax.tools import plots
from experiments.comparison import (
    Contender,
    LearnerSettings,
    compare,
    last_regrets,
    learning_panels,
    make_contender,
    mean_thetas,
    p_value,
    postures,
)
from experiments.learning import Session
from experiments.records import Arrays, Part, named, parts_with
from experiments.registry import Claim

LOW, HIGH = 1.4, 2.0
WIDTH, DEPTH = 0.3, 1.0
SHOWN = (1.5, 2.0)
# The paper's choice.
SHOWN_RBF = "rbf6"


@dataclasses.dataclass(frozen=True)
class Settings(LearnerSettings):
    """Settings of the experiment; the unit of parameters, and so of `start_std`, is rad.

    Attributes:
        num_centers: the numbers K of RBFs; the paper tries 2 to 20.
    """

    first_samples: int | None = 2000
    start_std: float = 0.5
    num_centers: tuple[int, ...] = (2, 4, 6, 10, 20)

    def __post_init__(self) -> None:
        if 6 not in self.num_centers:
            raise UserError(f"num_centers must have 6, the paper's, among them, got {self.num_centers}")


# With fewer trials or episodes 6 RBFs are not significantly better than a linear policy.
SETTINGS = {"paper": Settings(), "quick": Settings(trials=10, num_centers=(6,))}


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn with linear features and with several numbers of RBFs.

    Returns:
        The arrays of `compare`, with the contenders linear, rbf2, rbf4 and so on.
    """
    task = hole_reaching(LOW, HIGH, width=WIDTH, depth=DEPTH)
    features = {"linear": (linear_features(1), quadratic_features(1))}
    for num in settings.num_centers:
        rbf = rbf_features(LOW, HIGH, num)
        features[f"rbf{num}"] = (rbf, rbf)
    contenders = {name: make_contender(task, pair, settings) for name, pair in features.items()}
    grid = context_grid(LOW, HIGH, 25)
    arrays = compare(contenders, settings, key, grid=grid, session=session)
    for name, contender in contenders.items():
        collides = map(partial(_collides, contender, grid), Part(arrays, name)["coef"])
        arrays |= named(name, {"collides": np.stack(list(collides))})
    shown = {name: contenders[name] for name in ("linear", SHOWN_RBF)}
    contexts = jnp.array(SHOWN)[:, None]
    return arrays | postures(
        arrays, shown, contexts, lambda theta: jax.vmap(arm_points)(hole_movement(theta).pos)
    )


def plot(arrays: Arrays) -> dict[str, Figure]:
    """Draw Fig. 8a and 8b, the last regrets, and the arm's postures (Fig. 9)."""
    labels = {
        name: "linear" if name == "linear" else f"{name.removeprefix('rbf')} RBFs" for name in _names(arrays)
    }
    panels = {
        "Linear and RBF policies": ("linear", SHOWN_RBF),
        "Number of RBFs": [name for name in labels if name != "linear"],
    }
    figure, axes = plots.new_figure(2, len(SHOWN), width=8.0, height=8.0)
    for row, name in enumerate(("linear", SHOWN_RBF)):
        part = Part(arrays, name)
        for column, center in enumerate(SHOWN):
            plots.plot_postures(axes[row, column], part["postures"][column])
            plots.plot_ground(axes[row, column], center, WIDTH, DEPTH)
            nearest = np.abs(arrays["context"][:, 0] - center).argmin()
            reward = part["grid_reward"][0, -1, nearest]
            axes[row, column].set_title(f"{labels[name]}: hole at {center:g} m, reward {reward:,.0f}")
    return {
        "learning_curve": plots.learning_curves(learning_panels(arrays, panels, labels)),
        "final": plots.final_values(last_regrets(arrays, labels), label="regret over the grid", log=True),
        "postures": figure,
    }


def table(arrays: Arrays) -> dict[str, list[str]]:
    """Return the share of trials and holes with a collision, all and at the ends, and the other rewards."""
    columns: dict[str, list[str]] = {
        "policy": _names(arrays),
        "collides": [],
        "at the ends": [],
        "else": [],
    }
    for name in _names(arrays):
        collides, reward = Part(arrays, name)["collides"], Part(arrays, name)["grid_reward"][:, -1]
        columns["collides"].append(f"{collides.mean():.0%}")
        columns["at the ends"].append(f"{_collides_at_the_ends(arrays, name):.0%}")
        columns["else"].append("" if collides.all() else f"{np.median(reward[~collides]):,.0f}")
    return columns


def _names(arrays: Arrays) -> list[str]:
    return parts_with(arrays, "coef")


def _num_better(arrays: Arrays) -> float:
    """Count the numbers of RBFs that are better than the paper's at the 5 % level; NaN without others."""
    others = [name for name in _names(arrays) if name not in ("linear", SHOWN_RBF)]
    return float(sum(p_value(arrays, name, SHOWN_RBF) < 0.05 for name in others)) if others else np.nan


def _collides_at_the_ends(arrays: Arrays, name: str) -> float:
    return float(Part(arrays, name)["collides"][:, [0, 1, 2, -3, -2, -1]].mean())


def _p_of_the_worst(arrays: Arrays) -> float:
    """Return the largest p-value of 4, 6 and 10 RBFs being better than 20; NaN if one of them is missing."""
    names = ("rbf4", SHOWN_RBF, "rbf10", "rbf20")
    if not set(names) <= set(_names(arrays)):
        return np.nan
    return max(p_value(arrays, name, "rbf20") for name in names[:-1])


def _collides(contender: Contender, grid: jax.Array, coef: np.ndarray) -> np.ndarray:
    """Return whether the movement of a mean policy collides with the ground, for contexts (n,)."""
    outcome = jax.vmap(contender.task.rollout, (None, 0, 0))(
        jax.random.key(0), grid, mean_thetas(contender, coef, grid)
    )
    return np.asarray(outcome.num_collisions > 0)


CLAIMS = (
    Claim(
        "6 RBFs reach better than a linear policy: p of Wilcoxon's test",
        partial(p_value, better=SHOWN_RBF, worse="linear"),
        high=0.05,
    ),
    Claim(
        "6 RBFs: share of trials and holes with a collision",
        lambda arrays: float(Part(arrays, SHOWN_RBF)["collides"].mean()),
        high=0.05,
        paper=0.0,
    ),
    Claim(
        "linear: share of trials and holes with a collision, at the ends of the range",
        lambda arrays: _collides_at_the_ends(arrays, "linear"),
        low=0.05,
    ),
    Claim("numbers of RBFs that are better than 6, at the 5 % level", _num_better, high=0.0, paper=0.0),
    Claim("20 RBFs are worse than 4, 6 and 10: the largest p of the same test", _p_of_the_worst, high=0.05),
)
