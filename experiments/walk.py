"""Teach a robot to walk at the speed it is asked for (Abdolmaleki et al. 2016, 4.3, Fig. 11, Table 2)."""

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from matplotlib.figure import Figure

from creps_jax import files
from creps_jax.contexts import gaussian_contexts, uniform_contexts
from creps_jax.errors import UserError
from creps_jax.policies.bounds import CLIP, PENALTY, SIGMOID
from creps_jax.policies.feature_settings import Features
from creps_jax.policies.gaussian import LinearGaussian, start_policy
from creps_jax.policies.learned import Learned
from creps_jax.policies.space import Space, sigmoid_gate
from creps_jax.search.creps import Creps, CrepsState, creps
from creps_jax.search.fit import fit_within
from creps_jax.simulation import c, mjx
from creps_jax.simulation.state import ControlStep
from creps_jax.tasks import Task, average_repeats, penalised, sigmoid_constrained
from creps_jax.tasks.conditions import Condition
from creps_jax.tasks.walking import WalkNoise, nao_walk
from creps_jax.tools import plots, tables
from creps_jax.tools.play import (
    POLICY,
    START_UP,
    filmed_speeds,
    load_walking_policy,
    record,
    save_film,
)
from creps_jax.tools.robots import ROBOTS, Bounds, RobotRanges, find_robot
from creps_jax.training import evaluate
from creps_jax.walking.params import (
    AUTHOR_BOUNDS,
    PAPER_BOUNDS,
    PARAM_LABELS,
    PARAM_NAMES,
    PARAM_UNITS,
)
from creps_jax.walking.posture import Balance
from experiments.learning import Log, Plan, Session, learn, trial_keys
from experiments.registry import Claim

BOUNDS = {
    **{name: ranges.bounds for name, ranges in ROBOTS.items()},
    "author": AUTHOR_BOUNDS,
    "paper": PAPER_BOUNDS,
}
SAMPLERS = {"gaussian": partial(gaussian_contexts, clip=True), "uniform": uniform_contexts}
CONSTRAINTS = (SIGMOID, PENALTY)
PENALTY_SIZE = 1000.0
NUM_SPEEDS = 11
TIMESTEP = 0.004


def _fastest_name() -> str:
    """Choose what steps the robot: C MuJoCo on a CPU, where it starts sooner and is faster, elsewhere MJX."""
    return "c" if jax.default_backend() == "cpu" else "mjx"


def _fastest(model: mujoco.MjModel, num_substeps: int) -> ControlStep:
    return PHYSICS[_fastest_name()](model, num_substeps)


