"""Name features by plain settings, as runs, sessions and files hold them."""

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from creps_jax.policies.features import FeatureMap
    from creps_jax.typing import VectorLike

__all__ = ["FEATURE_KINDS", "Features"]

FEATURE_KINDS = ("linear", "rbf")
"""What `Features` can name."""


@dataclasses.dataclass(frozen=True)
class Features:
    """Settings of features, as runs, sessions and files hold them.

    Attributes:
        kind: One of `FEATURE_KINDS`.
        num_centers: K along each context variable, for RBFs; None is 5 for one variable, 3 for two, and 2 for
            more.
        bandwidth: Width of the RBFs in the units of the context; None is (high - low) / K.
    """

    kind: str = "rbf"
    num_centers: int | None = None
    bandwidth: float | None = None

    def complete(self, dim: int) -> "Features":
        """Return the settings for a number of context variables, with what None stands for."""
        if self.num_centers is not None:
            return self
        return dataclasses.replace(self, num_centers={1: 5, 2: 3}.get(dim, 2))

    def make(self, low: "VectorLike", high: "VectorLike") -> "FeatureMap":
        """Return the features over a range of contexts: a number, or one for each context variable.

        Raises:
            ValueError: If the kind is unknown, or a setting is out of its range.
        """
        # Settings are read by commands that do not start jax.
        from creps_jax.policies.features import linear_features, rbf_features

        if self.kind == "linear":
            return linear_features(np.size(low))
        if self.kind == "rbf":
            num_centers = self.complete(np.size(low)).num_centers
            return rbf_features(low, high, num_centers or 0, bandwidth=self.bandwidth)
        raise ValueError(f"features must be one of {', '.join(FEATURE_KINDS)}, got {self.kind!r}")

    def make_baseline(self, low: "VectorLike", high: "VectorLike") -> "FeatureMap":
        """Return the baseline features that go with these: quadratic ones for linear policies, else the same.

        Raises:
            ValueError: As `make` does.
        """
        from creps_jax.policies.features import quadratic_features

        features = self.make(low, high)
        return quadratic_features(features.context_dim) if self.kind == "linear" else features
