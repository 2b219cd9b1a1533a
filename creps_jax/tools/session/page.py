"""Show the state of a session: in a few lines, in a table of its batches, and on a page with a figure."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from creps_jax import files
from creps_jax.tools import plots
from creps_jax.tools.session.robot_session import Status
from creps_jax.tools.session.trials import Trial
from creps_jax.tools.tables import to_markdown

PAGE, FIGURE = "status.md", "status.png"
_BEFORE, _NOW = plots.PAPER_COLOUR, plots.COLOURS[0]
_MAX_COLUMNS = 5

_MUCH_LOST = 0.5
"""The page warns if more than this entropy, in nats for each parameter, and more than this share of the total
loss, was lost by chance."""

_MANY_UPDATES, _CHANCE = 5, 0.1
"""The page warns if this number of successive updates all have p-values above this one."""


def save_page(folder: Path, status: Status) -> None:
    """Write the page and its figure into the folder of the session, atomically."""
    plots.save_figure(folder / FIGURE, draw(status))
    lines = "\n".join(f"- {line}" for line in summary(status))
    text = f"# Robot session\n\n{lines}\n\n{table(status)}\n![Rewards, updates and parameters]({FIGURE})\n"
    files.save_text(folder / PAGE, text)


def summary(status: Status) -> list[str]:
    """Return lines on the trials, and on the change of the policy since the first one."""
    told, size = status.record.told(), status.settings.batch_size
    broken = sum(trial.is_broken for trial in told)
    repeats = sum(trial.repeats for trial in status.record.trials)
    lines = [
        f"{len(told)} trials told, {broken} of them broken; {len(status.record.pending())} pending; "
        f"{repeats} sent back to be repeated",
        f"batch {len(told) // size + 1} has {len(told) % size} of {size} trials",
    ]
    updates = status.updates
    if updates:
        lines.append(f"the policy is {updates[-1].kl_from_first:.3g} nats from the first one (KL)")
    kept = sum(not update.is_updated for update in updates)
    if kept:
        lines.append(
            f"{kept} {'batch' if kept == 1 else 'batches'} left the policy as it was: "
            f"an update needs {status.least_trials} trials that are not broken, whose rewards "
            "differ by more than the context explains"
        )
    if updates:
        lines += _warnings(status)
    return lines


def _warnings(status: Status) -> list[str]:
    """Return warnings of a search that follows chance."""
    updates, lines = status.updates, []
    lost = sum(update.unsupported_loss for update in updates)
    all_lost = updates[0].entropy - updates[-1].entropy
    if lost > _MUCH_LOST * max(len(status.settings.parameters), all_lost):
        lines.append(
            f"exploration went without evidence: {lost:.2f} nats of entropy; more trials in a batch or a "
            "larger archive_size help"
        )
    last = updates[-_MANY_UPDATES:]
    if len(last) == _MANY_UPDATES and all(update.p_value > _CHANCE for update in last):
        lines.append(
            f"the last {len(last)} batches gave no evidence that rewards depend on the parameters (p above "
            f"{_CHANCE:g}): a larger archive_size, fewer features or less noise may help"
        )
    return lines


def table(status: Status) -> str:
    """Return the table of the batches; the last one may not be complete, and has no update then."""
    told, size = status.record.told(), status.settings.batch_size
    columns: dict[str, list[object]] = {
        name: []
        for name in (
            "batch", "trials", "broken", "best", "mean", "KL (nats)", "from first (nats)", "entropy (nats)",
            "learned from", "effective", "p (chance)",
        )
    }  # fmt: skip
    for number, first in enumerate(range(0, len(told), size)):
        batch = told[first : first + size]
        rewards = _rewards(batch)
        rewards = rewards[np.isfinite(rewards)]
        found = [f"{value:.4g}" for value in (rewards.max(), rewards.mean())] if len(rewards) else ["-", "-"]
        row = [number + 1, len(batch), sum(trial.is_broken for trial in batch), *found]
        if number < len(status.updates):
            update = status.updates[number]
            row += [f"{update.kl:.3f}" if update.is_updated else "kept", f"{update.kl_from_first:.3f}"]
            row += [f"{update.entropy:.2f}", update.num_valid, f"{update.effective_samples:.1f}"]
            row += [f"{update.p_value:.2g}"]
        else:
            row += ["-"] * 6
        for cells, cell in zip(columns.values(), row, strict=True):
            cells.append(cell)
    return to_markdown(columns)


def draw(status: Status) -> Figure:
    """Draw rewards in the order of telling, the KL of updates, and parameters against a single context."""
    variables = status.settings.parameters if len(status.settings.contexts) == 1 else ()
    columns = max(2, min(_MAX_COLUMNS, len(variables)))
    rows = 1 + -(-len(variables) // columns)
    figure, grid = plots.new_figure(
        rows,
        columns,
        width=max(8.0, 2.6 * columns),
        height=3.2 + 2.1 * (rows - 1),
        height_ratios=(1.4, *[1.0] * (rows - 1)),
    )
    places = grid[0, 0].get_gridspec()
    for axes in (*grid[0], *grid.flat[columns + len(variables) :]):
        axes.remove()
    top = places[0, :].subgridspec(1, 2, width_ratios=(2, 1))
    _draw_rewards(figure.add_subplot(top[0]), status.record.told(), status.settings.batch_size)
    _draw_updates(figure.add_subplot(top[1]), status)
    if variables:
        _draw_parameters(list(grid.flat[columns : columns + len(variables)]), status)
    return figure


def _draw_rewards(axes: Axes, told: Sequence[Trial], size: int) -> None:
    rewards = _rewards(told)
    place = np.arange(1, len(told) + 1)
    for first in range(0, len(told), 2 * size):
        axes.axvspan(first + 0.5, first + size + 0.5, color="#f3f3f3", zorder=0)
    axes.plot(place, rewards, "o", color=_NOW, markersize=4, alpha=0.55, label="trial")
    means = []
    for first in range(0, len(told), size):
        batch = rewards[first : first + size]
        if np.isfinite(batch).any():
            label = None if means else "mean of the batch"
            means.append(np.nanmean(batch))
            ends = (first + 0.5, first + len(batch) + 0.5)
            axes.plot(ends, [means[-1]] * 2, color=plots.COLOURS[1], label=label)
    is_broken = ~np.isfinite(rewards)
    if is_broken.any():
        # They have no reward: draw them at the bottom of the axes.
        foot = np.full(is_broken.sum(), 0.03)
        axes.plot(
            place[is_broken], foot, "x", color="black", transform=axes.get_xaxis_transform(), label="broken"
        )
    axes.set(xlabel="trial, in the order of telling", ylabel="reward", title="rewards")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _scale(axes, rewards, np.array(means))
    if len(told):
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, fontsize=8)


def _scale(axes: Axes, rewards: np.ndarray, means: np.ndarray) -> None:
    """Scale rewards by the means of the batches: a logarithm of single rewards shows mostly noise."""
    if np.nanmax(rewards, initial=-np.inf) <= 0:
        plots.reward_scale(axes, [means])
        if axes.get_yscale() != "linear":
            axes.set_ylim(1.5 * np.nanmin(rewards), -0.5 * means.max())


def _draw_updates(axes: Axes, status: Status) -> None:
    updates = status.updates
    number = np.arange(1, len(updates) + 1)
    axes.bar(number, [update.kl for update in updates], color=_NOW, width=0.6, label="update")
    axes.plot(
        number,
        [update.kl_from_first for update in updates],
        "o-",
        color=plots.COLOURS[1],
        markersize=4,
        label="from the first policy",
    )
    axes.set(xlabel="batch", ylabel="KL (nats)", title="moves of the policy")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    if updates:
        # Room for the legend, above the first updates.
        axes.set_ylim(0.0, 1.5 * max(max(update.kl, update.kl_from_first) for update in updates) + 1e-9)
        axes.legend(loc="upper left", fontsize=8)


def _draw_parameters(panels: Sequence[Axes], status: Status) -> None:
    context = status.contexts[:, 0]
    for index, (axes, variable) in enumerate(zip(panels, status.settings.parameters, strict=True)):
        for bound in (variable.low, variable.high):
            axes.axhline(bound, color=plots.PAPER_COLOUR, linewidth=0.8, linestyle=":")
        axes.plot(
            context, status.first_parameters[:, index], color=_BEFORE, linestyle="--", label="first policy"
        )
        axes.plot(context, status.parameters[:, index], color=_NOW, label="now")
        axes.set_title(variable.label, fontsize=9)
        axes.set_xlabel(status.settings.contexts[0].label)
    panels[0].legend(loc="best", fontsize=8)


def _rewards(trials: Sequence[Trial]) -> np.ndarray:
    return np.array([np.nan if trial.reward is None else trial.reward for trial in trials], float)
