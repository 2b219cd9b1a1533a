import io
import itertools
import math

import numpy as np
import pytest
from rich.console import Console
from rich.text import Text

from experiments.progress import PooledSamples, Progress, Row, live
from experiments.progress.by_context import Group, Recent
from experiments.progress.curve import draw_curve
from experiments.progress.live import clock
from experiments.progress.table import draw_table
from experiments.progress.view import View, draw

SPEEDS = np.linspace(0.08, 0.62, 91)
WALKED = PooledSamples(SPEEDS, -SPEEDS, speed=0.9 * SPEEDS, fall_share=(SPEEDS > 0.55).astype(float))
LOSSES = (-100.0 / np.arange(1, 60) ** 2).tolist()


def console(*, terminal: bool, width: int = 100, height: int = 30) -> Console:
    return Console(
        file=io.StringIO(),
        force_terminal=terminal,
        width=width,
        height=height,
        highlight=False,
        soft_wrap=True,
    )


def row(iteration: int, reward: float = -1.0) -> Row:
    return Row(
        iteration, 90 * iteration, reward, fall_share=0.25, kl=0.5, simulated_seconds=600.0, samples=WALKED
    )


def recent(samples: PooledSamples | None = WALKED) -> Recent:
    kept = Recent()
    if samples is not None:
        kept.add(samples)
    return kept


def drawn(
    width: int, height: int, *, samples: PooledSamples | None = WALKED, unicode: bool = True
) -> list[str]:
    cells = [
        ("iteration", "59/70"),
        ("episodes", "3,150"),
        ("simulation", "90 x real time"),
        ("left", "2:40"),
    ]
    view = View("learning walk", 70, 59, cells, LOSSES, recent(samples))
    return [line.plain for line in draw(view, width, height, unicode=unicode)]


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_shows_what_matters(terminal):
    out = console(terminal=terminal)
    with Progress("learning walk", 3, timestep=0.005, console=out, every=0.0) as progress:
        for iteration in (1, 2, 3):
            progress.update(row(iteration, -1.0 / iteration))
    text = out.file.getvalue()
    for part in (
        "learning walk",
        "3/3",
        "270",
        "-0.333",
        "25%",
        "0.500",
        "x real time",
        "steps/s",
        "elapsed",
        "left",
    ):
        assert part in text, part
    assert ("walked" in text) == ("mean reward of an iteration" in text) == terminal


def test_without_a_terminal_lines_are_few_and_the_last_one_is_there():
    out = console(terminal=False)
    with Progress("title", 1000, console=out, every=3600.0) as progress:
        for iteration in range(1, 1001):
            progress.update(Row(iteration, iteration, -1.0))
    lines = out.file.getvalue().splitlines()
    assert len(lines) == 3
    assert "1000/1000" in lines[-1]
    assert "falls" not in lines[-1]
    assert "simulation" not in lines[-1]


def test_time_left_is_unknown_until_two_iterations_ended_and_zero_at_the_end(monkeypatch):
    seconds = itertools.count()
    monkeypatch.setattr(live.time, "monotonic", lambda: float(next(seconds)))
    # Iterations of an earlier process took no time of this one.
    progress = Progress("title", 5, earlier=[-3.0, -2.0], console=console(terminal=False), every=math.inf)
    with progress:
        assert math.isnan(progress.seconds_left())
        progress.update(row(3))
        assert math.isnan(progress.seconds_left())
        progress.update(row(4))
        assert progress.seconds_left() == pytest.approx(1.0, abs=1.0)
        progress.update(row(5))
        assert progress.seconds_left() == 0


def test_a_resumed_run_shows_its_curve_at_once():
    out = console(terminal=True)
    with Progress("title", 4, earlier=[-2.0, -1.0], console=out):
        pass
    text = out.file.getvalue()
    assert "2/4" in text and "compiling" in text and "iteration" in text and "⠊" in text


def test_an_echoed_interrupt_fits_behind_every_line():
    out = console(terminal=True, width=80)
    with Progress("title", 4, earlier=[-2.0, -1.0], console=out):
        pass
    lines = Text.from_ansi(out.file.getvalue()).plain.splitlines()
    assert max(map(len, lines)) == 80 - len("^C")


