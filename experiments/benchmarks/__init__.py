"""Benchmarks that compare alternatives in one run, since absolute times drift.

Importing the package sets the process up for jax, as the command line does: jax reads the environment when it
is imported.
"""

from creps_jax.tools.process import import_mjx_quietly, prepare

prepare()
import_mjx_quietly()
