"""Read the commands of a robot session: `creps-jax session new | ask | tell | status | save`."""

import dataclasses
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg, subcommand

from creps_jax.errors import UserError
from creps_jax.policies.bounds import range_text
from creps_jax.tools.session.robot_session import RobotSession
from creps_jax.tools.session.settings import Context
from creps_jax.tools.session.storage import TRIALS
from creps_jax.tools.session.trials import Trial
from creps_jax.tools.tables import to_markdown

_COLUMNS = 6
"""Number of trials side by side that fit into a terminal."""

_Folder = Annotated[Path, arg(metavar="FOLDER")]
_Id = Annotated[int, arg(metavar="ID")]
_Integer = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
_Number = Annotated[float | None, arg(metavar="X", help_behavior_hint="")]
_Numbers = Annotated[tuple[float, ...], arg(metavar="X ...", help_behavior_hint="")]
_File = Annotated[Path | None, arg(metavar="PATH", help_behavior_hint="")]


@dataclasses.dataclass(frozen=True)
class New:
    """Begin a session in a new folder, from a saved policy or from a definition.

    Attributes:
        folder: The new folder.
        policy: Policy file to begin with, a simulated one for example.
        define: JSON file that defines the contexts and the parameters.
        exploration: Factor of the policy's standard deviations; 1 by default.
        batch_size: Number of trials for an update; 10 by default.
        archive_size: Number of last trials to learn from; by default five batches, and at least twice the
            number of features and parameters; with more than 10 features, also three for each
            coefficient, features times parameters.
        kl_bound: Bound on the relative entropy of the weights of trials, in nats; 0.5 by default.
        seed: Seed of contexts and exploration; 0 by default.
    """

    folder: Positional[_Folder]
    policy: _File = None
    define: _File = None
    exploration: _Number = None
    batch_size: _Integer = None
    archive_size: _Integer = None
    kl_bound: _Number = None
    seed: _Integer = None


@dataclasses.dataclass(frozen=True)
class Ask:
    """Show the trials to run; ask for new ones if none is pending.

    Attributes:
        folder: The session.
        context: A number for each context variable; by default each new trial draws its own from the range.
        more: Number of new trials to ask for while others are pending.
    """

    folder: Positional[_Folder]
    context: _Numbers = ()
    more: _Integer = None


@dataclasses.dataclass(frozen=True)
class Tell:
    """Enter the result of a trial.

    Attributes:
        folder: The session.
        trial: The trial's number.
        reward: Its reward: the higher, the better.
        broken: The measurement failed: nothing is learned from the trial.
        repeat: The trial was not valid: run it again with the same parameters; it stays pending.
        replace: Change an earlier result; possible until the batch is complete.
    """

    folder: Positional[_Folder]
    trial: Positional[_Id]
    reward: _Number = None
    broken: bool = False
    repeat: bool = False
    replace: bool = False


@dataclasses.dataclass(frozen=True)
class Status:
    """Show the state of a session, and write it to status.md and status.png.

    Attributes:
        folder: The session.
    """

    folder: Positional[_Folder]


@dataclasses.dataclass(frozen=True)
class Save:
    """Save the current policy to a file for other commands.

    Attributes:
        folder: The session.
        to: The policy file, .npz.
    """

    folder: Positional[_Folder]
    to: Annotated[Path, arg(metavar="PATH")]


_Action = (
    Annotated[New, subcommand("new", prefix_name=False)]
    | Annotated[Ask, subcommand("ask", prefix_name=False)]
    | Annotated[Tell, subcommand("tell", prefix_name=False)]
    | Annotated[Status, subcommand("status", prefix_name=False)]
    | Annotated[Save, subcommand("save", prefix_name=False)]
)


@dataclasses.dataclass(frozen=True)
class SessionCommand:
    """Learn on a real robot, trial by trial, from a folder that stays consistent."""

    action: OmitArgPrefixes[_Action]


def run(command: SessionCommand, *, say: Callable[[str], None]) -> None:
    """Run a command.

    Raises:
        UserError: for a mistake, or a folder that cannot be read or written.
    """
    _HANDLERS[type(command.action)](command.action, say)


def _open(folder: Path) -> RobotSession:
    return RobotSession.open(folder, on_learning=_announce)


