"""Say how Sphinx builds the documents; `-D nb_execution_mode=off` spares the minutes that notebooks take."""

import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent)]

from creps_jax.tools.process import import_mjx_quietly, prepare  # noqa: E402

prepare()
import_mjx_quietly()

# Sphinx reads nothing outside its folder.
notebooks = DOCS / "notebooks"
if not notebooks.is_symlink():
    notebooks.symlink_to("../notebooks")

project = "creps_jax"
copyright = "the creps_jax authors"
extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "as_written",
]
# MyST-NB puts what notebooks show beside the folder of the pages.
exclude_patterns = ["_build", "jupyter_execute"]
# Dashes, but no curly quotes: "phi' w" is mathematics.
smartquotes_action = "D"

# What docstrings have in backticks is code, with a link where it is the name of something.
default_role = "py:obj"
napoleon_custom_sections = [("Attributes", "params_style")]
maximum_signature_line_length = 88
# Every type of ours in a signature has to be on the page.
nitpicky = True
nitpick_ignore_regex = [
    ("py:obj", ".*"),
    ("py:class", r"(collections|jax|jaxlib|os|jaxtyping|mujoco|np)\..+"),
    ("py:class", "Array|ArrayLike|Bool|Bounds|Features|Float|Int|Key|Path|Rewards|UInt32|ndarray"),
]

myst_enable_extensions = ["dollarmath"]
nb_execution_mode = "force"
nb_execution_raise_on_error = True
nb_execution_timeout = 600
nb_merge_streams = True
# A notebook that complains fails the build.
nb_output_stderr = "error"

html_theme = "furo"
html_title = "creps_jax"
html_static_path = ["static"]
html_css_files = ["wrap.css"]
copybutton_prompt_text = r">>> |\.\.\. "
copybutton_prompt_is_regexp = True
