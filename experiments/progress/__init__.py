"""Show the progress of a run: a live view in a terminal, else a line every few seconds."""

from experiments.progress.by_context import PooledSamples
from experiments.progress.live import Progress, Row

__all__ = ["PooledSamples", "Progress", "Row"]
