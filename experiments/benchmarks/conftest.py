"""Compile anew: the cache of compiled programs would hide the time that it takes."""

import jax

jax.config.update("jax_enable_compilation_cache", False)
