"""A learned policy with everything that is needed to use it, and its file."""

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from creps_jax import checks
from creps_jax.errors import UserError
from creps_jax.files import load_arrays, save_arrays
from creps_jax.policies import features as feature_maps
from creps_jax.policies import gaussian, network_mean
from creps_jax.policies.bounds import CLIP, PENALTY
from creps_jax.policies.feature_functions import ScaledPolynomial
from creps_jax.policies.feature_settings import Features
from creps_jax.policies.features import FeatureMap
from creps_jax.policies.gaussian import LinearGaussian
from creps_jax.policies.network_mean import Layer, NetworkGaussian
from creps_jax.policies.space import Space
from creps_jax.typing import Array, Float

__all__ = ["Learned", "linear_policy", "load", "save"]

FORMAT = "creps_jax policy"
VERSION = 3
_NETWORK_VERSION = 4
"""The version of files with a network, which earlier versions of this package refuse to read."""
_READABLE = ("2", "3", "4")
_CLIP_BEFORE = PENALTY
"""The name of the constraint `clip` in files of version 2."""


@dataclasses.dataclass(frozen=True, eq=False)
class Learned:
    """A learned policy with all that is needed to use it.

    `learned(0.3)` returns the parameters for the context 0.3, by name, in their units.

    Attributes:
        policy: The distribution of free parameters, before bounds are applied: linear in the features, or a
            network, see `network_policy`.
        features: The features of the context; for a network, those of its `network_policy`.
        contexts: The context variables, with the ranges that the policy was learned for.
        parameters: The parameters, with their bounds and how they are kept within them.
        task: The name of the task that it was learned for, and the settings that it was learned with.

    Raises:
        ValueError: If the fields do not fit each other, or a number of the policy is not finite.
    """

    policy: LinearGaussian | NetworkGaussian
    features: FeatureMap
    contexts: Space
    parameters: Space
    task: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that the fields fit each other."""
        for name, *kinds in (
            ("policy", LinearGaussian, NetworkGaussian),
            ("features", FeatureMap),
            ("contexts", Space),
            ("parameters", Space),
            ("task", Mapping),
        ):
            checks.instance(name, getattr(self, name), *kinds)
        policy = _checked_policy(self.policy, self.features)
        if policy.coef.shape[1] != self.parameters.size:
            raise ValueError(
                f"policy must have a column of coef for each of {', '.join(self.parameters.names)}, "
                f"got coef {policy.coef.shape}"
            )
        if self.features.context_dim != self.contexts.size:
            raise ValueError(
                f"features must be of the contexts {', '.join(self.contexts.names)}, "
                f"got {self.features.context_dim} variables"
            )
        single = jax.tree.map(lambda values: checks.converted(values, np.dtype(np.float32)), policy)
        object.__setattr__(self, "policy", _checked_policy(single, self.features))
        try:
            task = json.loads(json.dumps(dict(self.task)))
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"task must be plain values, as JSON has them, got {self.task}: {error}"
            ) from None
        object.__setattr__(self, "task", task)

    def __call__(self, *context: Any, **named: Any) -> dict[str, float]:
        """Return the parameters for a context, by name, in their units and within their bounds.

        Args:
            context: A number for each context variable, or one sequence of them.
            named: The same by name, in place of `context`.

        Raises:
            ValueError: If there is not a number for each variable, or one is outside the range that the
                policy was learned for; see `in_range`.
        """
        return dict(zip(self.parameters.names, self.theta(*context, **named).tolist(), strict=True))

    def theta(self, *context: Any, **named: Any) -> np.ndarray:
        """Return the parameters for a context as an array (d,), within their bounds.

        Args:
            context: As in calling.
            named: As in calling.

        Raises:
            ValueError: As calling does.
        """
        return np.asarray(self.parameters.inside(jnp.asarray(self.mean(*context, **named))))

    def mean(self, *context: Any, **named: Any) -> np.ndarray:
        """Return the mean of the free parameters (d,) for a context, before bounds are applied.

        Args:
            context: As in calling.
            named: As in calling.

        Raises:
            ValueError: As calling does.
        """
        numbers = jnp.asarray(self.contexts.checked(self._values(context, named)), jnp.float32)
        features = self.features(numbers)
        if isinstance(self.policy, NetworkGaussian):
            return np.asarray(network_mean.mean_rows(self.policy, jnp.asarray(features)[None])[0])
        return np.asarray(features) @ np.asarray(self.policy.coef)

    def in_range(self, *context: Any, **named: Any) -> bool:
        """Return whether a context is within the range that the policy was learned for.

        Args:
            context: As in calling.
            named: As in calling.

        Raises:
            ValueError: If there is not a number for each context variable.
        """
        return self.contexts.contains(self._values(context, named))

    def thetas(self, contexts: Float[Array, "n s"]) -> Float[Array, "n d"]:
        """Return the parameters for many contexts; it can be jitted, and does not check the range."""
        features = jnp.asarray(self.features(contexts))
        if isinstance(self.policy, NetworkGaussian):
            return self.parameters.inside(network_mean.mean_rows(self.policy, features))
        return self.parameters.inside(features @ self.policy.coef)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a policy file, see `save`."""
        save(path, self)

    def _values(self, context: tuple[Any, ...], named: Mapping[str, Any]) -> tuple[Any, ...]:
        """Return the values of a context that was given by position, as one sequence, or by name."""
        if named:
            names = self.contexts.names
            if context or set(named) != set(names):
                raise UserError(f"values must be a number for each of {', '.join(names)}, got {named}")
            return tuple(named[name] for name in names)
        is_sequence = len(context) == 1 and np.ndim(context[0]) == 1 and not isinstance(context[0], str)
        return tuple(context[0]) if is_sequence else context


