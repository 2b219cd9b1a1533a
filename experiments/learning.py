"""Learn with a progress display and with checkpoints."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from creps_jax.checkpoints import Checkpoint, append_log, load_checkpoint, named_leaves, save_checkpoint
from creps_jax.search.creps import Creps, CrepsState
from creps_jax.tasks.base import Task
from creps_jax.training import Samples, train_trials
from experiments.progress import PooledSamples, Progress, Row
from experiments.records import Part

_SECONDS_BETWEEN_CHECKPOINTS = 2.0

Log = dict[str, np.ndarray]


@dataclasses.dataclass(frozen=True)
class Session:
    """The folder of the checkpoints of a run, and the console of its progress.

    Attributes:
        folder: the result folder; None saves no checkpoints.
        identity: identifies the checkpoints of this run, see `save_checkpoint`.
        console: console of the progress; None shows none.
        is_keeper: whether this process writes to the folder: one of the processes that share a run does.
    """

    folder: Path | None = None
    identity: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    console: Console | None = None
    is_keeper: bool = True


@dataclasses.dataclass(frozen=True)
class Plan:
    """The numbers of iterations and samples.

    Attributes:
        iterations: number of iterations, including the iterations of an interrupted run.
        samples: new samples of each trial in an iteration.
        first_samples: new samples of each trial in the first iteration; None is `samples`.
        repeats: rollouts of a sample.
        timestep: physics time step in seconds, to report steps per second; None without physics.
    """

    iterations: int
    samples: int
    first_samples: int | None = None
    repeats: int = 1
    timestep: float | None = None

    def episodes(self, iteration: np.ndarray | int) -> Any:
        """Count the rollouts of a trial until the end of an iteration; the first iteration is 1."""
        first = self.samples if self.first_samples is None else self.first_samples
        return self.repeats * (first + self.samples * (np.asarray(iteration) - 1))


def candidate_iterations(iterations: int, num: int) -> np.ndarray:
    """Return indices of `num` equally spaced iterations of the second half of learning, with the last one.

    Indices rise. There are fewer if the second half has fewer iterations.
    """
    last = iterations - 1
    # From the last iteration on: with one candidate it is the last policy.
    return np.unique(np.linspace(last, last // 2, num).round().astype(int))


def trial_keys(key: jax.Array, trials: int) -> jax.Array:
    """Return a key for each trial; it does not depend on the number of trials."""
    return jax.vmap(lambda trial: jax.random.fold_in(key, trial))(jnp.arange(trials, dtype=jnp.uint32))


def learn(
    keys: jax.Array,
    task: Task,
    algorithm: Creps,
    policy: Any,
    plan: Plan,
    *,
    session: Session,
    name: str,
    devices: Sequence[jax.Device] | None = None,
) -> tuple[CrepsState, Log]:
    """Run all trials at once; continue from the checkpoint in the session's folder if there is one.

    Args:
        keys: (trials,) key of each trial.
        task: the task.
        algorithm: the search.
        policy: the first policy of every trial.
        plan: iterations and samples.
        session: where to save checkpoints and show progress.
        name: name of the checkpoint, `checkpoint-NAME.npz`, and title of the progress.
        devices: devices that share the rollouts; all devices of all processes by default.

    Returns:
        The last states (trials, ...), and the logs by name (trials, iterations, ...). The log has the arrays
        of `mean_arrays` after each iteration, such as `coef`; parts are `info` and `outcome`, see
        `records.Part`.

    Raises:
        KeyboardInterrupt: after the last complete iteration is saved.
        UserError: if the checkpoint is unreadable, belongs to another run, or cannot be written.
    """
    first = algorithm.init(policy)
    states = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(keys), *leaf.shape)), first)
    path = None if session.folder is None else session.folder / f"checkpoint-{name}.npz"
    identity = {**session.identity, "part": name, "trials": len(keys)}
    latest = Checkpoint(states, {})
    if path is not None and path.exists():
        latest = load_checkpoint(path, states, run=identity)

    def save(checkpoint: Checkpoint) -> None:
        if path is not None and session.is_keeper:
            save_checkpoint(path, checkpoint, run=identity)

    keeper = _Keeper(latest, save)
    earlier = latest.log["mean_reward"].mean(axis=1) if latest.log else np.zeros(0)
    done = len(earlier)
    if done < plan.iterations:
        lost = Part(latest.log, "info")["unsupported_loss"].mean(axis=1).sum() if latest.log else 0.0
        with _Reporter(name, plan, earlier=earlier, lost=lost, console=session.console) as report, keeper:

            def on_iteration(state: CrepsState, log: Any) -> None:
                keeper.take(state, log)
                report(log)

            train_trials(
                keys,
                task,
                algorithm,
                latest.state,
                iterations=plan.iterations - done,
                samples=plan.samples,
                first_samples=plan.first_samples,
                on_iteration=on_iteration,
                devices=jax.devices() if devices is None else devices,
            )
    latest = keeper.latest
    # A run that is resumed with fewer iterations than it has keeps all of them.
    return latest.state, {field: np.swapaxes(values, 0, 1) for field, values in latest.log.items()}


def mean_arrays(policy: Any) -> dict[str, np.ndarray]:
    """Return the arrays that the mean of a policy depends on, by name: `coef`, and layers of a network."""
    return {name: values for name, values in named_leaves(policy).items() if name != "cov_chol"}


def with_mean(policy: Any, arrays: Mapping[str, Any]) -> Any:
    """Return a policy with other arrays of `mean_arrays`."""
    leaves = [arrays.get(name, values) for name, values in named_leaves(policy).items()]
    return jax.tree.unflatten(jax.tree.structure(policy), leaves)


class _Keeper:
    """Save the latest iteration from time to time, and at the end, also after an error."""

    def __init__(self, latest: Checkpoint, save: Callable[[Checkpoint], Any]):
        self.latest = latest
        self._save = save
        self._saved = latest
        self._saved_at = time.monotonic()

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        if self._saved is not self.latest:
            self._write()

    def take(self, state: CrepsState, log: Any) -> None:
        # A single assignment: an interrupt cannot leave a part of an iteration.
        row = {**named_leaves(log._replace(samples=None)), **mean_arrays(state.policy)}
        self.latest = Checkpoint(state, append_log(self.latest.log, row))
        if time.monotonic() - self._saved_at >= _SECONDS_BETWEEN_CHECKPOINTS:
            self._write()

    def _write(self) -> None:
        self._save(self.latest)
        self._saved, self._saved_at = self.latest, time.monotonic()


class _Reporter:
    """Make rows of progress from the logs of iterations."""

    def __init__(self, name: str, plan: Plan, *, earlier: np.ndarray, lost: float, console: Console | None):
        self._plan, self._done, self._lost = plan, len(earlier), lost
        self._progress = None
        if console is not None:
            self._progress = Progress(
                f"learning {name}",
                plan.iterations,
                earlier=earlier.tolist(),
                timestep=plan.timestep,
                console=console,
            )

    def __enter__(self) -> Callable[[Any], None]:
        if self._progress is not None:
            self._progress.__enter__()
        return self._report

    def __exit__(self, *error: object) -> None:
        if self._progress is not None:
            self._progress.__exit__(*error)

    def _report(self, log: Any) -> None:
        self._done += 1
        self._lost += float(np.mean(log.info.unsupported_loss))
        if self._progress is None:
            return
        trials = len(log.mean_reward)
        episodes = trials * int(self._plan.episodes(self._done))
        new = episodes - (trials * int(self._plan.episodes(self._done - 1)) if self._done > 1 else 0)
        fell, seconds = getattr(log.outcome, "fell", None), getattr(log.outcome, "seconds", None)
        row = Row(
            iteration=self._done,
            episodes=episodes,
            mean_reward=float(np.mean(log.mean_reward)),
            fall_share=None if fell is None else float(np.mean(fell)),
            kl=float(np.mean(log.info.kl)),
            p_value=float(np.median(log.info.p_value)),
            unsupported_loss=self._lost,
            simulated_seconds=None if seconds is None else float(np.mean(seconds)) * new,
            samples=pooled(log.samples),
        )
        self._progress.update(row)


def pooled(samples: Samples) -> PooledSamples:
    """Return the new samples (trials, n, ...) of all trials for the progress display.

    The first variable of a walk's context is the asked speed, and the first of its speeds the forward speed.
    """
    outcome = samples.outcome
    fell, speed = getattr(outcome, "fell", None), getattr(outcome, "speed", None)
    return PooledSamples(
        context=np.asarray(samples.context)[..., 0].ravel(),
        reward=np.ravel(outcome.reward),
        speed=None if speed is None else np.asarray(speed)[..., 0].ravel(),
        fall_share=None if fell is None else np.asarray(fell, float).ravel(),
    )
