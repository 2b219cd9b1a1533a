"""What a search is to those who run it: four functions, and no more."""

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
    """The state of a search: any pytree of arrays with the number of batches that it has been told."""

    @property
    def iteration(self) -> IntScalar:
        """How many batches have been told; zero after `init`."""
        ...


@dataclasses.dataclass(frozen=True)
class Search(KeepsPrograms):
    """A search as a record of pure functions, closed over and never traced.

    All of them may be jitted and vmapped; shapes are n samples, s context variables, d parameters. This is
    all that `creps_jax.train` knows of a search: one of your own needs no more.

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
        """Compiled programs that are made of this search, such as iterations."""
        return {}

    @property
    def traced(self) -> Any:
        """Settings that compiled programs take as an argument: another value compiles nothing anew."""
        return ()

    def with_traced(self, traced: Any) -> "Search":
        """Return the search with other values of these settings, which may be traced."""
        del traced
        return dataclasses.replace(self)