def linear_policy(learned: Learned, use: str) -> LinearGaussian:
    """Return the policy of a `Learned` for a use that needs one that is linear in features.

    Raises:
        ValueError: If it is a network.
    """
    if isinstance(learned.policy, LinearGaussian):
        return learned.policy
    raise UserError(f"policy must be linear in features to {use}, got a network")


def save(path: str | os.PathLike[str], learned: Learned) -> None:
    """Write a policy file, atomically.

    Args:
        path: The file, .npz.
        learned: The policy.

    Raises:
        ValueError: If its features are the user's own and have no name, the path is no .npz file, or the file
            cannot be written.
    """
    file = _checked_path(path)
    if file.suffix != ".npz":
        raise UserError(f"a policy file must be named .npz, got {file}")
    checks.instance("learned", learned, Learned)
    arrays = {
        "format": FORMAT,
        "version": VERSION if isinstance(learned.policy, LinearGaussian) else _NETWORK_VERSION,
        "coef": np.asarray(learned.policy.coef, np.float32),
        "cov_chol": np.asarray(learned.policy.cov_chol, np.float32),
        "features": json.dumps(feature_maps.describe(learned.features)),
        "constraint": learned.parameters.constraint,
        "task": json.dumps(dict(learned.task)),
    }
    if isinstance(learned.policy, NetworkGaussian):
        arrays["num_layers"] = len(learned.policy.layers)
        for index, layer in enumerate(learned.policy.layers):
            arrays |= {f"{name}_{index}": values for name, values in layer._asdict().items()}
    for name, ends, space in (
        ("context", "range", learned.contexts),
        ("param", "bounds", learned.parameters),
    ):
        arrays[f"{name}_names"], arrays[f"{name}_units"] = np.array(space.names), np.array(space.units)
        arrays[f"{name}_{ends}"] = np.array([space.low, space.high])
    save_arrays(file, arrays)


