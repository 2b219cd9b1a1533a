"""Learn to walk at any command: forward, backward, sideways and turning, from scratch.

The paper calls its engine omnidirectional, and its walk goes straight ahead. Here the context is the command
(vx, vy, turn rate).
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from creps_jax.errors import UserError
from creps_jax.policies.bounds import SIGMOID
from creps_jax.policies.features import FeatureMap, polynomial_features
from creps_jax.policies.gaussian import LinearGaussian, start_policy
from creps_jax.policies.learned import Learned, linear_policy
from creps_jax.policies.space import Space
from creps_jax.search.archive import Batch
from creps_jax.search.creps import Creps, creps
from creps_jax.search.fit import fit_within
from creps_jax.tasks import Task, average_repeats, sigmoid_constrained
from creps_jax.tasks.closed_loop import CONTROL_PERIOD, WalkNoise
from creps_jax.tasks.steering import Drive, SteeringReward, nao_steered_walk, record_drive
from creps_jax.tools import plots
from creps_jax.tools.play import POLICY, load_walking_policy
from creps_jax.training import evaluate
from creps_jax.walking.controller import Stage, Walker
from creps_jax.walking.gaits import COMMAND_NAMES, COMMAND_UNITS, learned_walker
from creps_jax.walking.params import NAO_STEERED_BOUNDS, STEERED_PARAM_NAMES, STEERED_PARAM_UNITS
from creps_jax.walking.posture import Balance
from experiments.learning import Plan, Session, candidate_iterations, learn, trial_keys
from experiments.records import Arrays, Learning, named
from experiments.registry import Claim
from experiments.walking.settings import PHYSICS, TIMESTEP

LOW = (-0.2, -0.15, -0.8)
HIGH = (0.6, 0.15, 0.8)
"""The box of commands; commands are drawn and evaluated in the ellipsoid inside it."""
_MIDDLE, _HALF = np.add(LOW, HIGH) * 0.5, np.subtract(HIGH, LOW) * 0.5
PARAMETERS = Space(STEERED_PARAM_NAMES, *NAO_STEERED_BOUNDS, STEERED_PARAM_UNITS, SIGMOID)
"""The parameters of a steered walk, and their bounds."""
START_UP = 1.5
"""Time at the start of an episode that is not measured, s."""
Profile = tuple[tuple[float, float, float], ...]
CHANGES: Profile = ((0.0, 1.0, -1.0), (2.2, 1.0, 1.0), (4.4, 0.3, 1.0))
"""Changes of the command in an episode of learning: from the mirror image to the command, then slower."""
_CONTEXT_SIGN = (1.0, -1.0, -1.0)
_THETA_SIGN = (1.0,) * (len(STEERED_PARAM_NAMES) - 2) + (-1.0, -1.0)
"""Signs of the mirror image."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of the experiment.

    Attributes:
        iterations: iterations of learning.
        samples: new samples of an iteration.
        first_samples: new samples of the first iteration.
        repeats: rollouts of a sample, averaged.
        archive_size: number of samples that are kept, with their mirror images.
        kl_bound: bound epsilon of an update, nats.
        mean_kl_bound: bound on the change of the policy's mean in an update, nats.
        cov_kl_bound: bound on the change of its covariance, nats.
        significance: largest p-value at which the covariance still moves.
        degree: degree of the polynomial features of the command.
        start_std: standard deviation of the first policy, before squashing.
        start_policy: policy file of this experiment to continue, instead of a first policy from scratch; with
            its own deviations, those of the last iteration.
        learning_noise: factor of the usual noise in learning: so large that many samples fall. Where falls
            are rare, rewards differ in the speeds only, and the search does not learn to stay up.
        candidates: number of policies, from equally spaced iterations of the second half of learning. The
            policy that stays up longest in drives by random commands, in the noise of learning, is kept.
        candidate_drives: number of drives of each candidate.
        candidate_seconds: length of a drive of a candidate, s.
        learning_duration: length of an episode in learning, s.
        duration: length of an episode of the evaluation, s.
        heading_gain: share of the heading error that a step turns back; a robot that is steered needs
            none, and falls less without.
        placement_gain: shift of the landing foot towards the side of the tilt, see `Balance`.
        filter_time: time constant of the filter for the measured roll and pitch, s; 0 for no filter.
        forward_placement_gain: shift of the landing foot against the error of the pitch, see `Balance`.
        acceleration: largest rate of change of the command, kept with the policy: forward and sideways,
            m/s^2, and turning, rad/s^2.
        learning_acceleration: the same in learning: faster changes are harder.
        com: how the CoM is planned: continuous, or one_step as in the paper.
        eval_seeds: fresh episodes at each command of the evaluation.
        drives: number of drives by random commands, and of drives that stop and go on.
        drive_seconds: length of a drive by random commands, s.
        physics: simulator: auto, mjx or c.
    """

    iterations: int = 240
    samples: int = 60
    first_samples: int = 240
    repeats: int = 1
    archive_size: int = 900
    kl_bound: float = 0.5
    mean_kl_bound: float = 1.0
    cov_kl_bound: float = 0.1
    significance: float = 0.1
    degree: int = 2
    start_std: float = 0.7
    start_policy: str | None = None
    learning_noise: float = 2.8
    candidates: int = 8
    candidate_drives: int = 40
    candidate_seconds: float = 30.0
    learning_duration: float = 6.4
    duration: float = 8.0
    heading_gain: float = 0.0
    placement_gain: float = 0.5
    filter_time: float = 0.06
    forward_placement_gain: float = 0.0
    acceleration: tuple[float, float, float] = (0.7, 0.08, 0.4)
    learning_acceleration: tuple[float, float, float] = (0.6, 0.4, 2.0)
    com: str = "continuous"
    eval_seeds: int = 10
    drives: int = 50
    drive_seconds: float = 60.0
    physics: str = "auto"

    def balance(self) -> Balance:
        """Return the gains of the response to the measured orientation."""
        return Balance(self.heading_gain, self.placement_gain, self.filter_time, self.forward_placement_gain)

    def features(self) -> FeatureMap:
        """Return the features of the command: all products up to a degree."""
        return polynomial_features(len(COMMAND_NAMES), self.degree)


SETTINGS = {"quick": Settings()}


def make_task(
    settings: Settings,
    *,
    noise: float,
    duration: float,
    acceleration: tuple[float, float, float],
    profile: Profile = ((0.0, 1.0, 1.0),),
) -> Task:
    """Make the steered walk, with parameters limited to their bounds by a sigmoid."""
    task = nao_steered_walk(
        LOW,
        HIGH,
        duration=duration,
        start_up=START_UP,
        profile=profile,
        reward=SteeringReward(),
        noise=WalkNoise().times(noise),
        balance=settings.balance(),
        acceleration=acceleration,
        com=settings.com,
        physics=PHYSICS[settings.physics],
    )
    return sigmoid_constrained(task, *NAO_STEERED_BOUNDS)


def mirrored(algorithm: Creps) -> Creps:
    """Return a search that learns from the mirror image of each sample too: left and right are alike."""
    context_sign, theta_sign = jnp.array(_CONTEXT_SIGN), jnp.array(_THETA_SIGN)

    def tell(state: Any, batch: Batch) -> Any:
        pairs = (batch.context, context_sign), (batch.theta, theta_sign)
        context, theta = (jnp.concatenate([values, values * sign[None, :]]) for values, sign in pairs)
        return algorithm.tell(state, Batch(context, theta, jnp.concatenate([batch.reward, batch.reward])))

    return dataclasses.replace(algorithm, tell=tell)


def make_algorithm(settings: Settings) -> Creps:
    """Set up contextual REPS with polynomial features of the command."""
    return creps(
        settings.features(),
        kl_bound=settings.kl_bound,
        archive_size=settings.archive_size,
        m_step=fit_within(settings.mean_kl_bound, settings.cov_kl_bound),
        significance=settings.significance,
    )


def first_policy(settings: Settings) -> LinearGaussian:
    """Return the first policy: the middle of the bounds, and steps as long as the command needs.

    A step of duration T moves the body by T times the command; near the middle of the bounds a sigmoid is a
    line.

    Raises:
        UserError: if the policy to continue cannot be read, or has other features or bounds.
    """
    if settings.start_policy is not None:
        learned = load_walking_policy(Path(settings.start_policy), can_steer=True)
        if (learned.features, learned.parameters) != (settings.features(), PARAMETERS):
            raise UserError(f"{settings.start_policy} must have the features and bounds of these settings")
        return linear_policy(learned, "be learned further")
    low, high = np.array(NAO_STEERED_BOUNDS)
    duration = 0.5 * (low + high)[STEERED_PARAM_NAMES.index("step_duration")]
    start = start_policy(settings.features(), len(low), std=settings.start_std)
    coef = np.array(start.coef)
    for axis, name in enumerate(("step_length", "step_side", "step_turn")):
        index = STEERED_PARAM_NAMES.index(name)
        slope = 4.0 / (high - low)[index]
        coef[0, index] = -slope * 0.5 * (low + high)[index]
        coef[1 + axis, index] = slope * duration
    return start._replace(coef=jnp.asarray(coef))


def as_learned(settings: Settings, policy: LinearGaussian) -> Learned:
    """Return a policy with its features, spaces and task."""
    task = {
        "name": "steered walk",
        "robot": "nao",
        "balance": settings.balance()._asdict(),
        "com": settings.com,
        "acceleration": list(settings.acceleration),
    }
    return Learned(
        policy,
        settings.features(),
        Space(COMMAND_NAMES, LOW, HIGH, COMMAND_UNITS),
        PARAMETERS,
        task,
    )


def command_grid() -> np.ndarray:
    """Return the commands (n, 3) of the evaluation: a grid of the box, of which what is in the ellipsoid."""
    axes = [np.linspace(low, high, num) for low, high, num in zip(LOW, HIGH, (5, 3, 5), strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    offset = (grid - _MIDDLE) / _HALF
    inside = grid[np.sum(offset**2, axis=1) <= 1.0 + 1e-6]
    # The ends of the axes, and between them.
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / np.sqrt(3.0)
    return np.concatenate([inside, _MIDDLE + _HALF * corners]).astype(np.float32)


def random_commands(seed: int, num: int, seconds: float) -> np.ndarray:
    """Draw commands (num, ticks, 3) in the ellipsoid, each for 1 to 2 s."""
    rng = np.random.default_rng(seed)
    ticks = round(seconds / CONTROL_PERIOD)
    commands = np.zeros((num, ticks, 3), np.float32)
    for drive in commands:
        begin = 0
        while begin < ticks:
            direction = rng.normal(size=3)
            offset = rng.random() ** (1 / 3) * direction / np.linalg.norm(direction)
            end = begin + round(rng.uniform(1.0, 2.0) / CONTROL_PERIOD)
            drive[begin:end] = _MIDDLE + _HALF * offset
            begin = end
    return commands


def stops(num: int) -> np.ndarray:
    """Return commands (num, ticks, 3): 0.6 m/s for 4 s, zero for 7 s, and 0.3 m/s for 3 s."""
    seconds = np.array([4.0, 7.0, 3.0])
    parts = [
        np.tile(speed, (round(time / CONTROL_PERIOD), 1))
        for speed, time in zip(([0.6, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.0, 0.0]), seconds, strict=True)
    ]
    return np.tile(np.concatenate(parts).astype(np.float32), (num, 1, 1))


def drive_all(
    settings: Settings, walker: Walker, key: jax.Array, commands: np.ndarray, *, noise: float = 1.0
) -> Drive:
    """Drive a robot by each of the commands (n, ticks, 3); return the records (n, ticks, ...)."""
    physics = PHYSICS[settings.physics]

    def one(key: jax.Array, commands: jax.Array) -> Any:
        record = record_drive(key, walker, commands, noise=WalkNoise().times(noise), physics=physics)
        return record._replace(qpos=record.qpos[:, :7], set_point=record.set_point[:, :0])

    keys = jax.random.split(key, len(commands))
    return jax.jit(jax.vmap(one))(keys, jnp.asarray(commands))


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn, then evaluate the mean policy at a grid of commands, by random commands and by stops.

    Returns:
        Arrays of the learning (1, iterations), the share of time that the `candidates` (iterations) were up
        and which one was `kept`, the kept policy, `commands` (n, 3) of the evaluation with `speed`
        (n, seeds, 3) and `fell` (n, seeds). The parts `drive` and `noisy_drive` say whether drives by random
        commands fell, `stop` whether stops fell and the time until the robot stood.
    """
    evaluate_key, learn_key, drive_key, noisy_key, stop_key, keep_key = jax.random.split(key, 6)
    task = make_task(
        settings,
        noise=settings.learning_noise,
        duration=settings.learning_duration,
        acceleration=settings.learning_acceleration,
        profile=CHANGES,
    )
    plan = Plan(
        settings.iterations, settings.samples, settings.first_samples, settings.repeats, timestep=TIMESTEP
    )
    algorithm = make_algorithm(settings)
    states, log = learn(
        trial_keys(learn_key, 1),
        average_repeats(task, settings.repeats),
        mirrored(algorithm),
        first_policy(settings),
        plan,
        session=session,
        name="steer",
    )
    policies = jax.tree.map(lambda leaf: leaf[0], states.policy)._replace(coef=log["coef"][0])
    kept, upright = keep_steadiest(settings, keep_key, policies)
    policy = policies._replace(coef=jnp.asarray(policies.coef[kept]))
    return {
        "candidates": np.array(list(upright)),
        "candidate_upright": np.array(list(upright.values())),
        "kept": np.array(kept),
        "episodes": plan.episodes(np.arange(1, log["mean_reward"].shape[1] + 1)),
        "coef": np.asarray(policy.coef),
        "cov_chol": np.asarray(policy.cov_chol),
        **named("log", log),
        **evaluate_policy(settings, policy, (evaluate_key, drive_key, noisy_key, stop_key)),
    }


