"""Contextual relative entropy policy search in JAX, and a humanoid that learns to walk with it."""

from typing import TYPE_CHECKING, Any

from creps_jax import tasks
from creps_jax.contexts import context_grid, gaussian_contexts, uniform_contexts
from creps_jax.numerics.linalg import thomas_solve
from creps_jax.policies.features import (
    FeatureMap,
    linear_features,
    quadratic_features,
    rbf_features,
)
from creps_jax.policies.gaussian import LinearGaussian, fit_weighted_ml
from creps_jax.policies.space import sigmoid_gate
from creps_jax.robots.nao_kinematics import leg_fk, leg_ik
from creps_jax.search.archive import Archive, Batch
from creps_jax.search.creps import Creps, CrepsInfo, CrepsState, creps
from creps_jax.search.dual import DualSolution, sample_weights, solve_dual
from creps_jax.search.fit import bounded_ml
from creps_jax.search.importance import Importance
from creps_jax.tasks import (
    Outcome,
    Task,
    average_repeats,
    hole_reaching,
    penalised,
    sigmoid_constrained,
    sinus,
    via_point_reaching,
)
from creps_jax.training import IterationLog, evaluate, make_iteration, train, train_trials
from creps_jax.walking.com import com_trajectory

if TYPE_CHECKING:
    from creps_jax.tasks import nao_walk

__all__ = [
    "Archive",
    "Batch",
    "Creps",
    "CrepsInfo",
    "CrepsState",
    "DualSolution",
    "FeatureMap",
    "Importance",
    "IterationLog",
    "LinearGaussian",
    "Outcome",
    "Task",
    "average_repeats",
    "bounded_ml",
    "com_trajectory",
    "context_grid",
    "creps",
    "evaluate",
    "fit_weighted_ml",
    "gaussian_contexts",
    "hole_reaching",
    "leg_fk",
    "leg_ik",
    "linear_features",
    "make_iteration",
    "nao_walk",
    "penalised",
    "quadratic_features",
    "rbf_features",
    "sample_weights",
    "sigmoid_constrained",
    "sigmoid_gate",
    "sinus",
    "solve_dual",
    "tasks",
    "thomas_solve",
    "train",
    "train_trials",
    "uniform_contexts",
    "via_point_reaching",
]


def __getattr__(name: str) -> Any:
    # The walking task imports MuJoCo, which nothing else needs.
    if name == "nao_walk":
        return tasks.nao_walk
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
