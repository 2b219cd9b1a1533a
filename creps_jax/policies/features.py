"""Make features of the context: linear, quadratic, polynomial, normalised radial basis functions.

What computes them is data, numbers in a record: equal settings give equal features, which can be copied and
pickled.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from creps_jax import checks
from creps_jax.typing import Array, Float, VectorLike

__all__ = [
    "FeatureMap",
    "linear_features",
    "polynomial_features",
    "quadratic_features",
    "rbf_features",
    "rbf_grid",
]

_FAR = 1e20
"""Distance from the range, in bandwidths, beyond which a context counts as that far: no overflow."""
_LARGE = 1e30
"""Size of the ends of a range from which differences can overflow, and the inverse of a bandwidth, which
compiled programs multiply by, can be so small that they take it for zero."""
_NARROW = 1e-9
"""Bandwidth, relative to the range, below which squares of distances can overflow. Centres are then a hundred
bandwidths apart or more, so that only the nearest has a weight."""
_MOST_FEATURES = 1_000_000
"""The largest number of monomials: it grows fast, and a slip would fill the memory."""


class FeatureMap(NamedTuple):
    """Hold a function from a context to features, and the numbers of both.

    Call it with a context (s,) for features (m,), or with contexts (n, s) for features (n, m).
    """

    apply: Callable[[Float[Array, " s"]], Float[Array, " m"]]
    """Of one context."""
    size: int
    context_dim: int
    scale: tuple[float, ...] | None = None
    """The largest value of each feature, which penalties on its coefficients are relative to; None: the
    standard deviation over the samples."""
    constant: tuple[float, ...] | None = None
    """Coefficients whose sum with the features is one for every context; None where there are none."""
    name: str | None = None
    """A name, by which policies with features of your own are saved and loaded."""

    def __call__(self, contexts: Float[Array, "*n s"]) -> Float[Array, "*n m"]:
        """Compute the features of a context, or of each row of contexts.

        Raises:
            ValueError: If a context has not `context_dim` variables.
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
    return FeatureMap(_Linear(dim), 1 + dim, dim, constant=(1.0,) + (0.0,) * dim)


@checks.arguments
def quadratic_features(dim: int) -> FeatureMap:
    """Make the features [s, s^2] of a quadratic baseline.

    As the paper writes them: the squares of each variable without products of two, and no constant, along
    which the dual function does not change. A policy needs one: `linear_features` and `rbf_features` have it.

    Args:
        dim: Number of context variables.

    Returns:
        The map to 2 dim features.

    Raises:
        ValueError: If `dim` is below 1; on `apply`, if a context has another shape than (dim,).

    Source: Abdolmaleki et al. 2016, text below Eq. 11 and 15.
    """
    return FeatureMap(_Quadratic(dim), 2 * dim, dim)


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
    # The number is not even computed where it has hundreds of digits or more.
    size = math.inf if min(dim, degree) > 100 else math.comb(dim + degree, degree)
    if size > _MOST_FEATURES:
        raise ValueError(
            f"dim and degree must leave at most {_MOST_FEATURES} features, got {dim} and {degree}"
        )
    return FeatureMap(_Polynomial(dim, degree), int(size), dim, constant=(1.0,) + (0.0,) * (int(size) - 1))


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

    Source: Abdolmaleki et al. 2016, Eq. 16. The paper prints the default width for sigma squared, whose unit
    it does not have.
    """
    lows, highs, counts, widths = _rbf_settings(low, high, num_centers, bandwidth)
    radial = _Radial(tuple(lows.tolist()), tuple(highs.tolist()), counts, tuple(widths.tolist()))
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
        low: As in `rbf_features`, like the other arguments.
        high: The same.
        num_centers: The same.
        bandwidth: The same.

    Returns:
        A row for each centre, in the order of the features, and the width along each context variable.

    Raises:
        ValueError: If `rbf_features` would refuse the settings.
    """
    lows, highs, counts, widths = _rbf_settings(low, high, num_centers, bandwidth)
    return _centers(lows, highs, counts), widths


def describe(features: FeatureMap) -> dict[str, Any]:
    """Describe features by plain values, from which `from_description` makes them again.

    Raises:
        ValueError: If they are a user's own and have no name.
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
        description: What `describe` returned.
        own: The user's own features, where such were described.

    Raises:
        ValueError: If the description is none, or `own` is needed and missing or of another name or size.
    """
    settings = dict(description)
    kind = settings.pop("kind", None)
    if kind == "rbf":
        width = settings.pop("width")
        return rbf_features(settings["low"], settings["high"], settings["num_centers"], bandwidth=width)
    if kind in _KINDS:
        return {
            "linear": linear_features,
            "quadratic": quadratic_features,
            "polynomial": polynomial_features,
        }[kind](**settings)
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


