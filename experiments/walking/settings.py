"""Settings of the walking experiments, and their presets."""

import dataclasses
import math
from collections.abc import Mapping
from functools import cached_property, partial
from typing import Any

import jax
import mujoco
import numpy as np

from creps_jax.contexts import gaussian_contexts, uniform_contexts
from creps_jax.errors import UserError
from creps_jax.policies.bounds import RUN_CONSTRAINTS, SIGMOID
from creps_jax.policies.feature_settings import Features
from creps_jax.robots.robot import GRAVITY
from creps_jax.simulation import c, mjx
from creps_jax.simulation.state import ControlStep
from creps_jax.tasks.conditions import Condition
from creps_jax.tools.robots import ROBOTS, Bounds, RobotRanges, find_robot, robot_id
from creps_jax.walking.controller import COM_METHODS
from creps_jax.walking.params import AUTHOR_BOUNDS, PAPER_BOUNDS
from creps_jax.walking.posture import Balance

BOUNDS = {
    **{name: ranges.bounds for name, ranges in ROBOTS.items()},
    "author": AUTHOR_BOUNDS,
    "paper": PAPER_BOUNDS,
}
SAMPLERS = {"gaussian": partial(gaussian_contexts, clip=True), "uniform": uniform_contexts}
NUM_SPEEDS = 11
TIMESTEP = 0.004
"""Time step of the physics, s."""


def _fastest_name() -> str:
    """Return the faster physics: C MuJoCo on a CPU, where it also starts sooner, MJX elsewhere."""
    return "c" if jax.default_backend() == "cpu" else "mjx"


def _fastest(model: mujoco.MjModel, num_substeps: int) -> ControlStep:
    return PHYSICS[_fastest_name()](model, num_substeps)


