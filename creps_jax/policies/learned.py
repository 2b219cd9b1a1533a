"""Keep a learned policy in a file that says all that is needed to use it."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from creps_jax.checks import shown
from creps_jax.errors import UserError
from creps_jax.files import load_arrays, save_arrays
from creps_jax.policies.features import FeatureMap, linear_features, rbf_features
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.policies.space import sigmoid_gate
from creps_jax.typing import VectorLike

FORMAT = "creps_jax policy"
VERSION = 2
FEATURE_KINDS = ("linear", "rbf")
CONSTRAINTS = ("none", "sigmoid", "penalty")


@dataclasses.dataclass(frozen=True)
class Features:
    """Settings of the features of a policy.

    Attributes:
        kind: one of FEATURE_KINDS.
        num_centers: K along each context variable, for RBFs.
        bandwidth: width of the RBFs in context units; None is the default width.
    """

    kind: str = "rbf"
    num_centers: int = 5
    bandwidth: float | None = None

    def make(self, low: VectorLike, high: VectorLike) -> FeatureMap:
        """Return the features over a range of contexts: a number, or one for each context variable.

        Raises:
            UserError: if the kind is unknown.
        """
        if self.kind == "linear":
            return linear_features(np.size(low))
        if self.kind == "rbf":
            return rbf_features(low, high, self.num_centers, bandwidth=self.bandwidth)
        raise UserError(f"features must be one of {', '.join(FEATURE_KINDS)}, got {self.kind!r}")


@dataclasses.dataclass(frozen=True)
class SavedPolicy:
    """A learned policy with all that is needed to use it.

    Attributes:
        coef: (p, d) mean is features @ coef.
        cov_chol: (d, d) Cholesky factor of the covariance.
        features: the features of the context.
        context_names: what the s context variables are, with `context_units`, `context_low`, `context_high`.
        param_names: what the d parameters are, with `param_units`, `param_low` and `param_high`.
        constraint: how the bounds are held: one of CONSTRAINTS.
        task: the name of the task, and the settings that it was learned with.
    """

    coef: np.ndarray
    cov_chol: np.ndarray
    features: Features
    context_names: tuple[str, ...]
    context_units: tuple[str, ...]
    context_low: tuple[float, ...]
    context_high: tuple[float, ...]
    param_names: tuple[str, ...]
    param_units: tuple[str, ...]
    param_low: tuple[float, ...]
    param_high: tuple[float, ...]
    constraint: str
    task: Mapping[str, Any]

    @property
    def policy(self) -> LinearGaussian:
        """The policy as the library knows it."""
        return LinearGaussian(jnp.asarray(self.coef), jnp.asarray(self.cov_chol))

    def feature_map(self) -> FeatureMap:
        """Return the features of the context."""
        return self.features.make(self.context_low, self.context_high)

    def mean(self, *context: float) -> np.ndarray:
        """Return the policy's mean (d,) as it was learned, before any bounds are applied.

        Args:
            context: a number for each context variable.

        Raises:
            UserError: if there are more or fewer, or one is outside the range that was learned.
        """
        try:
            numbers = tuple(float(value) for value in context)
        except (TypeError, ValueError):
            numbers = ()
        if len(numbers) != len(self.context_names):
            raise UserError(f"expected a number for each of {', '.join(self.context_names)}, got {context}")
        for value, name, unit, low, high in zip(
            numbers, self.context_names, self.context_units, self.context_low, self.context_high, strict=True
        ):
            # Ends that went through single precision belong to the range.
            slack = 1e-6 * (high - low)
            if not low - slack <= value <= high + slack:
                raise UserError(
                    f"{name} must be within the learned range, {low:g} to {high:g} {unit}, got {value}"
                )
        features = self.feature_map().apply(jnp.array(numbers, jnp.float32))
        return np.asarray(features) @ np.asarray(self.coef)

    def theta(self, *context: float) -> np.ndarray:
        """Return the physical parameters (d,), within their bounds, for a context.

        Args:
            context: a number for each context variable.

        Raises:
            UserError: if there are more or fewer, or one is outside the range that was learned.
        """
        mean = self.mean(*context)
        low, high = (np.asarray(bound, np.float32) for bound in (self.param_low, self.param_high))
        if self.constraint == "sigmoid":
            return np.asarray(sigmoid_gate(jnp.asarray(mean), jnp.asarray(low), jnp.asarray(high)))
        return mean if self.constraint == "none" else np.clip(mean, low, high)


def save_policy(path: Path | str, saved: SavedPolicy) -> None:
    """Write a policy file, atomically.

    Raises:
        UserError: if the policy would not be accepted by `load_policy`, the path is no .npz file, or it
            cannot be written.
    """
    path = _checked_path(path)
    if path.suffix != ".npz":
        raise UserError(f"a policy file must be named .npz, got {path}")
    if not isinstance(saved, SavedPolicy):
        raise UserError(f"saved must be a SavedPolicy, got {shown(saved)}")
    _check(path, saved)
    arrays = {
        "format": FORMAT,
        "version": VERSION,
        "coef": np.asarray(saved.coef, np.float32),
        "cov_chol": np.asarray(saved.cov_chol, np.float32),
        "features": json.dumps(dataclasses.asdict(saved.features)),
        "context_names": np.array(saved.context_names),
        "context_units": np.array(saved.context_units),
        "context_range": np.array([saved.context_low, saved.context_high]),
        "param_names": np.array(saved.param_names),
        "param_units": np.array(saved.param_units),
        "param_bounds": np.array([saved.param_low, saved.param_high]),
        "constraint": saved.constraint,
        "task": json.dumps(saved.task),
    }
    save_arrays(path, arrays)


def load_policy(path: Path | str) -> SavedPolicy:
    """Read a policy file.

    Raises:
        UserError: if the file is missing, cut short, foreign, of another version, or holds what
            no policy can hold (NaN, shapes that do not fit each other).
    """
    path = _checked_path(path)
    arrays = load_arrays(path)
    if str(arrays.get("format")) != FORMAT:
        raise UserError(f"{path} is no policy file (its format is not {FORMAT!r})")
    if str(arrays.get("version")) != str(VERSION):
        raise UserError(f"{path} is a policy file of version {arrays.get('version')}, expected {VERSION}")
    try:
        context_low, context_high = arrays["context_range"].tolist()
        param_low, param_high = arrays["param_bounds"].tolist()
        saved = SavedPolicy(
            coef=arrays["coef"],
            cov_chol=arrays["cov_chol"],
            features=Features(**json.loads(str(arrays["features"]))),
            context_names=tuple(arrays["context_names"].tolist()),
            context_units=tuple(arrays["context_units"].tolist()),
            context_low=tuple(context_low),
            context_high=tuple(context_high),
            param_names=tuple(arrays["param_names"].tolist()),
            param_units=tuple(arrays["param_units"].tolist()),
            param_low=tuple(param_low),
            param_high=tuple(param_high),
            constraint=str(arrays["constraint"]),
            task=json.loads(str(arrays["task"])),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{path} is an incomplete policy file: {error}") from error
    _check(path, saved)
    return saved


def _checked_path(path: Path | str) -> Path:
    if not isinstance(path, Path | str):
        raise UserError(f"path must be that of a file, got {shown(path)}")
    return Path(path)


def _check(path: Path, saved: SavedPolicy) -> None:
    """Refuse what cannot be a policy."""
    if saved.constraint not in CONSTRAINTS:
        raise UserError(
            f"{path}: constraint must be one of {', '.join(CONSTRAINTS)}, got {saved.constraint!r}"
        )
    numbers = [saved.coef, saved.cov_chol, saved.param_low, saved.param_high]
    numbers += [saved.context_low, saved.context_high]
    try:
        is_finite = all(np.all(np.isfinite(values)) for values in numbers)
    except TypeError:
        raise UserError(f"{path}: the policy holds something else where numbers are expected") from None
    if not is_finite:
        raise UserError(f"{path}: the policy holds numbers that are not finite")
    if not len(saved.context_names) == len(saved.context_units) == len(saved.context_low):
        raise UserError(f"{path}: expected a unit and a range for each of {', '.join(saved.context_names)}")
    num_params = len(saved.param_names)
    try:
        wanted = (saved.feature_map().size, num_params)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error
    if np.shape(saved.coef) != wanted or np.shape(saved.cov_chol) != (num_params, num_params):
        raise UserError(
            f"{path}: expected coef {wanted} and cov_chol {(num_params, num_params)}, "
            f"got {np.shape(saved.coef)} and {np.shape(saved.cov_chol)}"
        )
    if not len(saved.param_units) == len(saved.param_low) == len(saved.param_high) == num_params:
        raise UserError(f"{path}: expected units and bounds for each of the {num_params} parameters")
    for name, low, high in zip(saved.param_names, saved.param_low, saved.param_high, strict=True):
        if low > high:
            raise UserError(f"{path}: the bounds of {name} must be in order, got {low} and {high}")
