"""Settings of a session: the contexts, the parameters and how to learn; written as plain JSON."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from creps_jax import files
from creps_jax.errors import UserError
from creps_jax.policies.bounds import SESSION_CONSTRAINTS, SIGMOID, check_constraint, range_error, range_text
from creps_jax.policies.feature_settings import Features, as_in_earlier_versions
from creps_jax.tools.session import plain

MAX_BATCH = 10_000
"""Largest number of trials that are drawn and written at once."""
MAX_ARCHIVE = 1_000_000
"""Largest number of trials that an update holds in memory."""
MAX_CONTEXTS = 10
"""Policies are compared on a grid of contexts, which then has 2^10 points."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Context:
    """A variable that the robot is given, such as a distance, and its range."""

    name: str
    unit: str = ""
    low: float
    high: float

    def __post_init__(self) -> None:
        _check_range(self)

    @property
    def label(self) -> str:
        """The name with its unit."""
        return f"{self.name} ({self.unit})" if self.unit else self.name


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parameter(Context):
    """A number that the robot is run with, and its bounds.

    Attributes:
        start: mean of the first policy, in the parameter's unit; by default the middle of the bounds.
        spread: its standard deviation; by default an eighth of the way between the bounds.
    """

    start: float | None = None
    spread: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.start is not None and not self.low <= self.start <= self.high:
            raise UserError(
                f"start of {self.name} must be within its bounds, "
                f"{range_text(self.low, self.high, self.unit)}, got {self.start:g}"
            )
        if self.spread is not None and not self.spread > 0:
            raise UserError(f"spread of {self.name} must be above zero, got {self.spread:g}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class FirstPolicy:
    """The policy to begin with: the arrays of a `LinearGaussian`, by rows."""

    coef: tuple[tuple[float, ...], ...]
    cov_chol: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        for name, rows in (("coef", self.coef), ("cov_chol", self.cov_chol)):
            if len(set(map(len, rows))) != 1:
                raise UserError(f"{name} must have rows of one length, got {list(map(len, rows))}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """All settings on which learning depends.

    Attributes:
        contexts: the inputs of the policy.
        parameters: the outputs of the policy.
        features: of the context; the policy's mean is linear in them.
        constraint: how parameters are kept within their bounds: "sigmoid" squashes free numbers into them,
            "clip" clips the numbers that are drawn, and learns from the clipped ones.
        kl_bound: epsilon, bound on the relative entropy of the weights of samples, nats.
        mean_kl_bound: bound on the change of the policy's mean in an update, nats, see `bounded_ml`; None for
            this and `cov_kl_bound` is the paper's fit without bounds.
        cov_kl_bound: the same for the covariance, nats.
        batch_size: number of trials for an update.
        archive_size: number of last trials to learn from; by default five batches, and at least twice the
            number of features and parameters; with more than 10 features, also three for each
            coefficient, features times parameters.
        seed: of the contexts and of the exploration.
        first_policy: the first policy, in place of start and spread of the parameters.
        task: the task of a saved policy; learning does not depend on it.
    """

    contexts: tuple[Context, ...]
    parameters: tuple[Parameter, ...]
    features: Features = Features()
    constraint: str = SIGMOID
    kl_bound: float = 0.5
    mean_kl_bound: float | None = 0.5
    cov_kl_bound: float | None = 0.05
    batch_size: int = 10
    archive_size: int | None = None
    seed: int = 0
    first_policy: FirstPolicy | None = None
    # Settings that differ only in the task are not equal, but may have one hash.
    task: dict[str, Any] = dataclasses.field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        _check_variables(self.contexts, self.parameters)
        _check_numbers(self)
        for parameter in self.parameters:
            start = parameter.start
            if start is not None and self.constraint == SIGMOID and start in (parameter.low, parameter.high):
                raise UserError(
                    f"start of {parameter.name} must be inside its bounds, which a sigmoid never reaches, "
                    f"got {start:g}"
                )
            if self.first_policy is not None and (start, parameter.spread) != (None, None):
                raise UserError(f"start and spread of {parameter.name} do not go with first_policy")

    @property
    def context_names(self) -> tuple[str, ...]:
        """The names of the context variables."""
        return tuple(context.name for context in self.contexts)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The names of the parameters."""
        return tuple(parameter.name for parameter in self.parameters)

    def checked_context(self, context: Sequence[float]) -> list[float]:
        """Return a context.

        Raises:
            UserError: if there is not a number for each variable, or one is out of its range.
        """
        if len(context) != len(self.contexts):
            names = ", ".join(self.context_names)
            raise UserError(f"context must be a number for each of {names}, got {tuple(context)}")
        for value, each in zip(context, self.contexts, strict=True):
            if not each.low <= value <= each.high:
                raise range_error(each.name, value, each.low, each.high, each.unit)
        return [float(value) for value in context]

    def digest(self) -> str:
        """Return a short text that differs from the text of other settings."""
        values = dataclasses.asdict(self)
        values["features"] = as_in_earlier_versions(values["features"])
        text = json.dumps(values, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def load_settings(path: Path) -> Settings:
    """Read settings, or a definition without the settings that have defaults.

    Raises:
        UserError: for the first mistake in the file.
    """
    return plain.read(Settings, files.load_json(path), path)


def ends(variables: Sequence[Context]) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the lower and the upper ends of variables."""
    return tuple(each.low for each in variables), tuple(each.high for each in variables)


def _check_range(variable: Context) -> None:
    if not variable.name.strip():
        raise UserError(f"name must not be empty, got {variable.name!r}")
    if not variable.low < variable.high:
        raise UserError(
            f"low of {variable.name} must be below high, got {variable.low:g} and {variable.high:g}"
        )


def _check_variables(contexts: Sequence[Context], parameters: Sequence[Parameter]) -> None:
    for name, variables in (("contexts", contexts), ("parameters", parameters)):
        if not variables:
            raise UserError(f"{name} must name at least one, got none")
    if len(contexts) > MAX_CONTEXTS:
        raise UserError(f"contexts must be at most {MAX_CONTEXTS}, got {len(contexts)}")
    names = [variable.name for variable in (*contexts, *parameters)]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"names of variables must be different, got {name!r} twice")


def _check_numbers(settings: Settings) -> None:
    check_constraint(settings.constraint, SESSION_CONSTRAINTS)
    if (settings.mean_kl_bound is None) != (settings.cov_kl_bound is None):
        raise UserError(
            "mean_kl_bound and cov_kl_bound must both be numbers or both be null, "
            f"got {settings.mean_kl_bound} and {settings.cov_kl_bound}"
        )
    for name in ("kl_bound", "mean_kl_bound", "cov_kl_bound"):
        bound = getattr(settings, name)
        if bound is not None and not bound > 0:
            raise UserError(f"{name} must be above zero, got {bound:g}")
    if not 1 <= settings.batch_size <= MAX_BATCH:
        raise UserError(f"batch_size must be from 1 to {MAX_BATCH}, got {settings.batch_size}")
    if settings.archive_size is not None and settings.archive_size < settings.batch_size:
        raise UserError(
            f"archive_size must be at least batch_size, {settings.batch_size}, got {settings.archive_size}"
        )
    if settings.archive_size is not None and settings.archive_size > MAX_ARCHIVE:
        raise UserError(f"archive_size must be at most {MAX_ARCHIVE}, got {settings.archive_size}")
    if not 0 <= settings.seed < 2**32:
        raise UserError(f"seed must be from 0 to {2**32 - 1}, got {settings.seed}")