def keep_steadiest(
    settings: Settings, key: jax.Array, policies: LinearGaussian
) -> tuple[int, dict[int, float]]:
    """Drive with the policies of some iterations, and choose the one that stays up longest.

    Args:
        settings: The settings.
        key: Random key; the evaluation uses another one.
        policies: Policies whose `coef` has a leading axis, the iterations.

    Returns:
        Index of the chosen iteration, and the share of time that each candidate is up, by its index.
    """
    indices = candidate_iterations(len(policies.coef), settings.candidates)
    drives = random_commands(1, settings.candidate_drives, settings.candidate_seconds)

    @jax.jit
    def share_of_time(coef: jax.Array) -> jax.Array:
        walker = learned_walker(as_learned(settings, policies._replace(coef=coef)))
        driven = drive_all(settings, walker, key, drives, noise=settings.learning_noise)
        return 1.0 - jnp.mean(driven.has_fallen)

    upright = {int(index): float(share_of_time(jnp.asarray(policies.coef[index]))) for index in indices}
    return max(upright, key=lambda index: (upright[index], index)), upright


def evaluate_policy(
    settings: Settings, policy: LinearGaussian, keys: tuple[jax.Array, ...]
) -> dict[str, Any]:
    """Evaluate a mean policy; see `run`."""
    evaluate_key, drive_key, noisy_key, stop_key = keys
    commands = command_grid()
    thetas = make_algorithm(settings).mean(policy, commands)
    grid_task = make_task(settings, noise=1.0, duration=settings.duration, acceleration=settings.acceleration)
    outcome = evaluate(evaluate_key, grid_task, jnp.asarray(commands), thetas, repeats=settings.eval_seeds)
    walker = learned_walker(as_learned(settings, policy))
    drives = random_commands(0, settings.drives, settings.drive_seconds)
    usual = drive_all(settings, walker, drive_key, drives)
    noisy = drive_all(settings, walker, noisy_key, drives, noise=1.6)
    stopped = drive_all(settings, walker, stop_key, stops(settings.drives))
    return {
        "commands": commands,
        "speed": np.asarray(outcome.speed),
        "error": np.asarray(outcome.error),
        "fell": np.asarray(outcome.fell),
        **named("drive", {"fell": np.asarray(usual.has_fallen[:, -1])}),
        **named("noisy_drive", {"fell": np.asarray(noisy.has_fallen[:, -1])}),
        **named(
            "stop",
            {
                "fell": np.asarray(stopped.has_fallen[:, -1]),
                "seconds": time_to_stand(np.asarray(stopped.stage)),
            },
        ),
    }


