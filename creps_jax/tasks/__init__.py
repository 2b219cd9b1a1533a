"""Tasks to learn, and wrappers from task to task.

`nao_walk` needs MuJoCo, which is imported when the walking task is first asked for, not before.
"""

import importlib
import sys
import types
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
from creps_jax.tasks.sinus import sinus

if TYPE_CHECKING:
    from creps_jax.tasks.nao_walk import nao_walk

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

_LAZY = ("nao_walk",)


class _TasksModule(types.ModuleType):
    """This package, where a lazy task's name stands for the task and not for the module it is in."""

    def __setattr__(self, name: str, value: Any) -> None:
        # Importing a submodule binds its name in the package: it would hide the function of that name.
        if name in _LAZY and isinstance(value, types.ModuleType):
            value = getattr(value, name)
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _TasksModule


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{name}"), name)
