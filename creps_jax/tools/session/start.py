"""The beginning of a session: a saved policy, or the start and the spread of each parameter."""

import dataclasses
import math
from collections.abc import Sequence
from typing import TypeVar

import jax.numpy as jnp
import numpy as np

from creps_jax.errors import UserError
from creps_jax.policies.bounds import CLIP, SIGMOID
from creps_jax.policies.feature_settings import Features
from creps_jax.policies.features import FeatureMap, describe
from creps_jax.policies.gaussian import LinearGaussian, start_policy
from creps_jax.policies.learned import Learned, linear_policy
from creps_jax.policies.space import Space
from creps_jax.search.input_checks import samples_for_many_features
from creps_jax.tools.session.plain import shortest
from creps_jax.tools.session.settings import Context, FirstPolicy, Parameter, Settings, ends
from creps_jax.typing import VectorLike

V = TypeVar("V", bound=Context)


def settings_from_policy(learned: Learned, *, exploration: float = 1.0) -> Settings:
    """Return settings that begin with a policy.

    Args:
        learned: the policy; without a sigmoid, its parameters are clipped to their bounds.
        exploration: factor of its standard deviations.

    Raises:
        UserError: if the policy is a network, the factor is not positive and finite, or settings of a session
            cannot describe the features.
    """
    policy = linear_policy(learned, "begin a session")
    if not (exploration > 0 and math.isfinite(exploration)):
        raise UserError(f"exploration must be above zero and finite, got {exploration}")
    cov_chol = np.float32(exploration) * np.asarray(policy.cov_chol, np.float32)
    return Settings(
        contexts=_variables(Context, learned.contexts),
        parameters=_variables(Parameter, learned.parameters),
        features=_settings_of_features(learned),
        constraint=SIGMOID if learned.parameters.constraint == SIGMOID else CLIP,
        first_policy=FirstPolicy(
            coef=tuple(tuple(shortest(row)) for row in policy.coef),
            cov_chol=tuple(tuple(shortest(row)) for row in cov_chol),
        ),
        task=dict(learned.task),
    )


def _settings_of_features(learned: Learned) -> Features:
    """Return the settings that make a policy's features."""
    low, high = learned.contexts.low, learned.contexts.high
    described = describe(learned.features)
    settings = Features("linear")
    if described["kind"] in ("polynomial", "scaled polynomial"):
        is_scaled = described["kind"] == "scaled polynomial"
        settings = Features("polynomial", degree=described["degree"], scaled=is_scaled)
    elif described["kind"] == "rbf":
        counts, widths = described["num_centers"], described["width"]
        num_centers = counts[0] if len(set(counts)) == 1 else tuple(counts)
        settings = Features("rbf", num_centers)
        if _made(settings, low, high) != learned.features:
            settings = Features("rbf", num_centers, widths[0])
    elif described["kind"] == "kernel":
        settings = Features("kernel", num_points=described["num"])
        if _made(settings, low, high) != learned.features:
            settings = dataclasses.replace(settings, bandwidth=described["bandwidth"][0])
    if _made(settings, low, high) != learned.features:
        raise UserError(
            "a session must begin with linear or polynomial features, or with scaled polynomials, RBFs or a "
            f"kernel over the range of the contexts, of the default width or one width, got {described}"
        )
    return settings


def _made(settings: Features, low: VectorLike, high: VectorLike) -> FeatureMap | None:
    """Return the features of settings; None if the range does not allow them."""
    try:
        return settings.make(low, high)
    except ValueError:
        return None


def complete(settings: Settings) -> Settings:
    """Fill in the defaults of a definition: features, start and spread of parameters, size of the archive.

    Raises:
        UserError: if the settings of the features are out of their ranges.
    """
    asked = settings.features
    features = asked.complete(len(settings.contexts))
    named = (asked.kind, asked.num_points, asked.bandwidth)
    is_by_default = features.kind == "kernel" and named == (None, None, None)
    if is_by_default or (features.kind == "polynomial" and asked.degree is None):
        # More features than those of degree 2 are too many for the hundreds of trials of a session.
        features = dataclasses.replace(asked, kind="polynomial", degree=2)
    settings = dataclasses.replace(settings, features=features)
    num_features, theta_dim = feature_map(settings).size, len(settings.parameters)
    if settings.archive_size is None:
        # An update needs as many trials as there are features and parameters.
        least = max(2 * (num_features + theta_dim), samples_for_many_features(num_features, theta_dim))
        settings = dataclasses.replace(settings, archive_size=max(5 * settings.batch_size, least))
    if settings.first_policy is not None:
        return settings
    parameters = [
        dataclasses.replace(
            each,
            start=0.5 * (each.low + each.high) if each.start is None else each.start,
            spread=0.125 * (each.high - each.low) if each.spread is None else each.spread,
        )
        for each in settings.parameters
    ]
    return dataclasses.replace(settings, parameters=tuple(parameters))


def first_policy(settings: Settings) -> LinearGaussian:
    """Return the first policy of a session, a distribution of free parameters.

    Raises:
        UserError: if its arrays do not fit the settings, or do not make a Gaussian in single precision.
    """
    given = settings.first_policy
    coef, cov_chol = _start(settings) if given is None else (given.coef, given.cov_chol)
    coef, cov_chol = np.array(coef, np.float32), np.array(cov_chol, np.float32)
    num_params = len(settings.parameters)
    wanted = (feature_map(settings).size, num_params), (num_params, num_params)
    if (coef.shape, cov_chol.shape) != wanted:
        raise UserError(
            f"the first policy must have coef {wanted[0]} and cov_chol {wanted[1]}, "
            f"got {coef.shape} and {cov_chol.shape}"
        )
    deviation = np.diagonal(cov_chol)
    if not (np.isfinite(coef).all() and np.isfinite(cov_chol).all() and (deviation > 0).all()):
        raise UserError(
            "the first policy must be finite, and the diagonal of its cov_chol above zero, in single "
            f"precision, got {deviation.tolist()}"
        )
    return LinearGaussian(jnp.asarray(coef), jnp.asarray(cov_chol))


def _variables(kind: type[V], space: Space) -> tuple[V, ...]:
    rows = zip(space.names, space.units, space.low, space.high, strict=True)
    return tuple(kind(name=name, unit=unit, low=low, high=high) for name, unit, low, high in rows)


def _start(settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """Return coefficients and covariance factor of a policy that does not depend on the context."""
    columns = [(each.start, each.spread, each.low, each.high) for each in settings.parameters]
    start, spread, low, high = np.array(columns, float).T
    if settings.constraint == SIGMOID:
        # To first order, the slope of the sigmoid converts the spread of the parameters.
        share = (start - low) / (high - low)
        start, spread = np.log(share / (1 - share)), spread / ((high - low) * share * (1 - share))
    try:
        policy = start_policy(feature_map(settings), len(settings.parameters), mean=start, std=spread)
    except ValueError as error:
        raise UserError(f"start and spread must make a Gaussian in single precision: {error}") from error
    return np.asarray(policy.coef), np.asarray(policy.cov_chol)


def feature_map(settings: Settings) -> FeatureMap:
    """Return the features of the context.

    Raises:
        UserError: if their settings are out of their ranges.
    """
    try:
        return settings.features.make(*ends(settings.contexts))
    except ValueError as error:
        raise UserError(str(error)) from error


def space_of(variables: Sequence[Context], constraint: str = CLIP) -> Space:
    """Return the variables of a session as the `Space` of a policy."""
    low, high = ends(variables)
    return Space(
        tuple(each.name for each in variables), low, high, tuple(each.unit for each in variables), constraint
    )