def test_what_a_narrower_terminal_has_wrapped_is_wiped():
    out = console(terminal=True, width=80)
    with Progress("title", 4, console=out):
        out.width = 30
    wipe = "\x1b[2K\x1b[1A"
    # The bar of 78 characters has become three lines: two more than were drawn.
    assert wipe * 2 in out.file.getvalue()


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0:00"), (59.6, "1:00"), (3600, "1:00:00"), (math.nan, "-")]
)
def test_clock(seconds, text):
    assert clock(seconds) == text


@pytest.mark.parametrize("unicode", [True, False])
@pytest.mark.parametrize("height", [1, 4, 7, 14, 23, 60])
@pytest.mark.parametrize("width", [10, 24, 40, 66, 80, 120, 300])
def test_the_view_fits_any_terminal(width, height, unicode):
    for samples in (WALKED, PooledSamples(SPEEDS, -SPEEDS), None):
        lines = drawn(width, height, samples=samples, unicode=unicode)
        assert 1 <= len(lines) <= height
        assert max(map(len, lines)) <= width
        assert lines[0] == "learning walk"[:width] or lines[0].endswith("…")
        assert unicode or all(line.isascii() for line in lines[1:])


def test_the_table_stands_beside_the_curve_or_below_or_not_at_all():
    beside, below, short = drawn(80, 23), drawn(40, 23), drawn(40, 12)
    assert any("mean reward" in line and "speeds in m/s" in line for line in beside)
    titles = [index for index, line in enumerate(below) if "mean reward" in line or "speeds in m/s" in line]
    assert len(titles) == 2 and titles[1] - titles[0] > 5
    assert any("mean reward" in line for line in short)
    assert not any("m/s" in line for line in short)


def test_a_low_but_wide_terminal_has_both():
    lines = drawn(80, 14)
    assert any("mean reward" in line for line in lines)
    assert any(line.split()[-3:-1] == ["0.6", "0.53"] or "0.6    0.53" in line for line in lines)


def curve_of(rewards, width=40, height=9):
    """Return labels by row, and for each column of characters the rows where something is drawn."""
    lines = draw_curve(rewards, width, height, unicode=False)
    assert [len(line) for line in lines] == [width] * height
    labels = {index: float(line.split("+")[0]) for index, line in enumerate(lines[:-1]) if "+" in line}
    margin = lines[-1].index("+") + 1
    plot = np.array([[c == "*" for c in line[margin:]] for line in lines[:-1]])
    return labels, plot, lines[-1]


def test_a_curve_rises_from_the_first_to_the_last_iteration():
    labels, plot, axis = curve_of([-9.0, -5.0, -1.0])
    assert plot[-1, 0] and plot[0, -1]
    assert plot.any(axis=0).all()
    tops = plot.argmax(axis=0)
    assert np.all(np.diff(tops) <= 0)
    assert axis.split()[0].endswith("1") and axis.split()[-1] == "3"
    # Labels stand at their values: row 0 is -1, row 7 is -9.
    for line, value in labels.items():
        assert line == pytest.approx(7 * (-1 - value) / 8, abs=0.5)
    assert len(labels) >= 2


def test_losses_over_decades_are_drawn_by_their_logarithm():
    labels, plot, _ = curve_of([-(10.0 ** -(step / 10)) for step in range(41)])
    assert list(labels.values()) == [-1e-4, -1e-2, -1.0]
    # A straight line from corner to corner.
    assert plot.argmax(axis=0) == pytest.approx(np.linspace(7, 0, plot.shape[1]), abs=1.0)


