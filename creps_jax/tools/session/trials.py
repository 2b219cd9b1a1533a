"""Trials of a session and their results."""

import dataclasses
import math
from collections.abc import Sequence

from creps_jax.errors import UserError
from creps_jax.tools.session.plain import is_number

FORMAT = "creps_jax robot session 1"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trial:
    """One run of the robot.

    Attributes:
        id: a running number from 1.
        context: by name.
        parameters: the parameters to run the robot with, by name, within their bounds.
        theta: the free parameters that the search learns from, see `Settings.constraint`.
        told: place in the order of telling, from 1; None if the trial is pending.
        reward: None for a trial that has been told is a measurement that failed.
        repeats: number of times that it was sent back to be run again.
    """

    id: int
    context: dict[str, float]
    parameters: dict[str, float]
    theta: tuple[float, ...]
    told: int | None = None
    reward: float | None = None
    repeats: int = 0

    def __post_init__(self) -> None:
        if self.told is None and self.reward is not None:
            raise UserError(f"trial {self.id} has a reward but no place in the order of telling")

    @property
    def is_pending(self) -> bool:
        """Whether its result has not been told."""
        return self.told is None

    @property
    def is_broken(self) -> bool:
        """Whether it was told that the measurement failed."""
        return self.told is not None and self.reward is None

    @property
    def result(self) -> str:
        """The result in words."""
        if self.is_pending:
            return "pending"
        return "broken" if self.reward is None else f"reward {self.reward}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record:
    """All trials of a session, never changed in place; with the settings they determine the policy.

    Attributes:
        format: the name of the file format.
        settings: digest of the settings that the trials were asked for with.
        trials: by id.
    """

    format: str = FORMAT
    settings: str
    trials: tuple[Trial, ...] = ()

    def __post_init__(self) -> None:
        if [trial.id for trial in self.trials] != list(range(1, len(self.trials) + 1)):
            raise UserError(f"ids must run from 1, got {[trial.id for trial in self.trials]}")
        places = [trial.told for trial in self.trials if trial.told is not None]
        if len(set(places)) < len(places):
            raise UserError(f"each trial must have a place of its own in the order of telling, got {places}")

    def pending(self) -> list[Trial]:
        """Return the trials that have not been told."""
        return [trial for trial in self.trials if trial.is_pending]

    def told(self) -> list[Trial]:
        """Return the trials that have been told, in that order."""
        by_place = {trial.told: trial for trial in self.trials if trial.told is not None}
        return [by_place[place] for place in sorted(by_place)]

    def batches(self, size: int) -> list[list[Trial]]:
        """Return the trials that have been learned from: the complete batches of those told."""
        told = self.told()
        return [told[first : first + size] for first in range(0, len(told) - size + 1, size)]

    def trial(self, trial_id: int) -> Trial:
        """Return a trial.

        Raises:
            UserError: if it has not been asked for.
        """
        if 1 <= trial_id <= len(self.trials):
            return self.trials[trial_id - 1]
        known = f"those asked for are 1 to {len(self.trials)}" if self.trials else "none has been asked for"
        raise UserError(f"there is no trial {trial_id}: {known}")

    def asked(self, new: Sequence[Trial]) -> "Record":
        """Add trials."""
        return dataclasses.replace(self, trials=(*self.trials, *new))

    def with_told(self, trial_id: int, reward: float, *, batch_size: int, replace: bool) -> "Record":
        """Add the result of a trial; one that is known already changes nothing.

        Args:
            trial_id: number of the trial.
            reward: NaN is a measurement that failed.
            batch_size: number of trials for an update.
            replace: whether an earlier result may be replaced.

        Raises:
            UserError: if the trial does not exist, the reward is infinite, or the trial has another result
                that may not, or can no longer, be replaced.
        """
        trial = self.trial(trial_id)
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            raise UserError(f"the reward of trial {trial_id} must be a number, got {reward!r}") from None
        if not (math.isnan(reward) or is_number(reward)):
            raise UserError(
                f"the reward of trial {trial_id} must be finite, or NaN if broken, got {reward:g}"
            )
        result = dataclasses.replace(
            trial,
            reward=None if math.isnan(reward) else reward,
            told=self._next_place() if trial.told is None else trial.told,
        )
        if not trial.is_pending and trial.reward != result.reward:
            self._check_replaceable(trial, result.result, batch_size, replace)
        return self._with(result)

    def with_repeat(self, trial_id: int, *, batch_size: int, replace: bool) -> "Record":
        """Make a trial pending again, to be run with the same parameters.

        Raises:
            UserError: if the trial does not exist, or has a result that may not, or can no longer, be
                replaced.
        """
        trial = self.trial(trial_id)
        if not trial.is_pending:
            self._check_replaceable(trial, "to be repeated", batch_size, replace)
        return self._with(dataclasses.replace(trial, told=None, reward=None, repeats=trial.repeats + 1))

    def _next_place(self) -> int:
        told = self.told()
        return 1 + (told[-1].told or 0) if told else 1

    def _with(self, changed: Trial) -> "Record":
        trials = list(self.trials)
        trials[changed.id - 1] = changed
        return dataclasses.replace(self, trials=tuple(trials))

    def _check_replaceable(self, trial: Trial, wish: str, batch_size: int, replace: bool) -> None:
        for number, batch in enumerate(self.batches(batch_size), start=1):
            if trial in batch:
                raise UserError(
                    f"trial {trial.id} stays {trial.result}, not {wish}: batch {number} has been learned from"
                )
        if not replace:
            raise UserError(
                f"trial {trial.id} has been told already, {trial.result}, not {wish}; "
                "add --replace to change it"
            )
