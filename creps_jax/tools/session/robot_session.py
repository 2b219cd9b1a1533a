"""Search with a robot: ask for trials, run them, tell their results, at any time and from any process."""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.tools.session import plain, storage
from creps_jax.tools.session.settings import MAX_BATCH, Settings, load_settings
from creps_jax.tools.session.trials import Record, Trial

if TYPE_CHECKING:
    from creps_jax.policies.learned import Learned
    from creps_jax.tools.session.learner import Learner, Update

LOCK_SECONDS = 30.0
"""Time to wait for another process that uses the folder."""


class Told(NamedTuple):
    """The result of `RobotSession.tell`.

    Attributes:
        trial: the trial with its result.
        is_new: False if the result was known already, and nothing changed.
        update: the update of the policy, if this trial completed a batch.
    """

    trial: Trial
    is_new: bool
    update: "Update | None"


class Status(NamedTuple):
    """The state of a session.

    Attributes:
        settings: its settings.
        record: its trials.
        updates: the update by each complete batch.
        least_trials: number of trials that an update needs, without broken ones.
        contexts: (n, s) a grid over the range.
        first_parameters: (n, d) mean parameters of the first policy there.
        parameters: (n, d) mean parameters of the current policy.
    """

    settings: Settings
    record: Record
    updates: "tuple[Update, ...]"
    least_trials: int
    contexts: np.ndarray
    first_parameters: np.ndarray
    parameters: np.ndarray


