"""Plain settings of features, for runs, sessions and files; jax starts when the features are made."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from creps_jax.policies.features import FeatureMap
    from creps_jax.typing import VectorLike

__all__ = ["FEATURE_KINDS", "Features", "as_in_earlier_versions", "upgraded"]

FEATURE_KINDS = ("linear", "polynomial", "rbf", "kernel")
"""The kinds of features that `Features` can make."""


@dataclasses.dataclass(frozen=True)
class Features:
    """Settings of features, for runs, sessions and files.

    Attributes:
        kind: One of `FEATURE_KINDS`. None is "polynomial" with a degree, "kernel" with a number of points,
            "rbf" with a number of centres; without any of them, "rbf" for one or two variables and "kernel"
            for more.
        num_centers: Number K of RBF centres: one for all context variables, or one for each; None is 5 for
            one variable, 3 along each of two, and 2 along each of more.
        bandwidth: Width of the RBFs or the kernel in the units of the context; None is (high - low) / K for
            RBFs, 0.75 (high - low) for a kernel.
        degree: Largest sum of the exponents in a monomial of polynomial features; None is 3 for three
            variables, and 2 for other numbers of them.
        num_points: Number of inducing contexts of kernel features, see `kernel_features`; None is 6 for one
            variable, 10 for two, and 20 for more.
        scaled: Whether polynomial features are of the context scaled from its range to -1 to 1; not used by
            other kinds.
    """

    kind: str | None = None
    num_centers: int | tuple[int, ...] | None = None
    bandwidth: float | None = None
    degree: int | None = None
    num_points: int | None = None
    scaled: bool = True

    def __post_init__(self) -> None:
        # Settings are hashed.
        if isinstance(self.num_centers, list):
            object.__setattr__(self, "num_centers", tuple(self.num_centers))

    def complete(self, dim: int) -> "Features":
        """Return the settings for a number of context variables, with the default kind and size."""
        kind = self._kind(dim)
        if kind == "polynomial":
            return dataclasses.replace(self, kind=kind, degree=self._degree(dim))
        if kind == "kernel":
            return dataclasses.replace(self, kind=kind, num_points=self._points(dim))
        return dataclasses.replace(self, kind=kind, num_centers=self._centers(dim))

    def make(self, low: "VectorLike", high: "VectorLike") -> "FeatureMap":
        """Return the features over a range of contexts: a number, or one for each context variable.

        Raises:
            ValueError: If the kind is unknown, or a setting is out of its range.
        """
        # Settings are read by commands that do not start jax.
        from creps_jax import checks
        from creps_jax.policies import features

        checks.instance("scaled", self.scaled, bool)
        dim = np.size(low)
        kind = self._kind(dim)
        if self.degree is not None and kind != "polynomial":
            raise ValueError(f"degree must be None for {kind} features, got {self.degree}")
        if self.num_points is not None and kind != "kernel":
            raise ValueError(f"num_points must be None for {kind} features, got {self.num_points}")
        if kind == "kernel" and self.num_centers is not None:
            raise ValueError(f"num_centers must be None for kernel features, got {self.num_centers}")
        if self.num_points is not None:
            self._check_points(features.MOST_POINTS)
        if kind == "polynomial" and (self.num_centers, self.bandwidth) != (None, None):
            raise ValueError(
                "num_centers and bandwidth must be None for polynomial features, got "
                f"{self.num_centers} and {self.bandwidth}"
            )
        if kind == "linear":
            return features.linear_features(dim)
        if kind == "polynomial":
            if self.scaled:
                return features.scaled_polynomial_features(low, high, self._degree(dim))
            return features.polynomial_features(dim, self._degree(dim))
        if kind == "rbf":
            return features.rbf_features(low, high, self._centers(dim), bandwidth=self.bandwidth)
        if kind == "kernel":
            return features.kernel_features(low, high, self._points(dim), bandwidth=self.bandwidth)
        raise ValueError(f"features must be one of {', '.join(FEATURE_KINDS)}, got {self.kind!r}")

    def make_baseline(self, low: "VectorLike", high: "VectorLike") -> "FeatureMap":
        """Return the baseline features for these: quadratic ones for linear policies, else the same.

        Raises:
            ValueError: As `make` does.
        """
        from creps_jax.policies.features import quadratic_features

        features = self.make(low, high)
        return quadratic_features(features.context_dim) if self.kind == "linear" else features

    def _check_points(self, most: int) -> None:
        num = self.num_points
        if not isinstance(num, int) or isinstance(num, bool) or not 1 <= num <= most:
            raise ValueError(f"num_points must be from 1 to {most}, got {num!r}")

    def _kind(self, dim: int) -> str:
        if self.kind is not None:
            return self.kind
        if self.degree is not None:
            return "polynomial"
        if self.num_points is not None:
            return "kernel"
        return "rbf" if dim <= 2 or self.num_centers is not None else "kernel"

    def _degree(self, dim: int) -> int:
        # Products of three of many variables would be too many features.
        return (3 if dim == 3 else 2) if self.degree is None else self.degree

    def _centers(self, dim: int) -> int | tuple[int, ...]:
        return {1: 5, 2: 3}.get(dim, 2) if self.num_centers is None else self.num_centers

    def _points(self, dim: int) -> int:
        return {1: 6, 2: 10}.get(dim, 20) if self.num_points is None else self.num_points


def as_in_earlier_versions(features: Mapping[str, Any]) -> dict[str, Any]:
    """Return plain settings of features without the fields that earlier versions did not have.

    Settings that earlier versions could state keep their identity: a digest, or the identity of a run.
    """
    left_out = [name for name in ("degree", "num_points") if features[name] is None]
    if not (features["kind"] == "polynomial" and features["scaled"]):
        left_out.append("scaled")
    return {name: value for name, value in features.items() if name not in left_out}


def upgraded(settings: Any) -> Any:
    """Convert plain settings from a file of an earlier version to the current fields.

    Earlier versions did not scale the contexts of polynomial features, and did not write `scaled`.
    """
    features = settings.get("features") if isinstance(settings, dict) else None
    if not isinstance(features, dict):
        return settings
    return {**settings, "features": {"scaled": False, **features}}
