"""Show how a run is getting on: a live view in a terminal, a line every few seconds elsewhere."""

from experiments.progress.by_context import PooledSamples
from experiments.progress.live import Progress, Row

__all__ = ["PooledSamples", "Progress", "Row"]