class RobotSession:
    """A search that is kept in a folder; any number of instances, in any process, may use one folder.

    Results are on the disk before `tell` returns. The policy is not saved: it is computed from the results.
    Use `RobotSession.create` or `RobotSession.open`.
    """

    def __init__(self, folder: Path, settings: Settings, *, on_learning: Callable[[int], None] | None = None):
        self.folder = folder
        self.settings = settings
        self._on_learning = on_learning
        self._learner: Learner | None = None

    @classmethod
    def create(
        cls,
        folder: str | os.PathLike[str],
        *,
        policy: "str | os.PathLike[str] | Learned | None" = None,
        define: str | os.PathLike[str] | Mapping[str, Any] | None = None,
        exploration: float | None = None,
        **changes: Any,
    ) -> "RobotSession":
        """Begin a session in a new folder, from a policy or from a definition.

        Args:
            folder: the new folder; it must not exist.
            policy: a saved policy to begin with, or its file.
            define: the fields of `Settings`, or a JSON file of them.
            exploration: factor of the policy's standard deviations, 1 by default.
            changes: fields of `Settings` that replace those of the policy or the definition.

        Raises:
            UserError: for a mistake in the settings, or a folder that cannot be made.
        """
        from creps_jax.tools.session.learner import Learner

        if (policy is None) == (define is None):
            raise UserError("begin either with a policy (--policy) or with a definition (--define)")
        if define is not None and exploration is not None:
            raise UserError("exploration goes with a policy; a definition gives the spread of each parameter")
        if define is None:
            settings = _settings_from(policy, 1.0 if exploration is None else exploration)
        elif isinstance(define, Mapping):
            settings = plain.read(Settings, dict(define), "the definition")
        else:
            settings = load_settings(Path(define))
        fields = {**dataclasses.asdict(settings), **changes}
        settings = Learner(plain.read(Settings, fields, "settings")).settings
        storage.create(Path(folder), settings)
        return cls(Path(folder), settings)

    @classmethod
    def open(
        cls, folder: str | os.PathLike[str], *, on_learning: Callable[[int], None] | None = None
    ) -> "RobotSession":
        """Continue a session.

        Args:
            folder: its folder.
            on_learning: called with the number of trials before the policy learns from them, which takes
                seconds when it is compiled.

        Raises:
            UserError: if the folder holds no session, or one of its files is cut short or foreign.
        """
        session = cls(Path(folder), storage.open_settings(Path(folder)), on_learning=on_learning)
        session._record()
        return session

    def pending(self) -> list[Trial]:
        """Return the trials that have no result yet."""
        return self._record().pending()

    def ask(self, context: Sequence[float] | None = None, *, more: int | None = None) -> list[Trial]:
        """Return the pending trials; if there are none, or if `more` is given, ask for new ones first.

        Args:
            context: a number for each context variable, for all new trials; by default each draws its own
                uniformly from the range.
            more: number of new trials, whether others are pending or not. By default there are new trials
                only if none is pending: one for a given context, else enough to complete the batch.

        Returns:
            All pending trials, new ones last.

        Raises:
            UserError: if a context is given and trials of other contexts are pending, if it is not within the
                ranges, or if the folder cannot be written.
        """
        if context is not None:
            context = self.settings.checked_context(context)
        if more is not None and not 1 <= more <= MAX_BATCH:
            raise UserError(f"more must be from 1 to {MAX_BATCH}, got {more}")
        with storage.locked(self.folder, wait=LOCK_SECONDS):
            record = self._record()
            pending = record.pending()
            if pending and more is None:
                _check_contexts(pending, context)
                return pending
            size = self.settings.batch_size
            new = more or (size - len(record.told()) % size if context is None else 1)
            learner = self._learned(record)
            first = len(record.trials) + 1
            record = record.asked([learner.propose(first + i, context) for i in range(new)])
            storage.save_record(self.folder, record)
        return record.pending()

    def tell(self, trial_id: int, reward: float, *, replace: bool = False) -> Told:
        """Tell the reward of a trial; if this completes a batch, the policy is updated.

        Args:
            trial_id: number of the trial.
            reward: the higher, the better; NaN is a measurement that failed: nothing is learned from it.
            replace: whether an earlier result may be changed; possible until the trial's batch is complete.

        Raises:
            UserError: if the trial does not exist or has another result, the reward is infinite, or the
                folder cannot be written.
        """
        size = self.settings.batch_size
        with storage.locked(self.folder, wait=LOCK_SECONDS):
            before = self._record()
            record = before.with_told(trial_id, reward, batch_size=size, replace=replace)
            self._save(before, record)
        is_complete = len(record.batches(size)) > len(before.batches(size))
        update = self._learned(record).updates[-1] if is_complete else None
        return Told(record.trial(trial_id), record != before, update)

    def repeat(self, trial_id: int, *, replace: bool = False) -> Trial:
        """Make a trial that was not valid pending again, to be run with the same parameters.

        Args:
            trial_id: number of the trial.
            replace: whether its result may be dropped; possible until its batch is complete.

        Raises:
            UserError: if the trial does not exist or has a result, or the folder cannot be written.
        """
        with storage.locked(self.folder, wait=LOCK_SECONDS):
            before = self._record()
            record = before.with_repeat(trial_id, batch_size=self.settings.batch_size, replace=replace)
            self._save(before, record)
        return record.trial(trial_id)

    def status(self) -> Status:
        """Return the state of the session; `creps_jax.tools.session.page` draws it."""
        record = self._record()
        learner = self._learned(record)
        return Status(
            settings=self.settings,
            record=record,
            updates=tuple(learner.updates),
            least_trials=sum(learner.first.coef.shape),
            contexts=learner.contexts,
            first_parameters=learner.mean_parameters(learner.first),
            parameters=learner.mean_parameters(learner.policy),
        )

    def policy(self) -> "Learned":
        """Return the current policy; its `save` writes a policy file."""
        return self._learned(self._record()).learned()

    def _record(self) -> Record:
        return storage.load_record(self.folder, self.settings)

    def _save(self, before: Record, record: Record) -> None:
        if record != before:
            storage.save_record(self.folder, record)
        else:
            # Another process may have written the result and ended before the folder was synced.
            files.sync_folder(self.folder)

    def _learned(self, record: Record) -> "Learner":
        batches = record.batches(self.settings.batch_size)
        num_before = 0 if self._learner is None else len(self._learner.updates)
        if self._on_learning is not None and len(batches) > num_before:
            trials = [trial for batch in batches for trial in batch]
            kept = trials[-(self.settings.archive_size or 0) :]
            self._on_learning(sum(not trial.is_broken for trial in kept))
        # It starts jax.
        from creps_jax.tools.session.learner import Learner

        if self._learner is None:
            self._learner = Learner(self.settings)
        self._learner.learn(batches)
        return self._learner


def _settings_from(policy: Any, exploration: float) -> Settings:
    from creps_jax.policies.learned import Learned, load
    from creps_jax.tools.session.start import settings_from_policy

    saved = policy if isinstance(policy, Learned) else load(Path(policy))
    return settings_from_policy(saved, exploration=exploration)


def _check_contexts(pending: Sequence[Trial], context: Sequence[float] | None) -> None:
    for trial in pending:
        if context is not None and list(trial.context.values()) != list(context):
            there = ", ".join(f"{name} {value:g}" for name, value in trial.context.items())
            raise UserError(
                f"trial {trial.id} is pending, at {there}: tell it first, or add --more 1 to ask for another"
            )