def time_to_stand(stage: np.ndarray) -> np.ndarray:
    """Return the time (n,) from the command to stop until each robot stands, s; infinite if it never does."""
    begin, end = round(4.0 / CONTROL_PERIOD), round(11.0 / CONTROL_PERIOD)
    is_standing = stage[:, begin:end] == Stage.STANDING
    return np.where(is_standing.any(axis=1), is_standing.argmax(axis=1) * CONTROL_PERIOD, np.inf)


def plot(arrays: Arrays) -> dict[str, Figure]:
    """Draw the learning curve and traces of the updates."""
    episodes, mean_reward, traces = Learning.of(arrays)
    return {
        "learning_curve": plots.learning_curves(
            {"Learning to walk at any command": {"new samples": (episodes, mean_reward)}}
        ),
        "updates": plots.update_traces(episodes, {"steer": traces}),
    }


def table(arrays: Arrays) -> dict[str, list[object]]:
    """Return the evaluation at each command: falls and mean speeds."""
    columns: dict[str, list[object]] = {}
    for axis, (name, unit) in enumerate(zip(COMMAND_NAMES, COMMAND_UNITS, strict=True)):
        columns[f"{name} {unit}"] = [f"{value:+.2f}" for value in arrays["commands"][:, axis]]
        columns[f"{name} reached"] = [f"{value:+.2f}" for value in arrays["speed"][..., axis].mean(axis=1)]
    columns["falls"] = [f"{int(fell.sum())}/{fell.size}" for fell in arrays["fell"]]
    return columns


