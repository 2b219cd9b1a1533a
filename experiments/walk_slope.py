"""Learn to walk at a given speed up and down slopes: a context of two variables.

The paper's introduction names the slope of the terrain as a context; its experiments have only the speed.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from creps_jax.contexts import context_grid
from creps_jax.errors import UserError
from creps_jax.policies.bounds import range_text
from creps_jax.policies.feature_settings import Features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.tasks.conditions import Condition, slope
from creps_jax.tools import plots
from creps_jax.tools.play import load_walking_policy, record, save_film, shipped_policy
from creps_jax.tools.plots import Map
from creps_jax.walking.params import PARAM_UNITS
from experiments import walk
from experiments.learning import Session
from experiments.records import Arrays, Part, Walks, named
from experiments.registry import Claim
from experiments.walking import learning
from experiments.walking.settings import SETTINGS as WALK_SETTINGS
from experiments.walking.settings import Settings as WalkSettings

FILMED = ((0.2, -10.0), (0.2, 0.0), (0.2, 10.0), (0.4, -10.0), (0.4, 0.0), (0.4, 10.0))
GENTLE = 5.0
"""Steepest slope of the claim that the robot never falls, deg."""
_FITTED = 9
"""Points along each context variable at which the first policy is fitted to the shipped policy."""


@dataclasses.dataclass(frozen=True)
class Settings(WalkSettings):
    """Settings of the experiment: the settings of the walk, and the slope.

    Attributes:
        slope_low: lowest slope, deg; a negative slope goes down.
        slope_high: highest slope, deg.
        slope_margin: distance beyond both ends in which slopes are also drawn in learning, deg.
        speed_step: distance between the speeds of the evaluation, m/s.
        slope_step: distance between its slopes, deg.
    """

    slope_low: float = -10.0
    slope_high: float = 10.0
    slope_margin: float = 1.0
    speed_step: float = 0.05
    slope_step: float = 2.5

    def conditions(self) -> tuple[Condition, ...]:
        """Return the context variables after the speed."""
        return (slope(self.slope_low, self.slope_high),)

    def margins(self) -> tuple[float, ...]:
        """Return the distance beyond its range in which each context variable is also drawn in learning."""
        return (self.margin, self.slope_margin)


_OURS = {
    "features": Features("rbf", 3),
    "low": 0.1,
    "high": 0.4,
    "start_std": 0.2,
    "trials": 1,
    "candidates": 1,
    "samples": 60,
    "first_samples": 60,
    "archive_size": 480,
}
SETTINGS = {
    preset: Settings(**{**dataclasses.asdict(WALK_SETTINGS[preset]), **_OURS, **changes})
    for preset, changes in {
        "quick": {"iterations": 25, "repeats": 2, "learning_duration": 5.0},
        "best": {"iterations": 60, "eval_seeds": 30},
    }.items()
}


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn, starting from the shipped walk; evaluate the first and the learned policies.

    Returns:
        Arrays of the learning (trials, iterations), the policies, the `speeds` (n,) and `slopes` (m,) of the
        evaluation, and for the learned policies (trials, n, m, ...) parameters `theta` (d,) and the fields of
        `Walks` (seeds, ...). The part `start` has the same for the first policy (n, m, ...).
    """
    evaluate_key, learn_key = jax.random.split(key)
    start = warm_start(settings)
    states, log = learning.learn_to_walk(settings, learn_key, session=session, name="walk_slope", start=start)
    speeds, slopes = evaluation_grid(settings)
    before = walk_everywhere(settings, evaluate_key, jax.tree.map(lambda leaf: leaf[None], start))
    return {
        "speeds": speeds,
        "slopes": slopes,
        **walk.learned_arrays(settings, states.policy, log),
        **named("start", {name: values[0] for name, values in before.items()}),
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
    """Roll out the mean policies (trials, ...) at all speeds on all slopes, with new seeds.

    Returns:
        Parameters `theta` and the fields of `Walks` (trials, n, m, ...).
    """
    speeds, slopes = evaluation_grid(settings)
    contexts = np.stack(np.meshgrid(speeds, slopes, indexing="ij"), axis=-1).reshape(-1, 2)
    free = np.asarray(jax.vmap(learning.make_algorithm(settings).mean, (0, None))(policy, contexts))
    task = learning.make_task(settings)
    outcome = learning.evaluate_trials(key, task, contexts, free, repeats=settings.eval_seeds)
    theta = np.asarray(learning.parameter_space(settings).inside(jnp.asarray(free)))
    found = {"theta": theta, **Walks.of(outcome._asdict())._asdict()}
    grid = (len(free), len(speeds), len(slopes))
    return {name: values.reshape(*grid, *values.shape[2:]) for name, values in found.items()}


def warm_start(settings: Settings) -> LinearGaussian:
    """Return the first policy: the features' best fit of a policy of the speed, the same on every slope.

    It fits `start_policy`, by default the shipped policy of the robot.

    Raises:
        UserError: if that policy is of another robot, or has other bounds or a smaller range of speeds.
    """
    path = Path(settings.start_policy or shipped_policy(settings.robot))
    shipped = load_walking_policy(path, settings.robot)
    space = shipped.parameters
    if (space.constraint, space.low, space.high) != (settings.constraint, *settings.box()):
        wanted = settings.bounds or settings.robot
        raise UserError(f"{path} has other bounds than {settings.constraint} within {wanted}")
    (low, *_), (high, *_) = settings.context_range()
    slowest, fastest = shipped.contexts.low[0], shipped.contexts.high[0]
    if not slowest <= low < high <= fastest:
        known = range_text(slowest, fastest, "m/s")
        raise UserError(
            f"low and high must be within the speeds of {path}, {known}, got {low:g} and {high:g}"
        )
    contexts = context_grid(*settings.context_range(), _FITTED)
    features = jax.vmap(settings.features.make(*settings.context_range()).apply)(contexts)
    wanted = np.stack([shipped.mean(float(speed)) for speed, _ in contexts])
    coef, *_ = np.linalg.lstsq(np.asarray(features, float), wanted)
    return LinearGaussian(jnp.asarray(coef, jnp.float32), settings.start_std * jnp.eye(wanted.shape[1]))


def plot(arrays: Arrays) -> dict[str, Figure]:
    """Draw the learning, and over speed and slope: falls, errors of the speed, and the parameters."""
    contenders = _contenders(arrays)
    seeds = arrays["fell"].shape[-1]
    places = (arrays["speeds"].astype(float), arrays["slopes"].astype(float))
    labels = ("asked speed (m/s)", "slope (deg)")
    theta = np.moveaxis(arrays["theta"][walk.chosen_trial(arrays)], -1, 0)
    units = [f" ({unit})" if unit else "" for unit in PARAM_UNITS]
    errors = {name: 100 * _speed_error(arrays, walks) for name, walks in contenders.items()}
    largest = max(float(np.abs(error).max()) for error in errors.values())
    return {
        **walk.plot_learning(arrays),
        "falls": plots.context_maps(
            [
                Map(walks.fell.sum(axis=-1), f"{name}: falls of {seeds}", (0.0, seeds), "{:.0f}", "Reds")
                for name, walks in contenders.items()
            ],
            *places,
            labels=labels,
            title="Falls",
        ),
        "speed": plots.context_maps(
            [
                Map(error, f"{name}: reached - asked (cm/s)", (-largest, largest), "{:.1f}", "RdBu")
                for name, error in errors.items()
            ],
            *places,
            labels=labels,
            title="Error of the speed",
        ),
        "parameters": plots.context_maps(
            [
                Map(values, f"{name}{unit}")
                for values, name, unit in zip(theta, walk.param_titles(), units, strict=True)
            ],
            *places,
            labels=labels,
            title="Parameters against speed and slope",
            columns=5,
        ),
    }


def _contenders(arrays: Arrays) -> dict[str, Walks]:
    """Return the evaluations of the shipped walk and of the chosen trial."""
    return {"shipped walk": Walks.of(Part(arrays, "start")), "learned": walk.chosen_walks(arrays)}


def _speed_error(arrays: Arrays, walks: Walks) -> np.ndarray:
    """Return the difference of reached and asked speed (n, m), the mean of the seeds, m/s."""
    return walks.speed[..., 0].mean(axis=-1) - arrays["speeds"][:, None]


def finish(settings: Settings, arrays: Arrays, folder: Path, say: Callable[[str], None]) -> None:
    """Write policy and video of the chosen trial."""
    policy = walk.save_policy(settings, arrays, folder, say)
    speeds, slopes = zip(*FILMED, strict=True)
    robot = settings.ranges().robot
    clips = record(policy, speeds, seed=0, robot=robot, duration=settings.duration, slopes=slopes)
    save_film(clips, folder / "walk_slope.mp4", say, robot=robot)


def table(arrays: Arrays) -> dict[str, list[object]]:
    """Return falls and errors of the chosen trial and of the shipped walk, by slope."""
    start, learned = _contenders(arrays).values()
    fell = learned.fell.sum(axis=-1)
    num = arrays["speeds"].size * arrays["fell"].shape[-1]
    columns: dict[str, list[object]] = {"slope deg": [f"{slope:+g}" for slope in arrays["slopes"]]}
    for index, speed in enumerate(arrays["speeds"]):
        columns[f"falls at {speed:.2f}"] = [int(count) for count in fell[index]]
    columns["falls"] = [f"{count}/{num}" for count in fell.sum(axis=0)]
    columns["speed error m/s"] = np.abs(_speed_error(arrays, learned)).mean(axis=0).astype(float).tolist()
    columns["shipped walk: falls"] = [f"{count}/{num}" for count in start.fell.sum(axis=(0, 2))]
    columns["its error"] = np.abs(_speed_error(arrays, start)).mean(axis=0).astype(float).tolist()
    return columns


def _fell(arrays: Arrays, steepest: float = np.inf) -> np.ndarray:
    """Return whether walks (n, m, seeds) of the chosen trial fell, on slopes up to the steepest."""
    return walk.chosen_walks(arrays).fell[:, np.abs(arrays["slopes"]) <= steepest]


def _error_ratio(arrays: Arrays) -> float:
    start, learned = (np.abs(_speed_error(arrays, walks)).mean() for walks in _contenders(arrays).values())
    return float(learned / start)


CLAIMS = (
    Claim("falls on slopes up to 5 degrees", lambda arrays: float(_fell(arrays, GENTLE).sum()), high=0.0),
    Claim("share of falls on all slopes", lambda arrays: float(_fell(arrays).mean()), high=0.01),
    Claim("mean error of the speed, divided by the error of the shipped walk", _error_ratio, high=1.0),
)
