"""Gather the numbers by which a policy turns a context into parameters, in single precision."""

from typing import NamedTuple

import numpy as np

from creps_jax.errors import UserError
from creps_jax.policies.features import rbf_grid
from creps_jax.policies.learned import SavedPolicy


class Formula(NamedTuple):
    """The numbers of a policy, all float32, for s context variables, p features and d parameters.

    Attributes:
        context_low: (s,) lower ends of the learned range.
        context_high: (s,) its upper ends.
        centers: (p, s) centres of the RBFs; none (0, s) if the features are linear.
        widths: (s,) their widths.
        coef: (p, d) coefficients of the features; linear ones are 1 and the context variables.
        param_low: (d,) lower bounds of the parameters.
        param_high: (d,) upper bounds.
    """

    context_low: np.ndarray
    context_high: np.ndarray
    centers: np.ndarray
    widths: np.ndarray
    coef: np.ndarray
    param_low: np.ndarray
    param_high: np.ndarray


def formula_of(policy: SavedPolicy) -> Formula:
    """Gather the numbers of a policy.

    Raises:
        UserError: if one is too large for single precision.
    """
    num_contexts = len(policy.context_names)
    centers, widths = np.zeros((0, num_contexts)), np.ones(num_contexts)
    if policy.features.kind == "rbf":
        settings = policy.features
        centers, widths = rbf_grid(
            policy.context_low, policy.context_high, settings.num_centers, bandwidth=settings.bandwidth
        )
    numbers = Formula(
        context_low=np.asarray(policy.context_low),
        context_high=np.asarray(policy.context_high),
        centers=centers,
        widths=widths,
        coef=policy.coef,
        param_low=np.asarray(policy.param_low),
        param_high=np.asarray(policy.param_high),
    )
    with np.errstate(over="ignore"):
        single = Formula(*(np.asarray(values, np.float32) for values in numbers))
    for name, values in single._asdict().items():
        if not np.isfinite(values).all():
            raise UserError(f"{name} of the policy is too large for single precision")
    return single
