"""Learn to walk at a given speed (Abdolmaleki et al. 2016, 4.3, Fig. 11, Table 2)."""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from creps_jax import files
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.policies.learned import Learned
from creps_jax.tools import plots, robot_check, tables
from creps_jax.tools.play import POLICY, filmed_speeds, record, save_film
from creps_jax.tools.robots import is_spec
from creps_jax.walking.params import PARAM_LABELS, PARAM_NAMES, PARAM_UNITS
from experiments.learning import Log, Session, candidate_iterations
from experiments.records import Arrays, Learning, Walks, named
from experiments.registry import Claim
from experiments.walking import learning
from experiments.walking.settings import SETTINGS as SETTINGS
from experiments.walking.settings import Settings


def run(settings: Settings, key: jax.Array, session: Session = Session()) -> dict[str, np.ndarray]:
    """Learn, then evaluate the mean policy of each trial at 11 speeds with new seeds.

    Returns:
        Arrays of the learning (trials, iterations), the policies, their parameters over the speeds
        (trials, n, d), the evaluation (trials, n, seeds) and, for several policies to choose from,
        `trial_reward` (trials,), the mean reward at the same speeds in the noise of learning, by which a
        trial is chosen, and `kept` (trials,), the iteration whose policy is kept.
    """
    evaluate_key, learn_key = jax.random.split(key)
    if is_spec(settings.robot) and session.console is not None:
        session.console.print(robot_check.summary(robot_check.try_standard_gaits(settings.ranges())))
    states, log = learning.learn_to_walk(settings, learn_key, session=session, name="walk")
    if session.console is not None:
        session.console.print(f"evaluating the policy at {len(settings.speeds())} speeds")
    policy, choice = _keep_best(settings, jax.random.fold_in(key, 1), states.policy, log["coef"])
    speeds, outcome = learning.walk_at_all_speeds(settings, evaluate_key, policy)
    fine = settings.speeds(51)
    policies = [
        learning.as_learned(settings, LinearGaussian(*pair))
        for pair in zip(*map(np.asarray, policy), strict=True)
    ]
    return {
        **learned_arrays(settings, policy, log),
        "fine_speeds": fine,
        "fine_theta": np.stack([[policy.theta(float(speed)) for speed in fine] for policy in policies]),
        "speeds": speeds,
        **choice,
        **Walks.of(outcome._asdict())._asdict(),
        **dict(zip(("bound_low", "bound_high"), map(np.array, settings.box()), strict=True)),
    }


def _keep_best(
    settings: Settings, key: jax.Array, policy: LinearGaussian, coefs: np.ndarray
) -> tuple[LinearGaussian, dict[str, np.ndarray]]:
    """Keep the best of the candidates of each trial, by other random numbers than the evaluation has.

    Args:
        settings: the settings.
        key: random key.
        policy: the last policies (trials, ...).
        coefs: coefficients (trials, iterations, p, d) after each iteration.

    Returns:
        The policies (trials, ...), and the arrays of the choice, see `run`.
    """
    trials, iterations = coefs.shape[:2]
    if settings.candidates * trials == 1:
        return policy, {}
    # The latest first: argmax keeps it among equals.
    tried = candidate_iterations(iterations, settings.candidates)[::-1]
    candidates = jax.tree.map(lambda leaf: jnp.repeat(leaf, len(tried), axis=0), policy)
    candidates = candidates._replace(coef=jnp.asarray(coefs[:, tried].reshape(-1, *coefs.shape[2:])))
    _, outcome = learning.walk_at_all_speeds(settings, key, candidates, noise=settings.learning_noise)
    rewards = outcome.reward.mean(axis=(1, 2)).reshape(trials, len(tried))
    best, trial = rewards.argmax(axis=1), np.arange(trials)
    kept = policy._replace(coef=jnp.asarray(coefs[trial, tried[best]]))
    return kept, {"trial_reward": rewards[trial, best], "kept": tried[best] + 1}


def learned_arrays(settings: Settings, policy: LinearGaussian, log: Log) -> dict[str, np.ndarray]:
    """Return the policies, the log and the episodes of each iteration as arrays of a result."""
    return {
        "episodes": learning.make_plan(settings).episodes(np.arange(1, log["mean_reward"].shape[1] + 1)),
        "coef": np.asarray(policy.coef),
        "cov_chol": np.asarray(policy.cov_chol),
        **named("log", log),
    }


