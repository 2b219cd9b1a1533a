"""Contextual relative entropy policy search in JAX, and a humanoid that learns to walk with it.

The names, by subject, stand in `__init__.pyi`. Each is imported when it is first used: tools can then set up
the process before jax starts, and the walking task alone imports MuJoCo.
"""

from typing import Any

import lazy_loader

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from creps_jax.files import package_version

        return package_version()
    return _find(name)
