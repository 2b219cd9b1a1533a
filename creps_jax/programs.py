"""A base class for records that keep compiled programs."""

import dataclasses
from typing import Any

__all__ = ["KeepsPrograms"]


class KeepsPrograms:
    """Base class of dataclasses that keep compiled programs in cached properties, which are not pickled."""

    def __getstate__(self: Any) -> dict[str, Any]:
        """Return the fields only; an unpickled record compiles its programs again."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
