"""Teach a NAO to walk at the speed it is asked for, up and down slopes: a context of two variables.

The paper's introduction promises contexts such as the slope of the terrain; its experiments have the speed.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from creps_jax.contexts import context_grid
from creps_jax.errors import UserError
from creps_jax.files import policies_folder
from creps_jax.policies.feature_settings import Features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.policies.learned import load
from creps_jax.tasks.conditions import Condition, slope
from creps_jax.tools import plots, tables
from creps_jax.tools.play import POLICY, record, save_film
from creps_jax.tools.plots import Map
from creps_jax.walking.params import PARAM_UNITS
from experiments import walk
from experiments.learning import Session
from experiments.registry import Claim

FILMED = ((0.2, -10.0), (0.2, 0.0), (0.2, 10.0), (0.4, -10.0), (0.4, 0.0), (0.4, 10.0))
GENTLE = 5.0
"""Slopes up to which nothing may fall, deg."""
_FITTED = 9
"""Places along each context variable at which the first policy is fitted to the shipped one."""


@dataclasses.dataclass(frozen=True)
class Settings(walk.Settings):
    """Settings of the experiment: those of the walk, and the slope.

    Attributes:
        slope_low: lowest slope, deg; below zero the floor falls ahead.
        slope_high: highest slope, deg.
        slope_margin: how far beyond both ends slopes are drawn in learning, deg.
        speed_step: distance of the speeds of the evaluation, m/s.
        slope_step: distance of its slopes, deg.
    """

    slope_low: float = -10.0
    slope_high: float = 10.0
    slope_margin: float = 1.0
    speed_step: float = 0.05
    slope_step: float = 2.5

    def conditions(self) -> tuple[Condition, ...]:
        """Return what the context holds besides the speed."""
        return (slope(self.slope_low, self.slope_high),)

    def margins(self) -> tuple[float, ...]:
        """Return how far beyond its range each context variable is drawn in learning."""
        return (self.margin, self.slope_margin)


_OURS = {
    "features": Features("rbf", 3),
    "low": 0.1,
    "high": 0.4,
    "start_std": 0.2,
    "trials": 1,
    "samples": 60,
    "first_samples": 60,
    "archive_size": 480,
}
SETTINGS = {
    preset: Settings(**{**vars(walk.SETTINGS[preset]), **_OURS, **changes})
    for preset, changes in {"quick": {"iterations": 25}, "best": {"iterations": 60, "eval_seeds": 30}}.items()
}


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn from the shipped walk on; evaluate the first and the learned policies over speeds and slopes.

    Returns:
        Arrays of the learning (trials, iterations), the policies, the `speeds` (n,) and `slopes` (m,) of the
        evaluation, and for the learned policies (trials, n, m, ...), as `start.NAME` for the first one
        (n, m, ...): parameters `theta` (d,), `reward` (seeds,), `speed` (seeds, 2) and `fell` (seeds,).
    """
    evaluate_key, learn_key = jax.random.split(key)
    start = warm_start(settings)
    states, log = walk.learn_to_walk(settings, learn_key, session=session, name="walk_slope", start=start)
    speeds, slopes = evaluation_grid(settings)
    before = walk_everywhere(settings, evaluate_key, jax.tree.map(lambda leaf: leaf[None], start))
    return {
        "speeds": speeds,
        "slopes": slopes,
        **walk.learned(settings, states.policy, log),
        **{f"start.{name}": values[0] for name, values in before.items()},
        **walk_everywhere(settings, evaluate_key, states.policy),
    }