def _announce(num_trials: int) -> None:
    """Say on stderr why the command is silent for some seconds; stdout has only its results."""
    print(f"learning from {num_trials} trials ...", file=sys.stderr, flush=True)


def _new(command: New, say: Callable[[str], None]) -> None:
    names = ("batch_size", "archive_size", "kl_bound", "seed")
    changes = {name: getattr(command, name) for name in names if getattr(command, name) is not None}
    session = RobotSession.create(
        command.folder,
        policy=command.policy,
        define=command.define,
        exploration=command.exploration,
        **changes,
    )
    settings = session.settings
    say(f"session: {command.folder}")
    say(f"contexts: {_list(settings.contexts)}")
    say(f"parameters: {_list(settings.parameters)}")
    say(f"an update takes {settings.batch_size} trials and learns from the last {settings.archive_size}")
    from creps_jax.tools.session.start import feature_map

    least = feature_map(settings).size + len(settings.parameters)
    if least > settings.batch_size:
        say(f"the first update needs {least} valid trials, more than one batch")
    say(f"next: creps-jax session ask {command.folder}")


def _list(variables: Sequence[Context]) -> str:
    return ", ".join(f"{each.name} {range_text(each.low, each.high, each.unit)}" for each in variables)


def _ask(command: Ask, say: Callable[[str], None]) -> None:
    session = _open(command.folder)
    trials = session.ask(command.context or None, more=command.more)
    say(trial_table(session, trials))
    say(f"to run: {len(trials)} (exact numbers: {command.folder / TRIALS})")
    say(f"then: creps-jax session tell {command.folder} {trials[0].id} --reward X")


def trial_table(session: RobotSession, trials: Sequence[Trial]) -> str:
    """Lay out trials side by side, contexts above parameters, with units."""
    settings = session.settings
    labels = [each.label for each in (*settings.contexts, *settings.parameters)]
    tables = []
    for first in range(0, len(trials), _COLUMNS):
        columns: dict[str, list[object]] = {"trial": list(labels)}
        for trial in trials[first : first + _COLUMNS]:
            values = (*trial.context.values(), *trial.parameters.values())
            columns[str(trial.id)] = [f"{value:.5g}" for value in values]
        tables.append(to_markdown(columns))
    return "\n".join(tables)


def _tell(command: Tell, say: Callable[[str], None]) -> None:
    if (command.reward is not None) + command.broken + command.repeat != 1:
        raise UserError("tell one of --reward X, --broken and --repeat")
    session = _open(command.folder)
    if command.repeat:
        trial = session.repeat(command.trial, replace=command.replace)
        say(f"trial {trial.id} is pending: run it again\n\n{trial_table(session, [trial])}")
        return
    reward = math.nan if command.reward is None else command.reward
    trial, is_new, update = session.tell(command.trial, reward, replace=command.replace)
    if not is_new:
        say(f"trial {trial.id}: {trial.result}, known already; nothing changed")
        return
    say(f"trial {trial.id}: {trial.result}")
    if update is None:
        return
    if update.is_updated:
        say(
            f"the batch is complete: the policy moved by {update.kl:.3f} nats (KL), its entropy is now "
            f"{update.entropy:.2f}; {update.effective_samples:.1f} of {update.num_valid} trials effective; "
            f"p = {update.p_value:.2g}: the smaller, the clearer is that rewards depend on the parameters"
        )
    elif not update.is_informative and update.num_valid >= sum(update.policy.coef.shape):
        say("the batch is complete, but the context alone explains its rewards: the policy stays")
    else:
        say(
            f"the batch is complete, but {update.num_valid} valid trials are too few for a first update: it "
            f"needs {sum(update.policy.coef.shape)}. They are kept, and the policy stays"
        )


def _status(command: Status, say: Callable[[str], None]) -> None:
    from creps_jax.tools.session import page

    status = _open(command.folder).status()
    for line in page.summary(status):
        say(line)
    say("\n" + page.table(status))
    page.save_page(command.folder, status)
    say(f"page: {command.folder / page.PAGE}, figure: {command.folder / page.FIGURE}")


def _save(command: Save, say: Callable[[str], None]) -> None:
    policy = _open(command.folder).policy()
    policy.save(command.to)
    say(f"policy: {command.to}")


_HANDLERS: dict[type, Callable[..., None]] = {New: _new, Ask: _ask, Tell: _tell, Status: _status, Save: _save}
