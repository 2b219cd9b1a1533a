"""Show the iterations of a run."""

import math
import sys
import time
from collections.abc import Sequence
from typing import NamedTuple

from rich.console import Console, Group
from rich.control import Control
from rich.live import Live
from rich.segment import ControlType

from experiments.progress.by_context import PooledSamples, Recent
from experiments.progress.view import View, draw


class Row(NamedTuple):
    """The values of an iteration.

    Attributes:
        iteration: number of iterations done, including this one.
        episodes: rollouts so far, including repeats.
        mean_reward: mean over the samples of the iteration.
        fall_share: share of its rollouts with a fall; None if nothing can fall.
        kl: KL divergence of the sample weights.
        p_value: p-value of the test on evidence, see `CrepsInfo`; the median of the trials.
        unsupported_loss: entropy lost without evidence so far, in nats; the mean of the trials.
        simulated_seconds: simulated time of the iteration; None without simulation.
        samples: samples of the iteration; None if they are unknown.
    """

    iteration: int
    episodes: int
    mean_reward: float
    fall_share: float | None = None
    kl: float | None = None
    p_value: float | None = None
    unsupported_loss: float | None = None
    simulated_seconds: float | None = None
    samples: PooledSamples | None = None


class Progress:
    """Show the rows of a run; use it as a context manager.

    Args:
        title: name of the run.
        iterations: number of iterations of the run.
        earlier: mean rewards of the iterations before the run was resumed.
        timestep: physics time step in seconds, to report steps per second; None without physics.
        console: console of the output; stdout by default.
        every: seconds between two lines if there is no terminal.
    """

    def __init__(
        self,
        title: str,
        iterations: int,
        *,
        earlier: Sequence[float] = (),
        timestep: float | None = None,
        console: Console | None = None,
        every: float = 5.0,
    ):
        self._title = title
        self._iterations = iterations
        self._done = len(earlier)
        self._timestep = timestep
        self._console = console or Console(file=sys.stdout, highlight=False, soft_wrap=True)
        self._every = every
        self._rewards = list(earlier)
        self._recent = Recent()
        self._row: Row | None = None
        self._live: Live | None = None
        self._drawn: tuple[int, list[int]] = (0, [])
        self._started = self._first = self._last = self._printed = time.monotonic()
        self._iteration_seconds = math.nan

    def __enter__(self) -> "Progress":
        self._started = self._first = self._last = time.monotonic()
        self._printed = -math.inf
        if self._console.is_terminal:
            self._live = Live(
                get_renderable=self._render, console=self._console, refresh_per_second=4, transient=False
            )
            self._live.start()
        else:
            self._console.print(f"{self._title}: {self._iterations - self._done} iterations to go")
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def update(self, row: Row) -> None:
        """Add the row of an iteration."""
        now = time.monotonic()
        if self._row is None:
            self._first = now
        self._iteration_seconds = now - self._last
        self._last, self._row = now, row
        self._rewards.append(row.mean_reward)
        if row.samples is not None:
            self._recent.add(row.samples)
        if self._live is None and (now - self._printed >= self._every or row.iteration == self._iterations):
            self._printed = now
            self._console.print("  ".join(f"{name} {value}" for name, value in self._cells()))

    def seconds_left(self) -> float:
        """Estimate the time left; NaN before the end of the second iteration, as the first one compiles."""
        counted = len(self._rewards) - self._done - 1
        if self._row is None or counted < 1:
            return math.nan
        mean = (self._last - self._first) / counted
        return mean * (self._iterations - self._row.iteration)

    def _cells(self) -> list[tuple[str, str]]:
        row = self._row
        elapsed = ("elapsed", clock(time.monotonic() - self._started))
        if row is None:
            return [("iteration", f"{self._done}/{self._iterations}"), elapsed, ("", "compiling ...")]
        cells = [
            ("iteration", f"{row.iteration}/{self._iterations}"),
            ("episodes", f"{row.episodes:,}"),
            ("reward", f"{row.mean_reward:.3f}"),
        ]
        if row.fall_share is not None:
            cells.append(("falls", f"{100 * row.fall_share:.0f}%"))
        if row.kl is not None:
            cells.append(("KL", f"{row.kl:.3f}"))
        if row.p_value is not None:
            cells.append(("p", f"{row.p_value:.2g}"))
        if row.unsupported_loss is not None:
            cells.append(("entropy lost by chance", f"{row.unsupported_loss:.2f} nats"))
        if row.simulated_seconds is not None and self._iteration_seconds > 0:
            speed = row.simulated_seconds / self._iteration_seconds
            cells.append(("simulation", f"{speed:,.0f} x real time"))
            if self._timestep:
                cells.append(("steps/s", f"{speed / self._timestep:,.0f}"))
        return [*cells, elapsed, ("left", clock(self.seconds_left()))]

    def _render(self) -> Group:
        width, height = self._console.size
        self._wipe_wrapped(width)
        done = self._row.iteration if self._row else self._done
        view = View(self._title, self._iterations, done, self._cells(), tuple(self._rewards), self._recent)
        unicode = "utf" in (self._console.encoding or "").lower()
        # The terminal prints ^C after the last line: it must fit into this line.
        lines = draw(view, max(width - len("^C"), 1), height - 1, unicode=unicode)
        self._drawn = width, [len(line) for line in lines]
        return Group(*lines)

    def _wipe_wrapped(self, width: int) -> None:
        """Erase the lines that wrapped when the terminal became narrower; `Live` does not count them."""
        width_before, lengths = self._drawn
        if width < width_before:
            wrapped = sum((length - 1) // width for length in lengths if length)
            wipe = ((ControlType.ERASE_IN_LINE, 2), (ControlType.CURSOR_UP, 1))
            self._console.control(Control(*wipe * wrapped))


def clock(seconds: float) -> str:
    """Write a time as minutes:seconds, or hours:minutes:seconds; a dash if it is unknown."""
    if not math.isfinite(seconds):
        return "-"
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute}:{second:02d}"
