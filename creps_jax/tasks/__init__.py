"""Tasks to learn, and wrappers from task to task.

The walks need MuJoCo, which is imported when one of them is first accessed.
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
    from creps_jax.tasks.steering import nao_steered_walk
    from creps_jax.tasks.walking import nao_walk

__all__ = [
    "Outcome",
    "PlainOutcome",
    "Task",
    "average_repeats",
    "contextual_function",
    "hole_reaching",
    "nao_steered_walk",
    "nao_walk",
    "penalised",
    "sigmoid_constrained",
    "sinus",
    "via_point_reaching",
]


_WALKS = {"nao_steered_walk": "steering", "nao_walk": "walking"}


def __getattr__(name: str) -> Any:
    if name not in _WALKS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"creps_jax.tasks.{_WALKS[name]}"), name)
