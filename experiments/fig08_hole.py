"""Reach into a hole with a planar arm (Abdolmaleki et al. 2016, 4.2, Fig. 8 and 9)."""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from creps_jax.contexts import context_grid
from creps_jax.features import linear_features, quadratic_features, rbf_features
from creps_jax.tasks.planar_arm import arm_points, hole_movement, hole_reaching
from experiments import plots
from experiments.comparison import compare, make_contender, mean_policy_curve, p_value, postures, regret
from experiments.errors import UserError
from experiments.learning import Plan, Session
from experiments.registry import Claim

LOW, HIGH = 1.4, 2.0
WIDTH, DEPTH = 0.3, 1.0
SHOWN = (1.5, 2.0)
# The paper's choice, and what it is held against.
SHOWN_RBF = "rbf6"


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of the experiment; the paper gives samples, archive, KL bound and numbers of RBFs.

    Attributes:
        iterations: iterations of learning.
        trials: trials of each curve; the paper has 5.
        samples: N, new samples of an iteration.
        archive_size: L, samples kept.
        kl_bound: epsilon, nats.
        num_centers: the numbers K of RBFs.
        ridge: relative penalty on the policy's coefficients.
        start_std: standard deviation of the first policy, whose mean is zero, rad.
    """

    iterations: int = 1000
    trials: int = 20
    samples: int = 40
    archive_size: int = 2000
    kl_bound: float = 0.5
    num_centers: tuple[int, ...] = (2, 4, 6, 10, 20)
    ridge: float = 1e-4
    start_std: float = 0.5

    def __post_init__(self) -> None:
        if 6 not in self.num_centers:
            raise UserError(f"num_centers must have 6, the paper's, among them, got {self.num_centers}")


SETTINGS = {"paper": Settings(), "quick": Settings(iterations=300, trials=5, num_centers=(6,))}


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
    plan = Plan(settings.iterations, settings.samples)
    grid = context_grid(LOW, HIGH, 25)
    arrays = compare(contenders, plan, key, trials=settings.trials, grid=grid, session=session)
    for name in ("linear", SHOWN_RBF):
        arrays[f"{name}.postures"] = postures(
            contenders[name],
            arrays[f"{name}.coef"][0],
            jnp.array(SHOWN)[:, None],
            lambda theta: jax.vmap(arm_points)(hole_movement(theta).pos),
        )
    return arrays


def plot(arrays: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """Draw Fig. 8a and 8b, the last regrets, and the arm's postures (Fig. 9)."""
    names = _names(arrays)
    panels = {
        "Linear and RBF policies": ("linear", SHOWN_RBF),
        "Number of RBFs": [name for name in names if name != "linear"],
    }
    figure, axes = plots.new_figure(2, len(SHOWN), width=8.0, height=8.0)
    for row, name in enumerate(("linear", SHOWN_RBF)):
        for column, center in enumerate(SHOWN):
            plots.plot_postures(axes[row, column], arrays[f"{name}.postures"][column])
            plots.plot_ground(axes[row, column], center, WIDTH, DEPTH)
            nearest = np.abs(arrays["context"][:, 0] - center).argmin()
            reward = arrays[f"{name}.grid_reward"][0, -1, nearest]
            axes[row, column].set_title(f"{_label(name)}: hole at {center:g} m, reward {reward:,.0f}")
    return {
        "learning_curve": plots.learning_curves(
            {
                title: {_label(name): mean_policy_curve(arrays, name) for name in some}
                for title, some in panels.items()
            }
        ),
        "final": plots.final_values(
            {_label(name): regret(arrays, name) for name in names}, label="regret over the grid", log=True
        ),
        "postures": figure,
    }


def _names(arrays: Mapping[str, np.ndarray]) -> list[str]:
    return [key.removesuffix(".coef") for key in arrays if key.endswith(".coef")]


def _label(name: str) -> str:
    return "linear" if name == "linear" else f"{name.removeprefix('rbf')} RBFs"


def _num_better(arrays: Mapping[str, np.ndarray]) -> float:
    """Return how many numbers of RBFs do better than the paper's, at the 5 % level; NaN without others."""
    others = [name for name in _names(arrays) if name not in ("linear", SHOWN_RBF)]
    return float(sum(p_value(arrays, name, SHOWN_RBF) < 0.05 for name in others)) if others else np.nan


def _share_of_collisions(arrays: Mapping[str, np.ndarray], name: str) -> float:
    """Return in which share of trials and contexts the last policies collide: that costs 1e6 and more."""
    return float((arrays[f"{name}.grid_reward"][:, -1] < -1e6).mean())


CLAIMS = (
    Claim(
        "6 RBFs reach better than a linear policy: p of Wilcoxon's test",
        None,
        lambda arrays: p_value(arrays, SHOWN_RBF, "linear"),
        high=0.05,
    ),
    Claim(
        "6 RBFs: share of trials and holes with a collision",
        0.0,
        lambda arrays: _share_of_collisions(arrays, SHOWN_RBF),
        high=0.05,
    ),
    Claim("numbers of RBFs that do better than 6, at the 5 % level", 0.0, _num_better, high=0.0),
)
