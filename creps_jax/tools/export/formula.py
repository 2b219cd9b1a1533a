"""The numbers with which a policy computes parameters from a context, in single precision."""

import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from creps_jax.errors import UserError
from creps_jax.policies.features import describe, rbf_grid
from creps_jax.policies.learned import Learned


class Formula(NamedTuple):
    """The numbers of a policy, for s context variables, p features and d parameters.

    All but the exponents are float32.

    Attributes:
        context_low: (s,) lower ends of the learned range.
        context_high: (s,) upper ends of the learned range.
        exponents: (p, s) int32 exponent of each context variable in each linear or polynomial feature; (0, s)
            for RBFs.
        centers: (p, s) centres of the RBFs; (0, s) if the features are linear or polynomial.
        widths: (s,) widths of the RBFs.
        coef: (p, d) coefficients of the features.
        param_low: (d,) lower bounds of the parameters.
        param_high: (d,) upper bounds.
    """

    context_low: np.ndarray
    context_high: np.ndarray
    exponents: np.ndarray
    centers: np.ndarray
    widths: np.ndarray
    coef: np.ndarray
    param_low: np.ndarray
    param_high: np.ndarray


def formula_of(learned: Learned) -> Formula:
    """Return the numbers of a policy, whose features must be linear, polynomial or RBFs.

    Raises:
        UserError: if its features cannot be exported, or a number is too large for single precision.
    """
    num_contexts = learned.contexts.size
    exponents = np.zeros((0, num_contexts), np.int32)
    centers, widths = np.zeros((0, num_contexts)), np.ones(num_contexts)
    features = describe(learned.features)
    if features["kind"] == "rbf":
        centers, widths = rbf_grid(
            features["low"], features["high"], features["num_centers"], bandwidth=features["width"]
        )
    elif features["kind"] in ("linear", "polynomial"):
        exponents = _exponents(features)
    else:
        raise UserError(f"features must be linear, polynomial or rbf to be exported, got {features['kind']}")
    if not np.isfinite([learned.contexts.low, learned.contexts.high]).all():
        raise UserError(f"contexts must have a range to be exported, got {learned.contexts}")
    numbers = Formula(
        context_low=np.asarray(learned.contexts.low),
        context_high=np.asarray(learned.contexts.high),
        exponents=exponents,
        centers=centers,
        widths=widths,
        coef=np.asarray(learned.policy.coef),
        param_low=np.asarray(learned.parameters.low),
        param_high=np.asarray(learned.parameters.high),
    )
    with np.errstate(over="ignore"):
        single = Formula(*(np.asarray(values, np.float32) for values in numbers))
    single = single._replace(exponents=exponents)
    for name, values in single._asdict().items():
        # Parameters without bounds have infinite bounds.
        is_held = np.isfinite(values) | (np.isinf(getattr(numbers, name)) & name.startswith("param"))
        if not is_held.all():
            raise UserError(f"{name} of the policy is too large for single precision")
    return single


def _exponents(features: Mapping[str, Any]) -> np.ndarray:
    """Return the exponent of each context variable in each of the linear or polynomial features."""
    dim, degree = features["dim"], features.get("degree", 1)
    rows = []
    for each in range(degree + 1):
        for variables in itertools.combinations_with_replacement(range(dim), each):
            rows.append([variables.count(variable) for variable in range(dim)])
    return np.array(rows, np.int32)