def chosen_trial(arrays: Arrays) -> int:
    """Return the trial whose policy is kept; the evaluation must not decide.

    The trials are compared by `trial_reward`, or if there is none by their last iterations of learning.
    """
    if "trial_reward" in arrays:
        return int(np.argmax(arrays["trial_reward"]))
    return int(np.argmax(Learning.of(arrays).mean_reward[:, -10:].mean(axis=1)))


def chosen_walks(arrays: Arrays) -> Walks:
    """Return the evaluation of the trial whose policy is kept."""
    return Walks.of(arrays, chosen_trial(arrays))


def plot(arrays: Arrays) -> dict[str, Figure]:
    """Draw the learning curve, each parameter against speed, and reached against asked speed."""
    walks, speeds = chosen_walks(arrays), arrays["speeds"].astype(float)
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
            title="Parameters against asked speed",
            chosen=chosen_trial(arrays),
        ),
        "speed": plots.reached_against_asked(
            speeds, walks.speed[..., 0], walks.fell, title="Reached against asked speed", paper=lowest
        ),
    }


def plot_learning(arrays: Arrays) -> dict[str, Figure]:
    """Draw the learning curve, and traces of the updates."""
    episodes, mean_reward, traces = Learning.of(arrays)
    return {
        "learning_curve": plots.learning_curves(
            {"Learning to walk": {"new samples": (episodes, mean_reward)}}
        ),
        "updates": plots.update_traces(episodes, {"walk": traces}),
    }


def table(arrays: Arrays) -> dict[str, list[object]]:
    """Return the evaluation of the chosen trial."""
    return tables.speed_table(arrays["speeds"], *chosen_walks(arrays))


def finish(settings: Settings, arrays: Arrays, folder: Path, say: Callable[[str], None]) -> None:
    """Write the table as CSV too, and policy and video of the chosen trial."""
    files.save_text(folder / "table.csv", tables.to_csv(table(arrays)))
    policy = save_policy(settings, arrays, folder, say)
    robot = settings.ranges().robot
    say("writing the video of walks at several speeds")
    clips = record(policy, filmed_speeds(policy), seed=0, robot=robot, duration=settings.duration)
    save_film(clips, folder / "walk.mp4", say, robot=robot)


def save_policy(settings: Settings, arrays: Arrays, folder: Path, say: Callable[[str], None]) -> Learned:
    """Write the policy of the chosen trial into a result folder, and return it."""
    trial = chosen_trial(arrays)
    policy = learning.as_learned(settings, LinearGaussian(arrays["coef"][trial], arrays["cov_chol"][trial]))
    policy.save(folder / POLICY)
    say(f"policy: {folder / POLICY}")
    return policy


def param_titles() -> list[str]:
    """Return the names of the walking parameters with the paper's symbols."""
    return [
        f"{name.replace('_', ' ')} {symbol}" for name, symbol in zip(PARAM_NAMES, _symbols(), strict=True)
    ]


def _symbols() -> list[str]:
    """Return the paper's symbols as matplotlib's mathematical text."""
    greek = {"gamma": r"\gamma", "phi": r"\phi", "sigma": r"\sigma"}
    symbols = []
    for label in PARAM_LABELS:
        head, _, tail = label.partition("_")
        head = greek.get(head, head[0] + (f"_{{{head[1:]}}}" if len(head) > 1 else ""))
        symbols.append(f"${head}_{{{tail}}}$" if tail else f"${head}$")
    return symbols


CLAIMS = (
    Claim(
        "mean reward over the 11 speeds",
        lambda arrays: float(chosen_walks(arrays).reward.mean()),
        low=-0.343,
        paper=float(np.mean(tables.PAPER_RBF)),
    ),
    Claim("share of falls", lambda arrays: float(chosen_walks(arrays).fell.mean()), high=0.0, paper=0.0),
    Claim(
        "reached speed at an asked speed of 0.6 m/s",
        lambda arrays: float(chosen_walks(arrays).speed[-1, :, 0].mean()),
        low=0.5,
        paper=0.3,
    ),
)