PHYSICS = {"auto": _fastest, "mjx": mjx.make_control_step, "c": c.make_control_step}


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of the experiment.

    The preset `paper` is the paper's protocol, and `author` has bounds, numbers of samples, KL bound and RBF
    width of the scripts that its author published; DEVIATIONS.md says what differs.

    Attributes:
        robot: who learns to walk, a name in ROBOTS.
        iterations: iterations of learning.
        trials: trials, all learned at once.
        samples: new samples of an iteration, of each trial.
        first_samples: new samples of the first iteration.
        repeats: rollouts of a sample, averaged.
        archive_size: L, samples kept.
        kl_bound: epsilon, nats.
        mean_kl_bound: bound on the change of the policy's mean in an update, nats, see `bounded_ml`; None
            is the paper's unbounded fit.
        cov_kl_bound: the same for the covariance, nats.
        significance: p-value from which on the covariance stays, see `creps_jax.creps`; None is the paper's
            update.
        features: kind, number and width of the policy's features.
        bounds: bounds of the parameters, a name in BOUNDS; None is the robot's own.
        constraint: how they are held, a name in CONSTRAINTS: by a sigmoid, or by a penalty of the reward.
        start_mean: mean of the first policy before squashing; 0 is the middle of the bounds.
        start_std: its standard deviation before squashing. With a penalty the first policy is, to first
            order, the same.
        start_policy: policy file to go on from, in place of start_mean and start_std; it must have the same
            features and bounds.
        low: lowest speed, m/s; None is the robot's own.
        high: highest speed, m/s; None is the robot's own.
        duration: length of an episode of the evaluation, s.
        learning_duration: length of an episode in learning, s.
        heading_gain: share of the heading error that a step turns back; 0 is the paper's engine.
        placement_gain: how far the landing foot shifts towards the side of the tilt, see `Balance`; 0 is
            the paper's engine.
        sampler: how contexts are drawn in learning, a name in SAMPLERS.
        margin: how far beyond both ends of the range contexts are drawn in learning, m/s: the ends are
            learned as well as the middle only where there are samples on both sides.
        learning_noise: how many times larger the noise is in learning than in the evaluation: a policy
            that has learned to stay up in more of it falls less.
        eval_seeds: fresh episodes at each speed of the table.
        physics: what steps the robot, a name in PHYSICS: MJX on the device, C MuJoCo on the host's cores, or
            the faster of them.
    """

    robot: str = "nao"
    iterations: int = 300
    trials: int = 1
    samples: int = 30
    first_samples: int = 100
    repeats: int = 3
    archive_size: int = 600
    kl_bound: float = 0.5
    mean_kl_bound: float | None = None
    cov_kl_bound: float | None = None
    significance: float | None = None
    features: Features = Features("rbf", 5)
    bounds: str | None = None
    constraint: str = SIGMOID
    start_mean: float = 0.0
    start_std: float = 1.0
    start_policy: str | None = None
    low: float | None = None
    high: float | None = None
    duration: float = 8.0
    learning_duration: float = 8.0
    heading_gain: float = 0.0
    placement_gain: float = 0.0
    sampler: str = "gaussian"
    margin: float = 0.0
    learning_noise: float = 1.0
    eval_seeds: int = 10
    physics: str = "auto"

    def __post_init__(self) -> None:
        # Settings that come back from a manifest are plain.
        if isinstance(self.features, Mapping):
            object.__setattr__(self, "features", Features(**self.features))
        find_robot(self.robot)
        choices = {"constraint": CONSTRAINTS, "sampler": SAMPLERS, "physics": PHYSICS}
        if self.bounds is not None:
            choices["bounds"] = BOUNDS
        for name, known in choices.items():
            if getattr(self, name) not in known:
                raise UserError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")

    def resolved(self) -> "Settings":
        """Return the settings with what None and "auto" stand for here and today, for a run to keep."""
        ranges = self.ranges()
        own = {"low": ranges.low, "high": ranges.high, "bounds": self.robot}
        chosen: dict[str, Any] = {name: value for name, value in own.items() if getattr(self, name) is None}
        if self.physics == "auto":
            chosen["physics"] = _fastest_name()
        return dataclasses.replace(self, **chosen)

    def ranges(self) -> RobotRanges:
        """Return the robot that learns to walk, with its ranges."""
        return find_robot(self.robot)

    def box(self) -> Bounds:
        """Return the bounds of the parameters."""
        return BOUNDS[self.robot if self.bounds is None else self.bounds]

    def speeds(self, num: int = NUM_SPEEDS) -> np.ndarray:
        """Return `num` speeds, evenly over the range, m/s; by default the paper's 11 for its robot."""
        low, high = self.context_range()
        return np.linspace(low[0], high[0], num, dtype=np.float32)

    def balance(self) -> Balance:
        """Return how steps answer to the measured orientation."""
        return Balance(self.heading_gain, self.placement_gain)

    def conditions(self) -> tuple[Condition, ...]:
        """Return what the context holds besides the speed."""
        return ()

    def context_range(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Return the lowest and the highest value of each context variable."""
        conditions = self.conditions()
        ranges = self.ranges()
        low, high = (
            own if asked is None else asked
            for asked, own in ((self.low, ranges.low), (self.high, ranges.high))
        )
        return (low, *(c.low for c in conditions)), (high, *(c.high for c in conditions))

    def margins(self) -> tuple[float, ...]:
        """Return how far beyond its range each context variable is drawn in learning."""
        return (self.margin,)


_OURS = Settings(
    heading_gain=0.3,
    placement_gain=0.6,
    sampler="uniform",
    margin=0.02,
    learning_noise=1.6,
    start_mean=-0.3,
    mean_kl_bound=0.5,
    cov_kl_bound=0.05,
    significance=0.1,
)
SETTINGS = {
    "quick": dataclasses.replace(
        _OURS,
        iterations=45,
        trials=3,
        samples=45,
        first_samples=45,
        repeats=2,
        archive_size=225,
        learning_duration=5.0,
    ),
    "paper": Settings(trials=5, bounds="paper"),
    "author": Settings(
        trials=5,
        bounds="author",
        samples=20,
        first_samples=500,
        kl_bound=1.0,
        features=Features("rbf", 5, bandwidth=0.09),
    ),
    "best": dataclasses.replace(_OURS, iterations=90, samples=40, archive_size=200, eval_seeds=50),
}


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn, then evaluate the mean policy of each trial at 11 speeds with fresh seeds.

    Returns:
        Arrays of the learning (trials, iterations), the policies, their parameters over the speeds
        (trials, n, d), the evaluation (trials, n, seeds), and, of several trials, `trial_reward` (trials,):
        the mean over the same speeds in the noise of learning, by which the policy that is kept is chosen.
    """
    if settings.constraint != SIGMOID:
        raise UserError(f"a policy is only kept with the constraint sigmoid, got {settings.constraint!r}")
    evaluate_key, learn_key = jax.random.split(key)
    states, log = learn_to_walk(settings, learn_key, session=session, name="walk")
    policy = states.policy
    trial_reward = _trial_reward(settings, jax.random.fold_in(key, 1), policy)
    speeds, outcome = walk_at_all_speeds(settings, evaluate_key, policy)
    fine = settings.speeds(51)
    policies = [
        as_learned(settings, LinearGaussian(*pair)) for pair in zip(*map(np.asarray, policy), strict=True)
    ]
    return {
        **learned(settings, policy, log),
        "fine_speeds": fine,
        "fine_theta": np.stack([[policy.theta(float(speed)) for speed in fine] for policy in policies]),
        "speeds": speeds,
        **trial_reward,
        "reward": outcome.reward,
        "speed": outcome.speed,
        "fell": outcome.fell,
        **{f"bound_{side}": np.array(settings.box()[i]) for i, side in enumerate(("low", "high"))},
    }


def _trial_reward(settings: Settings, key: jax.Array, policy: LinearGaussian) -> dict[str, np.ndarray]:
    """Walk to choose among several trials, with random numbers that the evaluation does not have."""
    if settings.trials == 1:
        return {}
    _, outcome = walk_at_all_speeds(settings, key, policy, noise=settings.learning_noise)
    return {"trial_reward": outcome.reward.mean(axis=(1, 2))}


def learned(settings: Settings, policy: LinearGaussian, log: Log) -> dict[str, np.ndarray]:
    """Return what learning left behind, as arrays: the policies, the log, and the episodes by iteration."""
    return {
        "episodes": make_plan(settings).episodes(np.arange(1, log["mean_reward"].shape[1] + 1)),
        "coef": np.asarray(policy.coef),
        "cov_chol": np.asarray(policy.cov_chol),
        **{f"log.{name}": values for name, values in log.items()},
    }


def make_plan(settings: Settings) -> Plan:
    """Return how long to learn, and with how many samples."""
    return Plan(
        settings.iterations,
        settings.samples,
        settings.first_samples,
        repeats=settings.repeats,
        timestep=TIMESTEP,
    )


def learn_to_walk(
    settings: Settings, key: jax.Array, *, session: Session, name: str, start: LinearGaussian | None = None
) -> tuple[CrepsState, Log]:
    """Learn in all trials, by default from `first_policy` on; see `learn`, whose log this is."""
    task = make_task(settings, noise=settings.learning_noise, duration=settings.learning_duration)
    return learn(
        trial_keys(key, settings.trials),
        average_repeats(task, settings.repeats),
        make_algorithm(settings),
        first_policy(settings) if start is None else start,
        make_plan(settings),
        session=session,
        name=name,
    )


def walk_at_all_speeds(
    settings: Settings, key: jax.Array, policy: LinearGaussian, *, noise: float = 1.0
) -> tuple[np.ndarray, Any]:
    """Roll out the mean policies (trials, ...) at 11 speeds, for the NAO the paper's, with fresh seeds.

    They walk in `noise` times the usual noise.

    Returns:
        The speeds (n,), m/s, and the outcome (trials, n, seeds).
    """
    speeds = settings.speeds()
    contexts = speeds[:, None]
    thetas = np.asarray(jax.vmap(make_algorithm(settings).mean, (0, None))(policy, contexts))
    return speeds, evaluate_trials(
        key, make_task(settings, noise=noise), contexts, thetas, repeats=settings.eval_seeds
    )


def make_task(settings: Settings, *, noise: float = 1.0, duration: float | None = None) -> Task:
    """Make the walking task, with parameters that are kept in their bounds.

    Args:
        settings: settings of the experiment.
        noise: how many times the usual noise.
        duration: length of an episode, s; by default that of the evaluation.
    """
    low, high, margin = map(np.array, (*settings.context_range(), settings.margins()))
    task = nao_walk(
        float(low[0]),
        float(high[0]),
        sample_context=SAMPLERS[settings.sampler](low - margin, high + margin),
        duration=settings.duration if duration is None else duration,
        start_up=START_UP,
        noise=WalkNoise().times(noise),
        balance=settings.balance(),
        physics=PHYSICS[settings.physics],
        conditions=settings.conditions(),
        robot=settings.ranges().robot,
    )
    if settings.constraint == PENALTY:
        return penalised(task, *settings.box(), PENALTY_SIZE)
    return sigmoid_constrained(task, *settings.box())


def make_algorithm(settings: Settings) -> Creps:
    """Set up contextual REPS; the RBFs serve as policy and as baseline features."""
    features = settings.features.make(*settings.context_range())
    baseline = settings.features.make_baseline(*settings.context_range())
    return creps(
        features,
        baseline,
        kl_bound=settings.kl_bound,
        archive_size=settings.archive_size,
        m_step=fit_within(settings.mean_kl_bound, settings.cov_kl_bound),
        significance=settings.significance,
    )


def first_policy(settings: Settings) -> LinearGaussian:
    """Return the policy to begin with: a file's, or one that is the same for every context.

    Raises:
        UserError: if the file cannot be read, or its policy has other features or bounds.
    """
    if settings.start_policy is not None:
        learned = load_walking_policy(Path(settings.start_policy), settings.robot)
        wanted = settings.features.make(*settings.context_range()), parameter_space(settings)
        if (learned.features, learned.parameters) != wanted:
            raise UserError(f"{settings.start_policy} has other features or bounds than these settings")
        return learned.policy
    features = settings.features.make(*settings.context_range())
    mean, std = (
        jnp.full(len(PARAM_NAMES), settings.start_mean),
        jnp.full(len(PARAM_NAMES), settings.start_std),
    )
    if settings.constraint == PENALTY:
        low, high = (jnp.asarray(bound) for bound in settings.box())
        mean, slope = jax.jvp(lambda free: sigmoid_gate(free, low, high), (mean,), (jnp.ones_like(mean),))
        std = slope * std
    return start_policy(features, len(PARAM_NAMES), mean=mean, std=std)


def evaluate_trials(
    key: jax.Array, task: Task, contexts: np.ndarray, thetas: np.ndarray, *, repeats: int
) -> Any:
    """Roll out the parameters (trials, n, d) of each trial in n contexts; outcome (trials, n, repeats)."""
    trials, num, _ = thetas.shape
    rows = jnp.tile(jnp.asarray(contexts), (trials, 1))
    thetas = thetas.reshape(trials * num, -1)
    outcome = evaluate(key, task, rows, jnp.asarray(thetas), repeats=repeats, devices=jax.devices())
    return jax.tree.map(lambda leaf: np.asarray(leaf).reshape(trials, num, *leaf.shape[1:]), outcome)


def parameter_space(settings: Settings) -> Space:
    """Return the walking parameters with their bounds."""
    low, high = settings.box()
    constraint = SIGMOID if settings.constraint == SIGMOID else CLIP
    return Space(PARAM_NAMES, low, high, PARAM_UNITS, constraint)


def as_learned(settings: Settings, policy: LinearGaussian) -> Learned:
    """Put a policy together with all that is needed to use it."""
    conditions = settings.conditions()
    low, high = settings.context_range()
    return Learned(
        policy,
        settings.features.make(low, high),
        Space(
            ("speed", *(condition.name for condition in conditions)),
            low,
            high,
            ("m/s", *(condition.unit for condition in conditions)),
        ),
        parameter_space(settings),
        {"name": "walk", "balance": settings.balance()._asdict(), "robot": settings.robot},
    )


def chosen_trial(arrays: Mapping[str, np.ndarray]) -> int:
    """Choose the trial whose policy is kept, not by its evaluation.

    Where its mean policy has not walked for that, its last iterations of learning decide.
    """
    if "trial_reward" in arrays:
        return int(np.argmax(arrays["trial_reward"]))
    return int(np.argmax(arrays["log.mean_reward"][:, -10:].mean(axis=1)))


def plot(arrays: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """Draw the learning curve, each parameter against speed, and reached against asked speed."""
    trial = chosen_trial(arrays)
    speeds = arrays["speeds"].astype(float)
    lowest = None
    if tables.are_the_papers(speeds):
        lowest = np.asarray(tables.PAPER_SPEEDS) - np.sqrt(-np.asarray(tables.PAPER_RBF) / 10)
    return {
        **plot_learning(arrays),
        "parameters": plots.parameters_against_context(
            arrays["fine_speeds"],
            arrays["fine_theta"],
            names=param_titles(),
            units=PARAM_UNITS,
            low=arrays["bound_low"],
            high=arrays["bound_high"],
            context_label="asked speed (m/s)",
            title="What the robot changes to walk faster",
            chosen=trial,
        ),
        "speed": plots.reached_against_asked(
            speeds,
            arrays["speed"][trial, ..., 0],
            arrays["fell"][trial],
            title="Reached against asked speed",
            paper=lowest,
        ),
    }


def plot_learning(arrays: Mapping[str, np.ndarray]) -> dict[str, Figure]:
    """Draw the learning curve, and how far updates moved."""
    return {
        "learning_curve": plots.learning_curves(
            {"Learning to walk": {"new samples": (arrays["episodes"], arrays["log.mean_reward"])}}
        ),
        "updates": plots.update_traces(
            arrays["episodes"],
            {"walk": {field: arrays[f"log.info.{field}"] for field in plots.TRACES}},
        ),
    }


def finish(
    settings: Settings, arrays: Mapping[str, np.ndarray], folder: Path, say: Callable[[str], None]
) -> None:
    """Write policy, table and video of the chosen trial."""
    trial = chosen_trial(arrays)
    policy = as_learned(settings, LinearGaussian(arrays["coef"][trial], arrays["cov_chol"][trial]))
    policy.save(folder / POLICY)
    say(f"policy: {folder / POLICY}")
    columns = tables.speed_table(
        arrays["speeds"], arrays["reward"][trial], arrays["speed"][trial], arrays["fell"][trial]
    )
    files.save_text(folder / "table.csv", tables.to_csv(columns))
    files.save_text(folder / "table.md", tables.to_markdown(columns))
    say(f"\n{tables.to_markdown(columns)}")
    clips = record(policy, filmed_speeds(policy), seed=0, duration=settings.duration)
    save_film(clips, folder / "walk.mp4", say, robot=settings.ranges().robot)


def param_titles() -> list[str]:
    """Return the walking parameters' names with the paper's symbols."""
    return [
        f"{name.replace('_', ' ')} {symbol}" for name, symbol in zip(PARAM_NAMES, _symbols(), strict=True)
    ]


def _symbols() -> list[str]:
    """Write the paper's symbols for matplotlib."""
    greek = {"gamma": r"\gamma", "phi": r"\phi", "sigma": r"\sigma"}
    symbols = []
    for label in PARAM_LABELS:
        head, _, tail = label.partition("_")
        head = greek.get(head, head[0] + (f"_{{{head[1:]}}}" if len(head) > 1 else ""))
        symbols.append(f"${head}_{{{tail}}}$" if tail else f"${head}$")
    return symbols


def _mean_reward(arrays: Mapping[str, np.ndarray]) -> float:
    return float(arrays["reward"][chosen_trial(arrays)].mean())


CLAIMS = (
    Claim("mean reward over the 11 speeds", float(np.mean(tables.PAPER_RBF)), _mean_reward, low=-0.343),
    Claim("share of falls", 0.0, lambda arrays: float(arrays["fell"][chosen_trial(arrays)].mean()), high=0.0),
    Claim(
        "speed reached when asked for 0.6 m/s",
        0.3,
        lambda arrays: float(arrays["speed"][chosen_trial(arrays), -1, :, 0].mean()),
        low=0.5,
    ),
)
