"""The interface between a search and `creps_jax.train`: a record of four functions."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from jax.typing import ArrayLike

from creps_jax import checks
from creps_jax.programs import KeepsPrograms
from creps_jax.search.archive import Batch
from creps_jax.typing import Array, IntScalar, PRNGKey

__all__ = ["Search", "SearchState"]


@runtime_checkable
class SearchState(Protocol):
    """The state of a search: any pytree of arrays with the number of batches told so far."""

    @property
    def iteration(self) -> IntScalar:
        """Number of batches told so far; zero after `init`."""
        ...


@dataclasses.dataclass(frozen=True)
class Search(KeepsPrograms):
    """A search as a record of pure functions, closed over and never traced.

    All of them can be jitted and vmapped. Shapes: n samples, s context variables, d parameters.
    `creps_jax.train` uses only these functions, so that it runs any search that has them.

    Attributes:
        init: (policy) -> state, a `SearchState`.
        ask: (key, state, contexts (n, s)) -> thetas (n, d) to try.
        tell: (state, batch) -> (state, info): learn from a `Batch`; info is any pytree of arrays.
        policy: (state) -> the current policy.
    """

    init: Callable[[Any], Any]
    ask: Callable[[PRNGKey, Any, ArrayLike], Array]
    tell: Callable[[Any, Batch], tuple[Any, Any]]
    policy: Callable[[Any], Any]

    def __post_init__(self) -> None:
        """Check the functions."""
        for name, arguments in (
            ("init", "(policy)"),
            ("ask", "(key, state, contexts)"),
            ("tell", "(state, batch)"),
            ("policy", "(state)"),
        ):
            checks.function(name, getattr(self, name), arguments)

    @functools.cached_property
    def programs(self) -> dict[Any, Any]:
        """Compiled programs that contain this search, such as iterations."""
        return {}

    @property
    def traced(self) -> Any:
        """Settings that are arguments of compiled programs: another value compiles nothing anew."""
        return ()

    def with_traced(self, traced: Any) -> "Search":
        """Return the search with other values of these settings, traced ones included."""
        del traced
        return dataclasses.replace(self)