PHYSICS = {"auto": _fastest, "mjx": mjx.make_control_step, "c": c.make_control_step}


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of the experiment.

    The preset `paper` has the paper's protocol. The preset `author` has bounds, numbers of samples, KL bound
    and RBF width of the scripts that the paper's author published; DEVIATIONS.md lists the differences.

    Attributes:
        robot: robot that walks: nao, nao_h25 or the .toml file that describes a humanoid.
        iterations: iterations of learning.
        trials: trials, all learned at once.
        samples: new samples of each trial in an iteration.
        first_samples: new samples of the first iteration.
        repeats: rollouts of a sample, whose rewards are averaged.
        archive_size: L, samples kept.
        kl_bound: epsilon, nats.
        mean_kl_bound: bound on the change of the policy's mean in an update, nats, see `bounded_ml`; None
            is the paper's unbounded fit.
        cov_kl_bound: the same for the covariance, nats.
        significance: p-value above which the covariance is not updated, see `creps_jax.creps`; None is the
            paper's update, which has no such test.
        features: kind, number and width of the policy's features.
        bounds: bounds of the parameters: nao, nao_h25, author or paper; None is the bounds of the robot.
        com: how the CoM is planned, one_step as in the paper, or continuous; None is one_step for a NAO, and
            continuous for other robots, whose narrow feet do not carry the first step.
        constraint: limit on the parameters at their bounds: sigmoid or penalty. A penalty is subtracted from
            the reward outside of the bounds.
        start_mean: mean of the first policy before squashing; 0 is the middle of the bounds.
        start_std: its standard deviation before squashing. With a penalty the first policy is the same to
            first order.
        start_policy: policy file to start from, instead of start_mean and start_std; it must have the same
            features and bounds.
        low: lowest speed, m/s; None is the lowest speed of the robot.
        high: highest speed, m/s; None is the highest speed of the robot.
        duration: length of an episode of the evaluation, s.
        learning_duration: length of an episode in learning, s.
        heading_gain: share of the heading error that a step turns back; 0 is the paper's engine.
        placement_gain: shift of the landing foot towards the side of the tilt, see `Balance`; 0 is the
            paper's engine.
        forward_placement_gain: the same forwards, against the error of the pitch, see `Balance`; 0 is the
            paper's engine. None is 0 for a NAO and 0.25 for other robots.
        filter_time: time constant of the filter for the measured tilt, s, see `Balance`; 0 is no filter. None
            is 0 for a NAO and 0.06 for other robots.
        upright: share of the cost of a fall that is given back in learning in proportion to the time before
            the fall; 0 is the paper's reward. None is 0 for a NAO and 0.5 for other robots.
        sampler: distribution of the contexts in learning: gaussian or uniform.
        margin: distance beyond both ends of the range in which contexts are also drawn in learning, m/s;
            without samples on both sides the ends are learned less well than the middle.
        learning_noise: noise in learning, as a factor of the noise in the evaluation: a policy that is
            learned in more noise falls less.
        candidates: policies of the second half of learning that walk in the noise of learning; the best of
            them is kept. With 1 the last policy is kept.
        eval_seeds: new episodes at each speed of the table.
        physics: simulation of the robot: auto, mjx or c. MJX runs on the device, C MuJoCo on the cores of the
            host; auto is the faster of them.
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
    com: str | None = None
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
    forward_placement_gain: float | None = None
    filter_time: float | None = None
    upright: float | None = None
    sampler: str = "gaussian"
    margin: float = 0.0
    learning_noise: float = 1.0
    candidates: int = 1
    eval_seeds: int = 10
    physics: str = "auto"

    def __post_init__(self) -> None:
        # Settings from a manifest are plain values.
        if isinstance(self.features, Mapping):
            object.__setattr__(self, "features", Features(**self.features))
        self.ranges()
        choices = {"constraint": RUN_CONSTRAINTS, "sampler": SAMPLERS, "physics": PHYSICS}
        if self.bounds is not None:
            choices["bounds"] = BOUNDS
        if self.com is not None:
            choices["com"] = dict.fromkeys(COM_METHODS)
        for name, known in choices.items():
            if getattr(self, name) not in known:
                raise UserError(f"{name} must be one of {', '.join(known)}, got {getattr(self, name)!r}")
        self._check_speeds()

    def _check_speeds(self) -> None:
        """Check the range of the speeds; a leg cannot walk with a Froude number above 1."""
        (low, *_), (high, *_) = self.context_range()
        fastest = math.sqrt(GRAVITY * self.ranges().robot.leg_length)
        if not 0 <= low < high <= fastest:
            raise UserError(
                f"low and high must be speeds with 0 <= low < high <= {fastest:.2f} m/s, the fastest walk of "
                f"the leg (Froude number 1), got {low:g} and {high:g}"
            )

    def resolved(self) -> "Settings":
        """Return the settings with a value in place of each None and "auto" that stands for one."""
        ranges = self.ranges()
        own = {"low": ranges.low, "high": ranges.high, **self._of_robot()}
        if self.robot in BOUNDS:
            own["bounds"] = self.robot
        chosen: dict[str, Any] = {name: value for name, value in own.items() if getattr(self, name) is None}
        chosen["robot"] = robot_id(self.robot)
        if self.physics == "auto":
            chosen["physics"] = _fastest_name()
        return dataclasses.replace(self, **chosen)

    def ranges(self) -> RobotRanges:
        """Return the robot, with its range of speeds."""
        return self._ranges

    @cached_property
    def _ranges(self) -> RobotRanges:
        # A run keeps its robot if the files of the robot are edited meanwhile.
        return find_robot(self.robot)

    def box(self) -> Bounds:
        """Return the bounds of the parameters."""
        return self.ranges().bounds if self.bounds is None else BOUNDS[self.bounds]

    def of_robot(self, name: str) -> Any:
        """Return a setting that is None by default, as it fits the robot."""
        given = getattr(self, name)
        return self._of_robot()[name] if given is None else given

    def _of_robot(self) -> dict[str, Any]:
        if self.robot in ROBOTS:
            return {"com": "one_step", "filter_time": 0.0, "forward_placement_gain": 0.0, "upright": 0.0}
        return {"com": "continuous", "filter_time": 0.06, "forward_placement_gain": 0.25, "upright": 0.5}

    def speeds(self, num: int = NUM_SPEEDS) -> np.ndarray:
        """Return `num` equally spaced speeds, m/s; by default, with the paper's robot, its 11 speeds."""
        low, high = self.context_range()
        return np.linspace(low[0], high[0], num, dtype=np.float32)

    def balance(self) -> Balance:
        """Return the gains of the response to the measured orientation."""
        tilt = {name: self.of_robot(name) for name in ("filter_time", "forward_placement_gain")}
        return Balance(self.heading_gain, self.placement_gain, **tilt)

    def conditions(self) -> tuple[Condition, ...]:
        """Return the context variables after the speed."""
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
        """Return the distance beyond its range in which each context variable is also drawn in learning."""
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
        iterations=40,
        samples=80,
        first_samples=80,
        repeats=1,
        archive_size=400,
        learning_duration=4.0,
        candidates=3,
    ),
    "humanoid": dataclasses.replace(
        _OURS,
        iterations=200,
        samples=60,
        first_samples=60,
        repeats=1,
        archive_size=300,
        learning_duration=5.0,
        candidates=5,
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
