"""Make features of the context: linear, quadratic, polynomial, radial basis functions, a kernel.

Equal settings make equal features, which can be copied and pickled, and described by plain values.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from creps_jax import checks
from creps_jax.policies.feature_functions import (
    Kernel,
    Linear,
    Polynomial,
    Quadratic,
    Radial,
    ScaledPolynomial,
    grid_of_centers,
    middle_and_half,
)
from creps_jax.typing import Array, Float, VectorLike

__all__ = [
    "FeatureMap",
    "kernel_features",
    "linear_features",
    "polynomial_features",
    "quadratic_features",
    "rbf_features",
    "rbf_grid",
    "scaled_polynomial_features",
]

_MOST_FEATURES = 1_000_000
"""Largest number of monomials, which grows fast: more would fill the memory."""
MOST_POINTS = 2000
"""Largest number of inducing contexts: the eigenvalues of a larger kernel matrix take minutes."""
_BANDWIDTHS = (1e-3, 1e3)
"""Least and largest bandwidth of a kernel, relative to the range."""


class FeatureMap(NamedTuple):
    """A function from a context to features, and its sizes.

    Call it with a context (s,) for features (m,), or with contexts (n, s) for features (n, m).
    """

    apply: Callable[[Float[Array, " s"]], Float[Array, " m"]]
    """(context (s,)) -> features (m,)."""
    size: int
    """Number m of features."""
    context_dim: int
    """Number s of context variables."""
    scale: tuple[float, ...] | None = None
    """The largest value of each feature: penalties on its coefficients are relative to it. None: the standard
    deviation over the samples."""
    constant: tuple[float, ...] | None = None
    """Coefficients c with `c' features = 1` in every context, which a fit does not penalise. None: not
    stated; a fit looks for one in the samples, see `fit_weighted_ml`."""
    name: str | None = None
    """A name to save and load policies with features of your own."""

    def __call__(self, contexts: Float[Array, "*n s"]) -> Float[Array, "*n m"]:
        """Compute the features of a context, or of each row of contexts.

        Raises:
            ValueError: If a context does not have `context_dim` variables.
        """
        contexts = checks.array("contexts", contexts)
        if contexts.ndim < 1 or contexts.shape[-1] != self.context_dim:
            raise ValueError(
                f"contexts must have {self.context_dim} variables along the last axis, got {contexts.shape}"
            )
        apply = self.apply
        for _ in range(contexts.ndim - 1):
            apply = jax.vmap(apply)
        features = apply(contexts)
        shape = (*contexts.shape[:-1], self.size)
        return checks.finite("features", checks.array("features", features, shape), largest=math.inf)


@checks.arguments
def linear_features(dim: int) -> FeatureMap:
    """Make the features [1, s] of an affine policy.

    Args:
        dim: Number of context variables.

    Returns:
        The map to 1 + dim features.

    Raises:
        ValueError: If `dim` is below 1; on `apply`, if a context has another shape than (dim,).

    Source: Abdolmaleki et al. 2016, text below Eq. 15.
    """
    return FeatureMap(Linear(dim), 1 + dim, dim, constant=(1.0,) + (0.0,) * dim)


@checks.arguments
def quadratic_features(dim: int) -> FeatureMap:
    """Make the features [s, s^2] of a quadratic baseline.

    As in the paper there are no products of two variables, and no constant, along which the dual function
    does not change. A policy needs a constant: use `linear_features` or `rbf_features`.

    Args:
        dim: Number of context variables.

    Returns:
        The map to 2 dim features.

    Raises:
        ValueError: If `dim` is below 1; on `apply`, if a context has another shape than (dim,).

    Source: Abdolmaleki et al. 2016, text below Eq. 11 and 15.
    """
    return FeatureMap(Quadratic(dim), 2 * dim, dim)


@checks.arguments
def polynomial_features(dim: int, degree: int) -> FeatureMap:
    """Make all monomials of the context variables up to a degree, products of several variables included.

    The constant comes first, then the monomials by their degree; those of one degree in the order of
    `itertools.combinations_with_replacement`: for s = (x, y) and degree 2 the features are
    [1, x, y, x^2, x y, y^2].

    Args:
        dim: Number of context variables.
        degree: The largest sum of the exponents in a monomial.

    Returns:
        The map to (dim + degree)! / (dim! degree!) features.

    Raises:
        ValueError: If `dim` or `degree` is below 1, or there are too many features; on `apply`, if a context
            has another shape than (dim,).
    """
    return _monomials(Polynomial(dim, degree), dim, degree)


@checks.arguments
def scaled_polynomial_features(low: VectorLike, high: VectorLike, degree: int) -> FeatureMap:
    """Make `polynomial_features` of the context, scaled from a range to -1 to 1.

    Within the range no monomial exceeds 1, whatever the unit and the zero of the context.

    Args:
        low: Lower end of the range of each context variable.
        high: Upper end of the range of each context variable.
        degree: The largest sum of the exponents in a monomial.

    Returns:
        The map to (dim + degree)! / (dim! degree!) features, for dim context variables.

    Raises:
        ValueError: If the ends differ in length, a number is not finite, low >= high, `degree` is below 1, or
            there are too many features; on `apply`, if a context has another shape than (dim,).
    """
    lows, highs = checks.ends(low, high)
    return _monomials(
        ScaledPolynomial(tuple(lows.tolist()), tuple(highs.tolist()), degree), lows.size, degree
    )


def _monomials(apply: Polynomial | ScaledPolynomial, dim: int, degree: int) -> FeatureMap:
    # A number with hundreds of digits or more is not computed.
    size = math.inf if min(dim, degree) > 100 else math.comb(dim + degree, degree)
    if size > _MOST_FEATURES:
        raise ValueError(
            f"dim and degree must leave at most {_MOST_FEATURES} features, got {dim} and {degree}"
        )
    return FeatureMap(apply, int(size), dim, constant=(1.0,) + (0.0,) * (int(size) - 1))


def rbf_features(
    low: VectorLike,
    high: VectorLike,
    num_centers: int | Sequence[int],
    *,
    bandwidth: VectorLike | None = None,
) -> FeatureMap:
    """Make normalised radial basis functions on a full grid of centres.

    Centres are equally spaced from `low` to `high`, both included (one centre: the middle). The features of a
    context are not negative and sum to one; far outside the range only that of the nearest centre is left.

    Args:
        low: Lower end of the range of each context variable.
        high: Upper end of the range of each context variable.
        num_centers: Number of centres K along each context variable: one for all, or one for each.
        bandwidth: Width sigma along each context variable, in its unit; (high - low) / K by default.

    Returns:
        The map to as many features as there are centres, K^dim for one K, the last context variable changing
        fastest.

    Raises:
        ValueError: If the settings differ in length, a number is not finite, low >= high, num_centers < 1 or
            bandwidth <= 0; on `apply`, if a context has another shape than (dim,).

    Source: Abdolmaleki et al. 2016, Eq. 16. The paper prints the default width as sigma squared, which has
    another unit.
    """
    lows, highs, counts, widths = _rbf_settings(low, high, num_centers, bandwidth)
    radial = Radial(tuple(lows.tolist()), tuple(highs.tolist()), counts, tuple(widths.tolist()))
    size = math.prod(counts)
    return FeatureMap(radial, size, lows.size, scale=(1.0,) * size, constant=(1.0,) * size)


def rbf_grid(
    low: VectorLike,
    high: VectorLike,
    num_centers: int | Sequence[int],
    *,
    bandwidth: VectorLike | None = None,
) -> tuple[Float[np.ndarray, "m s"], Float[np.ndarray, " s"]]:
    """Place the centres of radial basis functions.

    Args:
        low: As in `rbf_features`.
        high: As in `rbf_features`.
        num_centers: As in `rbf_features`.
        bandwidth: As in `rbf_features`.

    Returns:
        A row for each centre, in the order of the features, and the width along each context variable.

    Raises:
        ValueError: If `rbf_features` would refuse the settings.
    """
    lows, highs, counts, widths = _rbf_settings(low, high, num_centers, bandwidth)
    return grid_of_centers(lows, highs, counts), widths


@checks.arguments
def kernel_features(
    low: VectorLike, high: VectorLike, num: int, *, bandwidth: VectorLike | None = None
) -> FeatureMap:
    """Make the features of a sparse Gaussian process with a squared-exponential kernel.

    With `num` inducing contexts Z, the features are a constant and `K(Z, Z)^-1/2 k(Z, s)`, where
    `k(z, s) = exp(-sum (z - s)^2 / (2 bandwidth^2))`. Bayesian linear regression on them is regression with
    the Gaussian process that the inducing contexts represent (the projected process), and the ridge of a fit
    is its prior. The inducing contexts are the first points of the Halton sequence. Their number does not
    grow with the number of context variables as that of a grid does: use these features for three to six
    variables.

    Args:
        low: Lower end of the range of each context variable.
        high: Upper end of the range of each context variable.
        num: Number of inducing contexts.
        bandwidth: Distance over which the mean changes, along each context variable, in its unit;
            0.75 (high - low) by default.

    Returns:
        The map to 1 + num features. Far outside the range only the constant is left.

    Raises:
        ValueError: If the settings differ in length, a number is not finite, low >= high, there are too many
            inducing contexts, or a bandwidth is not from 0.001 to 1000 times the range; on `apply`, if a
            context has another shape than (dim,).

    Source: Rasmussen and Williams 2006, Gaussian Processes for Machine Learning, Section 8.3.4.
    """
    lows, highs = checks.ends(low, high)
    if num > MOST_POINTS:
        raise ValueError(f"num must be at most {MOST_POINTS} inducing contexts, got {num}")
    _, halves = middle_and_half(lows, highs)
    widths = 1.5 * halves if bandwidth is None else checks.vector("bandwidth", bandwidth)
    if widths.shape not in ((), (1,), lows.shape):
        raise ValueError(f"bandwidth must be a number or as long as low, {lows.size}, got {bandwidth}")
    relative = 0.5 * (widths / halves)
    if not np.all((relative >= _BANDWIDTHS[0]) & (relative <= _BANDWIDTHS[1])):
        least, most = (f"{each:g}" for each in _BANDWIDTHS)
        raise ValueError(f"bandwidth must be from {least} to {most} times high - low, got {bandwidth}")
    widths = np.broadcast_to(widths, lows.shape)
    kernel = Kernel(tuple(lows.tolist()), tuple(highs.tolist()), num, tuple(widths.tolist()))
    size = 1 + num
    return FeatureMap(kernel, size, lows.size, scale=(1.0,) * size, constant=(1.0,) + (0.0,) * num)


def describe(features: FeatureMap) -> dict[str, Any]:
    """Describe features by plain values, from which `from_description` makes them again.

    Raises:
        ValueError: If they are the user's own and have no name.
    """
    for kind, functions in _KINDS.items():
        if isinstance(features.apply, functions):
            description = {"kind": kind, **vars(features.apply)}
            if from_description(description) == features:
                return description
    if features.name is None:
        raise ValueError(
            "features of your own must have a name, FeatureMap(..., name='mine'), to be saved or exported, "
            f"got {checks.shown(features)}"
        )
    return {"kind": "own", "name": features.name, "size": features.size, "dim": features.context_dim}


def from_description(description: Mapping[str, Any], own: FeatureMap | None = None) -> FeatureMap:
    """Make the features that were described.

    Args:
        description: The result of `describe`.
        own: The user's own features, if the description is of such.

    Raises:
        ValueError: If the kind is unknown, or `own` is needed and is missing or has another name or size.
    """
    settings = dict(description)
    kind = settings.pop("kind", None)
    if kind == "rbf":
        width = settings.pop("width")
        return rbf_features(settings["low"], settings["high"], settings["num_centers"], bandwidth=width)
    if kind in _MAKERS:
        return _MAKERS[kind](**settings)
    if kind != "own":
        raise ValueError(f"the kind of features must be one of {', '.join(_KINDS)}, got {kind!r}")
    if own is None or (own.name, own.size, own.context_dim) != tuple(
        settings[name] for name in ("name", "size", "dim")
    ):
        raise ValueError(
            f"features must be the FeatureMap named {settings['name']!r}, of {settings['size']} features of "
            f"{settings['dim']} context variables, got {checks.shown(own)}"
        )
    return own


_KINDS = {
    "linear": Linear,
    "quadratic": Quadratic,
    "polynomial": Polynomial,
    "scaled polynomial": ScaledPolynomial,
    "rbf": Radial,
    "kernel": Kernel,
}
"""The functions of each kind."""
_MAKERS = {
    "linear": linear_features,
    "quadratic": quadratic_features,
    "polynomial": polynomial_features,
    "scaled polynomial": scaled_polynomial_features,
    "kernel": kernel_features,
}
"""Makers of the kinds whose settings are the fields of their functions."""


def _rbf_settings(
    low: VectorLike, high: VectorLike, num_centers: int | Sequence[int], bandwidth: VectorLike | None
) -> tuple[np.ndarray, np.ndarray, tuple[int, ...], np.ndarray]:
    """Return low, high, number of centres and width of each context variable, after a check."""
    lows, highs = checks.ends(low, high)
    counts = checks.grid("num_centers", num_centers, lows.size)
    default = (highs - lows) / np.array(counts)
    widths = default if bandwidth is None else checks.vector("bandwidth", bandwidth)
    if widths.shape not in ((), (1,), lows.shape):
        raise ValueError(f"bandwidth must be a number or as long as low, {lows.size}, got {bandwidth}")
    if not np.all(widths >= checks.FLOAT32_TINY):
        note = ", which float32 cannot hold" if np.all(widths > 0) else ""
        raise ValueError(f"bandwidth must be above zero, got {bandwidth}{note}")
    return lows, highs, counts, np.broadcast_to(widths, lows.shape)
