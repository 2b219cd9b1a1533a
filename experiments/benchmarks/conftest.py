"""Set the process up as the command line does, but without the cache of compiled programs."""

import os

from creps_jax.tools.process import prepare

os.environ["JAX_COMPILATION_CACHE_DIR"] = ""
prepare()
