"""Name the array types used throughout the library.

Shapes are written in the annotation of each function (`Float[Array, "n d"]`, see jaxtyping); this module
holds the few aliases that many modules share.
"""

from typing import TypeAlias

import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int, Key, Num, UInt32

__all__ = [
    "Array",
    "Bool",
    "Float",
    "Int",
    "IntScalar",
    "Num",
    "PRNGKey",
    "Scalar",
    "ScalarLike",
    "VectorLike",
]

Scalar: TypeAlias = Float[Array, ""]
"""A floating-point array without axes."""

IntScalar: TypeAlias = Int[Array, ""]
"""An integer array without axes: counts and indices that live in a state."""

ScalarLike: TypeAlias = float | int | np.floating | np.integer | Float[Array, ""] | Float[np.ndarray, ""]
"""A number as a user writes it: a Python or NumPy number, or an array without axes."""

VectorLike: TypeAlias = (
    ScalarLike | tuple[float | int, ...] | list[float | int] | Float[Array, " k"] | Float[np.ndarray, " k"]
)
"""A number, a sequence of numbers or a vector: bounds and other settings, given outside of any trace."""

PRNGKey: TypeAlias = Key[Array, ""] | UInt32[Array, " _"]
"""A random key, new style (`jax.random.key`) or old style (`jax.random.PRNGKey`), of any implementation."""
