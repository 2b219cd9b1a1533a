"""Tasks to learn, and wrappers from task to task.

`nao_walk` needs MuJoCo, which is imported when `nao_walk` is first accessed.
"""

import importlib
from typing import TYPE_CHECKING, Any

from creps_jax.tasks.base import (
    Outcome,
    PlainOutcome,
    Task,
    average_repeats,
    penalised,
    sigmoid_constrained,
)
from creps_jax.tasks.functions import contextual_function
from creps_jax.tasks.planar_arm import hole_reaching, via_point_reaching
from creps_jax.tasks.sine import sinus

if TYPE_CHECKING:
    from creps_jax.tasks.walking import nao_walk

__all__ = [
    "Outcome",
    "PlainOutcome",
    "Task",
    "average_repeats",
    "contextual_function",
    "hole_reaching",
    "nao_walk",
    "penalised",
    "sigmoid_constrained",
    "sinus",
    "via_point_reaching",
]


def __getattr__(name: str) -> Any:
    if name != "nao_walk":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module("creps_jax.tasks.walking").nao_walk
