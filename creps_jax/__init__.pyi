from . import numerics, policies, robots, search, simulation, tasks, walking
from .contexts import context_grid, gaussian_contexts, uniform_contexts
from .numerics.linalg import thomas_solve
from .policies.features import FeatureMap, linear_features, quadratic_features, rbf_features
from .policies.gaussian import LinearGaussian, fit_weighted_ml
from .policies.learned import Learned, load, save
from .policies.space import Space, sigmoid_gate
from .robots.nao_kinematics import leg_fk, leg_ik
from .search.archive import Archive, Batch
from .search.creps import Creps, CrepsInfo, CrepsState, creps
from .search.dual import DualSolution, sample_weights, solve_dual
from .search.fit import bounded_ml
from .search.importance import Importance
from .tasks.base import Outcome, Task, average_repeats, penalised, sigmoid_constrained
from .tasks.planar_arm import hole_reaching, via_point_reaching
from .tasks.sine import sinus
from .tasks.walking import nao_walk
from .training import IterationLog, evaluate, make_iteration, train, train_trials
from .walking.com import com_trajectory

__version__: str

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
    "Learned",
    "LinearGaussian",
    "Outcome",
    "Space",
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
    "load",
    "make_iteration",
    "nao_walk",
    "numerics",
    "penalised",
    "policies",
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
    "tasks",
    "thomas_solve",
    "train",
    "train_trials",
    "uniform_contexts",
    "via_point_reaching",
    "walking",
]
