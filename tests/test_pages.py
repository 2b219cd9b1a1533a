"""The pages in docs/ name everything public and include only what is there; `.ci/run` builds them."""

import importlib
import inspect
import re
from pathlib import Path

import pytest
from sphinx.pycode import ModuleAnalyzer

import creps_jax

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
API = (ROOT / "docs" / "api.md").read_text()
NAMED = set(re.findall(r"^\.\. auto(?:class|data|function):: (\S+)$", API, re.MULTILINE))
NAMED_LAST = {name.rpartition(".")[2] for name in NAMED}
MODULES = sorted(re.findall(r"^\.\. automodule:: (\S+)$", API, re.MULTILINE))
PUBLIC_MODULES = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for package in ("robots", "simulation", "tasks", "walking")
    for path in (ROOT / "creps_jax" / package).rglob("[a-z]*.py")
)


def test_api_page_has_every_name_of_the_package():
    names = {
        f"creps_jax.{name}" for name in creps_jax.__all__ if not inspect.ismodule(getattr(creps_jax, name))
    }
    assert names - NAMED == set()


@pytest.mark.parametrize("module", PUBLIC_MODULES)
def test_api_page_has_every_name_of_the_module(module):
    names = set(importlib.import_module(module).__all__)
    assert module in MODULES or names - NAMED_LAST == set()


def test_names_that_modules_leave_out_stand_by_themselves():
    left_out = ", ".join(re.findall(r"^ +:exclude-members: (.*)$", API, re.MULTILINE)).split(", ")
    assert set(left_out) - NAMED_LAST == set()


@pytest.mark.parametrize("module", MODULES)
def test_constants_have_docstrings_or_the_api_page_would_leave_them_out(module):
    contents = vars(importlib.import_module(module))
    documented = {name for _, name in ModuleAnalyzer.for_module(module).find_attr_docs()}
    objects = {name: contents[name] for name in contents["__all__"]}
    constants = {name for name, it in objects.items() if not (inspect.isfunction(it) or inspect.isclass(it))}
    assert constants - documented == set()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page_includes_what_is_there(page):
    include = re.compile(r"^```\{(?:literal)?include\} (\S+)\n((?::.*\n)*)", re.MULTILINE)
    for file, options in include.findall(page.read_text()):
        text = (page.parent / file).read_text()
        for marker in re.findall(r"^:(?:start-after|end-before): (.*)$", options, re.MULTILINE):
            assert marker.strip("\"'") in text
