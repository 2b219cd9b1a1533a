"""Contextual relative entropy policy search in JAX, and a humanoid that learns to walk with it.

The names, by subject, stand in `__init__.pyi`. Each is imported when it is first used: tools can then set up
the process before jax starts, and the walking task alone imports MuJoCo.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
