from . import numerics, policies, robots, search, simulation, tasks, walking
from .contexts import context_grid, ellipsoid_contexts, gaussian_contexts, uniform_contexts
from .numerics.linalg import thomas_solve
from .policies.base import Policy, WeightedSamples
from .policies.features import (
    FeatureMap,
    linear_features,
    polynomial_features,
    quadratic_features,
    rbf_features,
)
from .policies.gaussian import LinearGaussian, fit_weighted_ml, linear_gaussian, start_policy
from .policies.learned import Learned, load, save
from .policies.space import Space, sigmoid_gate
from .robots.mjcf import humanoid_from_mjcf
from .robots.nao_kinematics import leg_fk, leg_ik
from .robots.spec import humanoid_from_toml
from .search.archive import Archive, Batch
from .search.base import Search
from .search.creps import Creps, CrepsInfo, CrepsState, creps
from .search.dual import DualSolution, sample_weights, solve_dual
from .search.fit import bounded_ml, weighted_ml
from .search.importance import Importance
from .search.surrogate import surrogate
from .tasks.base import Outcome, PlainOutcome, Task, average_repeats, penalised, sigmoid_constrained
from .tasks.planar_arm import hole_reaching, via_point_reaching
from .tasks.sine import sinus
from .tasks.steering import nao_steered_walk
from .tasks.walking import nao_walk
from .training import IterationLog, evaluate, learned, make_iteration, train, train_trials
from .walking.com import com_trajectory
from .walking.controller import Walker
from .walking.gaits import learned_walker
from .walking.params import NAO_BOUNDS

__version__: str

__all__ = [
    "NAO_BOUNDS",
    "Archive",
    "Batch",
    "Creps",
    "CrepsInfo",
    "CrepsState",
    "DualSolution",
    "FeatureMap",
    "Importance",
    "IterationLog",
    "Learned",
    "LinearGaussian",
    "Outcome",
    "PlainOutcome",
    "Policy",
    "Search",
    "Space",
    "Task",
    "Walker",
    "WeightedSamples",
    "average_repeats",
    "bounded_ml",
    "com_trajectory",
    "context_grid",
    "creps",
    "ellipsoid_contexts",
    "evaluate",
    "fit_weighted_ml",
    "gaussian_contexts",
    "hole_reaching",
    "humanoid_from_mjcf",
    "humanoid_from_toml",
    "learned",
    "learned_walker",
    "leg_fk",
    "leg_ik",
    "linear_features",
    "linear_gaussian",
    "load",
    "make_iteration",
    "nao_steered_walk",
    "nao_walk",
    "numerics",
    "penalised",
    "policies",
    "polynomial_features",
    "quadratic_features",
    "rbf_features",
    "robots",
    "sample_weights",
    "save",
    "search",
    "sigmoid_constrained",
    "sigmoid_gate",
    "simulation",
    "sinus",
    "solve_dual",
    "start_policy",
    "surrogate",
    "tasks",
    "thomas_solve",
    "train",
    "train_trials",
    "uniform_contexts",
    "via_point_reaching",
    "walking",
    "weighted_ml",
]