def finish(settings: Settings, arrays: Arrays, folder: Path, say: Callable[[str], None]) -> None:
    """Write the policy."""
    policy = LinearGaussian(jnp.asarray(arrays["coef"]), jnp.asarray(arrays["cov_chol"]))
    as_learned(settings, policy).save(folder / POLICY)
    say(f"policy: {folder / POLICY}")


def _mean_error(arrays: Arrays, axis: int) -> float:
    """Return the mean size of the error of the speed along an axis, over walks that do not fall."""
    return float(np.abs(arrays["error"][~arrays["fell"]][:, axis]).mean())


CLAIMS = (
    Claim("falls at the grid of commands", lambda arrays: float(arrays["fell"].sum()), high=0.0),
    Claim("mean error of the forward speed, m/s", lambda arrays: _mean_error(arrays, 0), high=0.03),
    Claim("mean error of the sideways speed, m/s", lambda arrays: _mean_error(arrays, 1), high=0.03),
    Claim("mean error of the turn rate, rad/s", lambda arrays: _mean_error(arrays, 2), high=0.1),
    Claim("falls of drives by random commands", lambda arrays: float(arrays["drive.fell"].sum()), high=0.0),
    Claim("falls in 1.6 times the noise", lambda arrays: float(arrays["noisy_drive.fell"].sum()), high=2.0),
    Claim("falls in stops from 0.6 m/s", lambda arrays: float(arrays["stop.fell"].sum()), high=0.0),
    Claim("longest time until it stands, s", lambda arrays: float(arrays["stop.seconds"].max()), high=2.0),
)
