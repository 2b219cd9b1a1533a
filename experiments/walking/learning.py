"""Learn to walk, and evaluate the walks, by the settings of an experiment."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax.errors import UserError
from creps_jax.policies.bounds import CLIP, PENALTY, SIGMOID
from creps_jax.policies.gaussian import LinearGaussian, start_policy
from creps_jax.policies.learned import Learned, linear_policy
from creps_jax.policies.space import Space, sigmoid_gate
from creps_jax.search.creps import Creps, CrepsState, creps
from creps_jax.search.fit import fit_within
from creps_jax.tasks import Task, average_repeats, penalised, sigmoid_constrained
from creps_jax.tasks.closed_loop import WalkNoise
from creps_jax.tasks.walking import WalkReward, nao_walk
from creps_jax.tools.play import START_UP, load_walking_policy
from creps_jax.tools.robots import is_spec, robot_id
from creps_jax.training import evaluate
from creps_jax.walking.params import PARAM_NAMES, PARAM_UNITS
from experiments.learning import Log, Plan, Session, learn, trial_keys
from experiments.walking.settings import PHYSICS, SAMPLERS, TIMESTEP, Settings

PENALTY_SIZE = 1000.0
"""Penalty of the reward for parameters outside of their bounds, see `penalised`."""


def make_plan(settings: Settings) -> Plan:
    """Return the numbers of iterations and samples."""
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
    """Learn in all trials, by default from `first_policy`; see `learn` for the log."""
    task = make_task(
        settings,
        noise=settings.learning_noise,
        duration=settings.learning_duration,
        reward=WalkReward(upright=settings.of_robot("upright")),
    )
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
    """Roll out the mean policies (trials, ...) at 11 speeds, for the NAO the paper's, with new seeds.

    Args:
        settings: settings of the experiment.
        key: random key.
        policy: the policies.
        noise: factor of the usual noise.

    Returns:
        The speeds (n,), m/s, and the outcome (trials, n, seeds).
    """
    speeds = settings.speeds()
    contexts = speeds[:, None]
    thetas = np.asarray(jax.vmap(make_algorithm(settings).mean, (0, None))(policy, contexts))
    return speeds, evaluate_trials(
        key, make_task(settings, noise=noise), contexts, thetas, repeats=settings.eval_seeds
    )


def make_task(
    settings: Settings,
    *,
    noise: float = 1.0,
    duration: float | None = None,
    reward: WalkReward = WalkReward(),
) -> Task:
    """Make the walking task, with parameters limited to their bounds.

    Args:
        settings: settings of the experiment.
        noise: factor of the usual noise.
        duration: length of an episode, s; by default the length of the evaluation.
        reward: weights of the reward; by default the paper's.
    """
    low, high, margin = map(np.array, (*settings.context_range(), settings.margins()))
    task = nao_walk(
        float(low[0]),
        float(high[0]),
        sample_context=SAMPLERS[settings.sampler](low - margin, high + margin),
        duration=settings.duration if duration is None else duration,
        start_up=START_UP,
        reward=reward,
        noise=WalkNoise().times(noise),
        balance=settings.balance(),
        physics=PHYSICS[settings.physics],
        conditions=settings.conditions(),
        robot=settings.ranges().robot,
        com=settings.of_robot("com"),
    )
    if settings.constraint == PENALTY:
        return penalised(task, *settings.box(), PENALTY_SIZE)
    return sigmoid_constrained(task, *settings.box())


def make_algorithm(settings: Settings) -> Creps:
    """Set up contextual REPS with the features of the settings and their baseline features."""
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
    """Return the first policy: from a file, or the same parameters for every context.

    Raises:
        UserError: if the file cannot be read, or its policy has other features or bounds.
    """
    if settings.start_policy is not None:
        learned = load_walking_policy(Path(settings.start_policy), settings.robot)
        wanted = settings.features.make(*settings.context_range()), parameter_space(settings)
        if (learned.features, learned.parameters) != wanted:
            raise UserError(f"{settings.start_policy} has other features or bounds than these settings")
        return linear_policy(learned, "be learned further")
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
    """Return a policy with its features, spaces and task: all that is needed to use it."""
    conditions = settings.conditions()
    low, high = settings.context_range()
    task = {
        "name": "walk",
        "balance": settings.balance()._asdict(),
        "robot": settings.ranges().robot.name,
        "com": settings.of_robot("com"),
    }
    if is_spec(settings.robot):
        task["spec"] = robot_id(settings.robot)
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
        task,
    )