def evaluation_grid(settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Return the speeds (n,), m/s, and the slopes (m,), deg, of the evaluation."""
    steps = (settings.speed_step, settings.slope_step)
    speeds, slopes = (
        np.linspace(low, high, round((high - low) / step) + 1, dtype=np.float32)
        for low, high, step in zip(*settings.context_range(), steps, strict=True)
    )
    return speeds, slopes


def walk_everywhere(settings: Settings, key: jax.Array, policy: LinearGaussian) -> dict[str, np.ndarray]:
    """Roll out the mean policies (trials, ...) at all speeds on all slopes, with fresh seeds.

    Returns:
        The arrays of `run` that tell of it (trials, n, m, ...).
    """
    speeds, slopes = evaluation_grid(settings)
    contexts = np.stack(np.meshgrid(speeds, slopes, indexing="ij"), axis=-1).reshape(-1, 2)
    free = np.asarray(jax.vmap(walk.make_algorithm(settings).mean, (0, None))(policy, contexts))
    task = walk.make_task(settings)
    outcome = walk.evaluate_trials(key, task, contexts, free, repeats=settings.eval_seeds)
    theta = np.asarray(walk.parameter_space(settings).inside(jnp.asarray(free)))
    found = {"theta": theta, "reward": outcome.reward, "speed": outcome.speed, "fell": outcome.fell}
    grid = (len(free), len(speeds), len(slopes))
    return {name: values.reshape(*grid, *values.shape[2:]) for name, values in found.items()}


def warm_start(settings: Settings) -> LinearGaussian:
    """Return the policy to begin with: on every slope, as near as the features allow, one of the speed alone.

    That is `start_policy`, by default the shipped one.

    Raises:
        UserError: if it keeps its parameters within other bounds.
    """
    path = Path(settings.start_policy or policies_folder() / "walk.npz")
    shipped = load(path)
    space = shipped.parameters
    if (space.constraint, space.low, space.high) != (settings.constraint, *settings.box()):
        wanted = settings.bounds or settings.robot
        raise UserError(f"{path} has other bounds than {settings.constraint} within {wanted}")
    contexts = context_grid(*settings.context_range(), _FITTED)
    features = jax.vmap(settings.features.make(*settings.context_range()).apply)(contexts)
    wanted = np.stack([shipped.mean(float(speed)) for speed, _ in contexts])
    coef, *_ = np.linalg.lstsq(np.asarray(features, float), wanted)
    return LinearGaussian(jnp.asarray(coef, jnp.float32), settings.start_std * jnp.eye(wanted.shape[1]))


def plot(arrays: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """Draw the learning, and over speed and slope: falls, errors of the speed, and the parameters."""
    trial = walk.chosen_trial(arrays)
    seeds = arrays["fell"].shape[-1]
    places = (arrays["speeds"].astype(float), arrays["slopes"].astype(float))
    labels = ("asked speed (m/s)", "slope (deg)")
    theta = np.moveaxis(arrays["theta"][trial], -1, 0)
    units = [f" ({unit})" if unit else "" for unit in PARAM_UNITS]
    errors = [100 * _speed_error(arrays, which) for which in (None, trial)]
    largest = float(np.abs(errors).max())
    contenders = ("shipped walk", "learned")
    return {
        **walk.plot_learning(arrays),
        "falls": plots.context_maps(
            [
                Map(fell.sum(axis=-1), f"{name}: falls of {seeds}", (0.0, seeds), "{:.0f}", "Reds")
                for name, fell in zip(contenders, (arrays["start.fell"], arrays["fell"][trial]), strict=True)
            ],
            *places,
            labels=labels,
            title="Where the robot falls",
        ),
        "speed": plots.context_maps(
            [
                Map(error, f"{name}: reached - asked (cm/s)", (-largest, largest), "{:.1f}", "RdBu")
                for name, error in zip(contenders, errors, strict=True)
            ],
            *places,
            labels=labels,
            title="How well it walks at the asked speed",
        ),
        "parameters": plots.context_maps(
            [
                Map(values, f"{name}{unit}")
                for values, name, unit in zip(theta, walk.param_titles(), units, strict=True)
            ],
            *places,
            labels=labels,
            title="What the robot changes with speed and slope",
            columns=5,
        ),
    }


def _speed_error(arrays: Mapping[str, np.ndarray], trial: int | None) -> np.ndarray:
    """Return the reached less the asked speed (n, m), the mean of the seeds; of the first policy for None."""
    reached = arrays["start.speed"] if trial is None else arrays["speed"][trial]
    return reached[..., 0].mean(axis=-1) - arrays["speeds"][:, None]


def finish(
    settings: Settings, arrays: Mapping[str, np.ndarray], folder: Path, say: Callable[[str], None]
) -> None:
    """Write policy, table and video of the chosen trial."""
    trial = walk.chosen_trial(arrays)
    policy = walk.as_learned(settings, LinearGaussian(arrays["coef"][trial], arrays["cov_chol"][trial]))
    policy.save(folder / POLICY)
    say(f"policy: {folder / POLICY}\n")
    tables.save_table(table(arrays), folder, say)
    speeds, slopes = zip(*FILMED, strict=True)
    clips = record(policy, speeds, seed=0, duration=settings.duration, slopes=slopes)
    save_film(clips, folder / "walk_slope.mp4", say, robot=settings.ranges().robot)


def table(arrays: Mapping[str, np.ndarray]) -> dict[str, list[object]]:
    """Return falls and errors of the chosen trial by slope, beside those of the shipped walk."""
    trial = walk.chosen_trial(arrays)
    fell, start = arrays["fell"][trial].sum(axis=-1), arrays["start.fell"].sum(axis=-1)
    num = arrays["speeds"].size * arrays["fell"].shape[-1]
    columns: dict[str, list[object]] = {"slope deg": [f"{slope:+g}" for slope in arrays["slopes"]]}
    for index, speed in enumerate(arrays["speeds"]):
        columns[f"falls at {speed:.2f}"] = [int(count) for count in fell[index]]
    columns["falls"] = [f"{count}/{num}" for count in fell.sum(axis=0)]
    columns["speed error m/s"] = [float(e) for e in np.abs(_speed_error(arrays, trial)).mean(axis=0)]
    columns["shipped walk: falls"] = [f"{count}/{num}" for count in start.sum(axis=0)]
    columns["its error"] = [float(e) for e in np.abs(_speed_error(arrays, None)).mean(axis=0)]
    return columns


def _fell(arrays: Mapping[str, np.ndarray], steepest: float = np.inf) -> np.ndarray:
    """Return which walks (n, m, seeds) of the chosen trial ended in a fall, on slopes up to the steepest."""
    return arrays["fell"][walk.chosen_trial(arrays)][:, np.abs(arrays["slopes"]) <= steepest]


def _error_ratio(arrays: Mapping[str, np.ndarray]) -> float:
    errors = [np.abs(_speed_error(arrays, which)).mean() for which in (walk.chosen_trial(arrays), None)]
    return float(errors[0] / errors[1])


CLAIMS = (
    Claim(
        "falls on slopes up to 5 degrees", None, lambda arrays: float(_fell(arrays, GENTLE).sum()), high=0.0
    ),
    Claim("share of falls on all slopes", None, lambda arrays: float(_fell(arrays).mean()), high=0.01),
    Claim("mean error of the speed, times that of the shipped walk", None, _error_ratio, high=1.0),
)