def test_a_curve_has_gaps_where_nothing_is_known():
    _, plot, _ = curve_of([-3.0, -2.0, math.nan, math.nan, math.nan, -1.0, 0.0])
    drawn_columns = plot.any(axis=0)
    assert drawn_columns[0] and drawn_columns[-1] and not drawn_columns[len(drawn_columns) // 2]


def test_braille_has_a_dot_where_the_curve_is():
    lines = draw_curve([0.0, 1.0], 30, 6)
    assert lines[0].endswith(("⠈", "⠊", "⠉"))
    first = next(character for character in lines[-2] if "⠀" < character <= "⣿")
    assert ord(first) - 0x2800 & 0x40, "the lowest dot on the left"


@pytest.mark.parametrize("unicode", [True, False])
@pytest.mark.parametrize(
    "rewards",
    [[], [math.nan], [0.0], [-1.0] * 5, [1e30, -1e30], list(range(1000)), [-1e-12, 0.0], [5e-324, -5e-324]],
)
def test_a_curve_bears_anything(rewards, unicode):
    for height in (0, 1, 2, 3, 12):
        for width in (0, 5, 20, 60):
            lines = draw_curve(rewards, width, height, unicode=unicode)
            assert len(lines) in (0, height)
            assert all(len(line) == width for line in lines)


def test_groups_are_means_at_round_contexts():
    groups = recent().groups(9)
    assert [group.context for group in groups] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    for group in groups:
        near = np.abs(SPEEDS - group.context) < 0.05
        assert group.speed == pytest.approx(0.9 * SPEEDS[near].mean(), abs=0.006)
        assert group.reward == pytest.approx(-SPEEDS[near].mean(), abs=0.006)
    assert [group.fall_share for group in groups[:-1]] == [0.0] * 5
    assert groups[-1].fall_share == pytest.approx(1.0, abs=0.1)


def test_only_the_last_iterations_count_and_failed_samples_do_not():
    old = PooledSamples(np.array([0.0, 1.0]), np.array([-1e9, -1e9]), np.array([9.0, 9.0]))
    new = PooledSamples(
        np.array([0.0, 0.0, 1.0]), np.array([-1.0, -3.0, -5.0]), np.array([2.0, np.nan, np.nan])
    )
    kept = recent(old)
    for _ in range(10):
        kept.add(new)
    assert len(kept) == 10
    groups = kept.groups(2)
    assert [(group.context, group.reward) for group in groups] == [(0.0, -2.0), (1.0, -5.0)]
    assert groups[0].speed == 2.0 and math.isnan(groups[1].speed)


@pytest.mark.parametrize(
    "low_high", [(0, 15.7), (-5, 20), (0, 0), (3, 3), (-1e-9, 1e6), (-180, 180), (1e7, 1e7 + 1)]
)
@pytest.mark.parametrize("most", [1, 3, 5, 9, 50])
def test_groups_are_few_and_hold_every_sample(low_high, most):
    context = np.linspace(*low_high, 40)
    groups = recent(PooledSamples(context, np.ones(40))).groups(most)
    assert 1 <= len(groups) <= min(most, 9)
    assert not math.isnan(groups[0].reward) and not math.isnan(groups[-1].reward)
    half = (groups[-1].context - groups[0].context) / max(len(groups) - 1, 1) / 2
    if len(groups) > 1:
        assert groups[0].context - half <= low_high[0] and low_high[1] <= groups[-1].context + half


def test_table_of_a_walk():
    groups = [
        Group(0.2, -1.0, 0.2, 0.0),
        Group(0.4, -1.0, 0.1, 1.0),
        Group(0.6, math.nan, math.nan, math.nan),
    ]
    assert [line.plain.rstrip() for line in draw_table(groups, 20)] == [
        "asked  walked  falls",
        "  0.2    0.20     0%",
        "  0.4    0.10   100%",
        "  0.6       -      -",
    ]
    lines = [line.plain for line in draw_table(groups, 36, unicode=False)]
    # The bar ends at the speed that was reached, the mark stands at the one that was asked for.
    assert lines[1].split()[:3] == ["0.2", "0.20", "##"]
    assert lines[2].split()[1:4] == ["0.10", "#", "|"]
    assert lines[2].index("|") - lines[2].index("#") == 4
    assert lines[2].split()[-1] == "#######"
    assert len({len(line) for line in lines}) == 1
    assert draw_table(groups, 19) == []


def test_table_of_any_other_task():
    lines = [line.plain for line in draw_table([Group(0.0, -4.0), Group(2.5, -1.0)], 40, unicode=False)]
    assert lines[0].split() == ["context", "reward"]
    assert lines[1].split() == ["0", "-4.00", 14 * "#"]
    assert lines[2].split()[:2] == ["2.5", "-1.00"] and lines[2].count("#") in (3, 4)
    assert draw_table([], 40) == []
