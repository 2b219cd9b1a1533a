"""Records that keep compiled programs beside their fields."""

import dataclasses
from typing import Any

__all__ = ["KeepsPrograms"]


class KeepsPrograms:
    """A dataclass whose compiled programs, in cached properties, are not pickled with its fields."""

    def __getstate__(self: Any) -> dict[str, Any]:
        """Return the fields alone: programs are compiled anew where they are needed."""
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
