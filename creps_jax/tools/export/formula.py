"""The numbers with which a policy computes parameters from a context, in single precision."""

import itertools
from typing import NamedTuple

import jax
import numpy as np

from creps_jax.errors import UserError
from creps_jax.policies.feature_functions import Kernel, middle_and_half
from creps_jax.policies.features import describe, rbf_grid
from creps_jax.policies.learned import Learned
from creps_jax.policies.network_mean import Layer, NetworkGaussian


class Formula(NamedTuple):
    """The numbers of a policy, for s context variables, p features and d parameters.

    All but the kind and the exponents are float32.

    Attributes:
        kind: "linear", "polynomial", "rbf", "kernel" or "network".
        context_low: (s,) lower ends of the learned range.
        context_high: (s,) upper ends of the learned range.
        middle: (s,) subtracted from the context of polynomials, kernels and networks; 0 for others.
        half: (s,) by which the difference is divided; 1 for others.
        exponents: (p, s) int32 exponent of each scaled context variable in each linear or polynomial feature;
            (0, s) for others.
        centers: (p, s) centres of the RBFs; (p - 1, s) scaled inducing contexts of a kernel; (0, s) for
            others.
        widths: (s,) widths of the RBFs, or of the kernel over the scaled context.
        coef: (p, d) coefficients of the features; of a kernel, whose features are not whitened here, of the
            constant and of the covariance with each inducing context; of a network, of the constant and of
            the units of its last layer.
        param_low: (d,) lower bounds of the parameters.
        param_high: (d,) upper bounds.
        layers: the layers of a network, from the scaled context on.
    """

    kind: str
    context_low: np.ndarray
    context_high: np.ndarray
    middle: np.ndarray
    half: np.ndarray
    exponents: np.ndarray
    centers: np.ndarray
    widths: np.ndarray
    coef: np.ndarray
    param_low: np.ndarray
    param_high: np.ndarray
    layers: tuple[Layer, ...] = ()


def formula_of(learned: Learned) -> Formula:
    """Return the numbers of a policy, a network or one of linear features, polynomials, RBFs or a kernel.

    Raises:
        UserError: if its features cannot be exported, or a number is too large for single precision.
    """
    coef, layers = np.asarray(learned.policy.coef), ()
    num_contexts = learned.contexts.size
    middle, half = np.zeros(num_contexts), np.ones(num_contexts)
    exponents = np.zeros((0, num_contexts), np.int32)
    centers, widths = np.zeros((0, num_contexts)), np.ones(num_contexts)
    features = describe(learned.features)
    kind = features.pop("kind")
    if isinstance(learned.policy, NetworkGaussian):
        middle, half = middle_and_half(features["low"], features["high"])
        kind, layers = "network", jax.tree.map(np.asarray, learned.policy.layers)
    elif kind == "rbf":
        centers, widths = rbf_grid(
            features["low"], features["high"], features["num_centers"], bandwidth=features["width"]
        )
    elif kind == "kernel":
        kernel = Kernel(**features)
        # The coefficients are large: contexts far from zero would lose too many digits.
        middle, half = middle_and_half(kernel.low, kernel.high)
        centers = (kernel.inducing() - middle) / half
        widths = np.asarray(kernel.bandwidth) / half
        coef = np.concatenate([coef[:1], kernel.inverse_root() @ coef[1:]])
    elif kind in ("linear", "polynomial", "scaled polynomial"):
        if kind == "scaled polynomial":
            middle, half = middle_and_half(features["low"], features["high"])
            kind = "polynomial"
        exponents = _exponents(num_contexts, features.get("degree", 1))
    else:
        raise UserError(f"features must be linear, polynomial, rbf or kernel to be exported, got {kind}")
    if not np.isfinite([learned.contexts.low, learned.contexts.high]).all():
        raise UserError(f"contexts must have a range to be exported, got {learned.contexts}")
    numbers = Formula(
        kind=kind,
        context_low=np.asarray(learned.contexts.low),
        context_high=np.asarray(learned.contexts.high),
        middle=middle,
        half=half,
        exponents=exponents,
        centers=centers,
        widths=widths,
        coef=coef,
        param_low=np.asarray(learned.parameters.low),
        param_high=np.asarray(learned.parameters.high),
        layers=layers,
    )
    return _in_single_precision(numbers)


def _in_single_precision(numbers: Formula) -> Formula:
    # A `Learned` has its layers in single precision.
    kept = ("kind", "exponents", "layers")
    arrays = {name: values for name, values in numbers._asdict().items() if name not in kept}
    with np.errstate(over="ignore"):
        single = {name: np.asarray(values, np.float32) for name, values in arrays.items()}
    for name, values in single.items():
        # Parameters without bounds have infinite bounds.
        is_held = np.isfinite(values) | (np.isinf(arrays[name]) & name.startswith("param"))
        if not is_held.all():
            raise UserError(f"{name} of the policy is too large for single precision")
    return numbers._replace(**single)


def _exponents(dim: int, degree: int) -> np.ndarray:
    """Return the exponent of each context variable in each of the linear or polynomial features."""
    rows = []
    for each in range(degree + 1):
        for variables in itertools.combinations_with_replacement(range(dim), each):
            rows.append([variables.count(variable) for variable in range(dim)])
    return np.array(rows, np.int32)
