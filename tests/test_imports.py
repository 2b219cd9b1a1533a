"""Hold the imports to the layers that pyproject.toml declares."""

import contextlib
import inspect
import io
import pkgutil
from pathlib import Path

from importlinter.cli import lint_imports

import creps_jax

ROOT = Path(__file__).parents[1]


def test_imports_keep_their_contracts():
    report = io.StringIO()
    with contextlib.redirect_stdout(report):
        status = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)
    assert status == 0, report.getvalue()


def test_no_module_has_the_name_of_something_public():
    # The one would hide the other, depending on which is imported first.
    modules = {module.name for module in pkgutil.walk_packages(creps_jax.__path__, "creps_jax.")}
    packages = (creps_jax, creps_jax.tasks)
    names = {
        f"{package.__name__}.{name}": getattr(package, name)
        for package in packages
        for name in package.__all__
    }
    assert not [name for name, value in names.items() if name in modules and not inspect.ismodule(value)]