def load(path: str | os.PathLike[str], *, features: FeatureMap | None = None) -> Learned:
    """Read a policy file.

    Args:
        path: The file.
        features: Your own features, if the policy was learned with them.

    Raises:
        ValueError: If the file is missing, cut short, foreign or of another version, if its numbers make no
            policy (NaN, shapes that do not fit each other), or if your own features are needed.
    """
    file = _checked_path(path)
    arrays = load_arrays(file)
    if str(arrays.get("format")) != FORMAT:
        got = arrays.get("format", "no format")
        raise UserError(f"{file} must be a policy file of format {FORMAT!r}, got {got}")
    if str(arrays.get("version")) not in _READABLE:
        expected = " or ".join((", ".join(_READABLE[:-1]), _READABLE[-1]))
        got = arrays.get("version", "no version")
        raise UserError(f"{file} must be a policy file of version {expected}, got {got}")
    try:
        context_low, context_high = arrays["context_range"].tolist()
        param_low, param_high = arrays["param_bounds"].tolist()
        constraint = str(arrays["constraint"])
        constraint = CLIP if constraint == _CLIP_BEFORE else constraint
        return Learned(
            _policy(arrays),
            _features(json.loads(str(arrays["features"])), (context_low, context_high), features),
            _space(arrays, "context", context_low, context_high, CLIP),
            _space(arrays, "param", param_low, param_high, constraint),
            json.loads(str(arrays["task"])),
        )
    except KeyError as error:
        raise UserError(f"{file} is an incomplete policy file: it has no {error}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{file}: {error}") from error


def _policy(arrays: Mapping[str, np.ndarray]) -> LinearGaussian | NetworkGaussian:
    """Make the policy of a file: a network in a file of its version."""
    is_network = str(arrays["version"]) == str(_NETWORK_VERSION)
    layers = _layers(arrays, arrays["num_layers"]) if is_network else ()
    known = [f"{name}_{index}" for index in range(len(layers)) for name in Layer._fields]
    unknown = sorted({name for name in arrays if name.startswith(("weight_", "bias_"))}.difference(known))
    if unknown:
        raise ValueError(f"the arrays of layers must be {', '.join(known) or 'none'}, got {unknown[0]}")
    coef, cov_chol = jnp.asarray(arrays["coef"]), jnp.asarray(arrays["cov_chol"])
    return NetworkGaussian(layers, coef, cov_chol) if is_network else LinearGaussian(coef, cov_chol)


def _layers(arrays: Mapping[str, np.ndarray], num: np.ndarray) -> tuple[Layer, ...]:
    if num.shape != () or num.dtype.kind not in "iu" or num < 1:
        raise ValueError(f"num_layers must be a whole number of at least 1, got {num.tolist()}")
    names = ([f"{name}_{index}" for name in Layer._fields] for index in range(int(num)))
    return tuple(Layer(*(checks.array(name, arrays[name]) for name in each)) for each in names)


def _checked_policy(policy: Any, features: FeatureMap) -> LinearGaussian | NetworkGaussian:
    """Return a policy in one precision, after checking that it fits the features."""
    if isinstance(policy, LinearGaussian):
        return gaussian.checked("policy", policy, features)
    if not isinstance(features.apply, ScaledPolynomial):
        raise ValueError(
            "features of a network must be those of its network_policy, polynomials of the scaled context, "
            f"got {checks.shown(features)}"
        )
    return network_mean.checked("policy", policy, features)


def _space(
    arrays: Mapping[str, np.ndarray], name: str, low: list[float], high: list[float], constraint: str
) -> Space:
    names, units = (tuple(arrays[f"{name}_{field}"].tolist()) for field in ("names", "units"))
    return Space(names, tuple(low), tuple(high), units, constraint)


def _features(
    description: Any, context_range: tuple[list[float], list[float]], own: FeatureMap | None
) -> FeatureMap:
    """Make the features of a file; in version 2 they cover the range of the contexts."""
    if not isinstance(description, dict):
        raise ValueError(f"features must be described by an object, got {description!r}")
    if description.get("kind") == "rbf" and "low" not in description:
        return Features(**description).make(*context_range)
    if description.get("kind") == "linear" and "dim" not in description:
        return Features("linear").make(*context_range)
    return feature_maps.from_description(description, own)


def _checked_path(path: str | os.PathLike[str]) -> Path:
    if not isinstance(path, str | os.PathLike):
        raise UserError(f"path must be that of a file, got {checks.shown(path)}")
    return Path(path)
