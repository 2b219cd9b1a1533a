"""Show how a run is getting on: a live view in a terminal, a line every few seconds elsewhere."""

import math
import sys
import time
from collections.abc import Sequence
from typing import NamedTuple

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

_BLOCKS = "▁▂▃▄▅▆▇█"
_ASCII_BLOCKS = "_.-=+*#@"


class Row(NamedTuple):
    """What one iteration tells the reader.

    Attributes:
        iteration: how many iterations are done, this one included.
        episodes: rollouts so far, repeats included.
        mean_reward: mean over the iteration's samples.
        fall_share: share of the iteration's rollouts that fell; None where nothing can fall.
        kl: KL divergence of the sample weights.
        simulated_seconds: simulated time of the iteration; None where nothing is simulated.
    """

    iteration: int
    episodes: int
    mean_reward: float
    fall_share: float | None = None
    kl: float | None = None
    simulated_seconds: float | None = None


class Progress:
    """Show the rows of a run; use it as a context manager.

    Args:
        title: what is running.
        iterations: how many iterations the run has.
        done: how many of them were done before, by a run that is resumed.
        timestep: physics time step in seconds, to count steps a second; None where there is none.
        console: where to; by default stdout.
        every: seconds between two lines where there is no terminal.
    """

    def __init__(
        self,
        title: str,
        iterations: int,
        *,
        done: int = 0,
        timestep: float | None = None,
        console: Console | None = None,
        every: float = 5.0,
    ):
        self._title = title
        self._iterations = iterations
        self._done = done
        self._timestep = timestep
        self._console = console or Console(file=sys.stdout, highlight=False, soft_wrap=True)
        self._every = every
        self._rewards: list[float] = []
        self._row: Row | None = None
        self._live: Live | None = None
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
        """Take in the row of an iteration that has just ended."""
        now = time.monotonic()
        if self._row is None:
            self._first = now
        self._iteration_seconds = now - self._last
        self._last, self._row = now, row
        self._rewards.append(row.mean_reward)
        if self._live is None and (now - self._printed >= self._every or row.iteration == self._iterations):
            self._printed = now
            self._console.print("  ".join(f"{name} {value}" for name, value in self._cells()))

    def seconds_left(self) -> float:
        """Estimate the time left; NaN until two iterations have ended, as the first one compiles."""
        if self._row is None or len(self._rewards) < 2:
            return math.nan
        mean = (self._last - self._first) / (len(self._rewards) - 1)
        return mean * (self._iterations - self._row.iteration)

    def _cells(self) -> list[tuple[str, str]]:
        row = self._row
        elapsed = ("elapsed", clock(time.monotonic() - self._started))
        if row is None:
            return [("iteration", f"{self._done}/{self._iterations}"), elapsed]
        cells = [
            ("iteration", f"{row.iteration}/{self._iterations}"),
            ("episodes", f"{row.episodes:,}"),
            ("reward", f"{row.mean_reward:.3f}"),
        ]
        if row.fall_share is not None:
            cells.append(("falls", f"{100 * row.fall_share:.0f}%"))
        if row.kl is not None:
            cells.append(("KL", f"{row.kl:.3f}"))
        if row.simulated_seconds is not None and self._iteration_seconds > 0:
            speed = row.simulated_seconds / self._iteration_seconds
            steps = f" ({speed / self._timestep:,.0f} steps/s)" if self._timestep else ""
            cells.append(("simulation", f"{speed:,.0f} x real time{steps}"))
        return [*cells, elapsed, ("left", clock(self.seconds_left()))]

    def _render(self) -> Group:
        grid = Table.grid(padding=(0, 2))
        for name, value in self._cells():
            grid.add_row(Text(name, style="dim"), Text(value))
        done = self._row.iteration if self._row else self._done
        bar = Table.grid()  # a bare bar would not end its line
        bar.add_row(ProgressBar(total=self._iterations, completed=done, width=60))
        parts: list[Text | Table] = [Text(self._title, style="bold"), bar, grid]
        if self._row is None:
            parts.append(Text("compiling ...", style="dim"))
        else:
            unicode = "utf" in (self._console.encoding or "").lower()
            parts.append(Text(sparkline(self._rewards, 60, unicode=unicode), style="green"))
        return Group(*parts)


def clock(seconds: float) -> str:
    """Write a time as minutes:seconds, or hours:minutes:seconds; a dash where it is unknown."""
    if not math.isfinite(seconds):
        return "-"
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute}:{second:02d}"


def sparkline(rewards: Sequence[float], width: int, *, unicode: bool = True) -> str:
    """Draw a learning curve in one line of text: the higher the better, on a logarithmic scale.

    Args:
        rewards: rewards in order; what is not finite leaves a gap.
        width: most characters to use; neighbours are averaged.
        unicode: whether the reader can show block characters.
    """
    blocks = _BLOCKS if unicode else _ASCII_BLOCKS
    finite = [reward for reward in rewards if math.isfinite(reward)]
    if not finite:
        return ""
    best = max(finite)
    smallest = max(1e-3 * (best - min(finite)), 1e-12)
    means = []
    for index in range(min(width, len(rewards))):
        count = min(width, len(rewards))
        chunk = rewards[index * len(rewards) // count : (index + 1) * len(rewards) // count]
        kept = [reward for reward in chunk if math.isfinite(reward)]
        means.append(-math.log(best - sum(kept) / len(kept) + smallest) if kept else math.nan)
    low, high = (pick(mean for mean in means if math.isfinite(mean)) for pick in (min, max))
    scale = (len(blocks) - 1) / (high - low) if high > low else 0.0
    return "".join(blocks[round((mean - low) * scale)] if math.isfinite(mean) else " " for mean in means)
