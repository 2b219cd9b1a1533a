import io
import math

import numpy as np
import pytest
from rich.console import Console

from experiments.progress import Progress, Row, clock, sparkline


def console(*, terminal: bool) -> Console:
    return Console(file=io.StringIO(), force_terminal=terminal, width=100, highlight=False)


def row(iteration: int, reward: float = -1.0) -> Row:
    return Row(iteration, 90 * iteration, reward, fall_share=0.25, kl=0.5, simulated_seconds=600.0)


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


def test_time_left_is_unknown_until_two_iterations_ended_and_zero_at_the_end():
    progress = Progress("title", 3, console=console(terminal=False))
    with progress:
        assert math.isnan(progress.seconds_left())
        progress.update(row(1))
        assert math.isnan(progress.seconds_left())
        progress.update(row(2))
        assert progress.seconds_left() >= 0
        progress.update(row(3))
        assert progress.seconds_left() == 0


@pytest.mark.parametrize(
    ("seconds", "text"), [(0, "0:00"), (59.6, "1:00"), (3600, "1:00:00"), (math.nan, "-")]
)
def test_clock(seconds, text):
    assert clock(seconds) == text


def test_sparkline_rises_with_the_reward_and_leaves_gaps():
    line = sparkline([-100.0, -10.0, math.nan, -1.0, -0.1], 10)
    assert line[0] == "▁"
    assert line[-1] == "█"
    assert line[2] == " "
    assert list(line.replace(" ", "")) == sorted(line.replace(" ", ""))


@pytest.mark.parametrize("rewards", [[], [math.nan], [0.0], [-1.0] * 5, [1e30, -1e30], list(range(1000))])
def test_sparkline_bears_anything(rewards):
    line = sparkline(rewards, 60, unicode=False)
    assert len(line) <= 60
    assert line.isascii()
    assert np.all([character in " _.-=+*#@" for character in line])