@dataclasses.dataclass(frozen=True)
class _Linear:
    """Compute the features [1, s]."""

    dim: int

    def __call__(self, context: Float[Array, " s"]) -> Float[Array, " m"]:
        context = _checked_context(context, self.dim)
        return jnp.concatenate([jnp.ones_like(context[:1]), context])


@dataclasses.dataclass(frozen=True)
class _Quadratic:
    """Compute the features [s, s^2]."""

    dim: int

    def __call__(self, context: Float[Array, " s"]) -> Float[Array, " m"]:
        context = _checked_context(context, self.dim)
        return jnp.concatenate([context, _kept_finite(context**2)])


@dataclasses.dataclass(frozen=True)
class _Polynomial:
    """Compute all monomials up to a degree."""

    dim: int
    degree: int

    def __call__(self, context: Float[Array, " s"]) -> Float[Array, " m"]:
        context = _checked_context(context, self.dim)
        monomials = [jnp.ones_like(context[:1])]
        rows: dict[tuple[int, ...], int] = {(): 0}
        for degree in range(1, self.degree + 1):
            # Each is one of the degree below times its last variable.
            combinations = list(itertools.combinations_with_replacement(range(self.dim), degree))
            factors = np.array([rows[variables[:-1]] for variables in combinations])
            last = np.array([variables[-1] for variables in combinations])
            monomials.append(_kept_finite(monomials[-1][factors] * context[last]))
            rows = {variables: row for row, variables in enumerate(combinations)}
        return jnp.concatenate(monomials)


@dataclasses.dataclass(frozen=True)
class _Radial:
    """Compute normalised radial basis functions."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    num_centers: tuple[int, ...]
    width: tuple[float, ...]

    def __call__(self, context: Float[Array, " s"]) -> Float[Array, " m"]:
        context = _checked_context(context, len(self.low))
        low, high, width = (np.asarray(numbers) for numbers in (self.low, self.high, self.width))
        centers = _centers(low, high, self.num_centers)
        is_narrow = width < _NARROW * (high - low)
        width = np.where(is_narrow, high - low, width)
        # A power of two, so that results are the same to the bit where it is not needed.
        unit = np.where(np.maximum(np.abs(low), np.abs(high)) > _LARGE, 16.0, 1.0)
        # Multiplied in another order, as compilers like to, extreme numbers overflow or become zero.
        is_extreme = np.any(is_narrow | (unit > 1) | (width < 1 / checks.LARGEST) | (width > checks.LARGEST))

        def in_order(numbers: Array) -> Array:
            return jnp.asarray(lax.optimization_barrier(numbers)) if is_extreme else numbers

        low, high, width, centers, unit = (
            jnp.asarray(numbers, context.dtype)
            for numbers in (low / unit, high / unit, width / unit, centers / unit, unit)
        )
        context = in_order(context / unit)
        nearest = jnp.clip(context, low, high)
        inside = in_order((nearest[None, :] - centers) / width[None, :])
        outside = in_order(jnp.clip((context - nearest) / width, -_FAR, _FAR))
        # (s - c)^2 / 2 sigma^2 less the term all centres share, which far outside would drown the others.
        costs = 0.5 * inside**2 + outside[None, :] * inside
        if is_narrow.any():
            distance = jnp.abs(inside)
            is_nearest = distance == jnp.min(distance, axis=0)[None, :]
            costs = jnp.where(is_narrow[None, :], jnp.where(is_nearest, 0.0, jnp.inf), costs)
        # Without the barrier compilers put the costs into the sum over them: all of them anew for each.
        # In print: psi_j / sum of psi, psi_j = exp(-(s - c_j)^2 / (2 sigma^2))
        return jax.nn.softmax(jnp.asarray(lax.optimization_barrier(-jnp.sum(costs, axis=1))))  # Eq. 16


_KINDS = {"linear": _Linear, "quadratic": _Quadratic, "polynomial": _Polynomial, "rbf": _Radial}
"""What computes the features of each kind."""


def _centers(low: np.ndarray, high: np.ndarray, num_centers: tuple[int, ...]) -> np.ndarray:
    """Return a row for each centre, in the order of the features."""
    places = [np.linspace(0.0, 1.0, num) if num > 1 else np.array([0.5]) for num in num_centers]
    grid = np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).reshape(-1, low.size)
    return low + grid * (high - low)


def _kept_finite(features: Array) -> Array:
    """Take what has overflowed for the largest number: its product with zero is then a number too."""
    largest = float(jnp.finfo(features.dtype).max)
    return jnp.clip(features, -largest, largest)


def _rbf_settings(
    low: VectorLike, high: VectorLike, num_centers: int | Sequence[int], bandwidth: VectorLike | None
) -> tuple[np.ndarray, np.ndarray, tuple[int, ...], np.ndarray]:
    """Return low, high, number of centres and width of each context variable, after checking them."""
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


def _checked_context(context: Array, dim: int) -> Array:
    return checks.finite("context", checks.array("context", context, (dim,)))
