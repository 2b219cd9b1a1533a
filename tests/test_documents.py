"""Run the code and the commands of README.md and docs/, and the notebooks from top to bottom."""

import doctest
import importlib.util
import os
import re
import runpy
import shlex
import shutil
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

import creps_jax
from creps_jax.files import policies_folder
from creps_jax.tools import cli
from experiments import registry

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
# `.ci/run` builds the pages of docs/, which executes the others; they take too long to be run here each time.
QUICK = ("first_policy", "first_walk")


PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    "experiments/DEVIATIONS.md",
    *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))),
]


def blocks(page: str, language: str) -> list[str]:
    """Return the fenced blocks of a page in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE)


def test_the_description_of_a_humanoid_is_that_of_the_checkout():
    description = (ROOT / "models" / "humanoids" / "k1.toml").read_text()
    assert blocks("docs/humanoids.md", "toml") == [description]


WITH_PYTHON = [page for page in PAGES if blocks(page, "python")]
NOT_INSTALLED = ("tensorboardX", "wandb")
"""Packages that pages use and the tests do not need: without them, their blocks are skipped."""


def test_pages_have_python():
    assert {"README.md", "docs/choosing.md", "docs/export.md", "docs/logging.md", "docs/tasks.md"} <= set(
        WITH_PYTHON
    )
    assert "\n>>> " in (ROOT / "README.md").read_text()


@pytest.mark.parametrize("page", WITH_PYTHON)
def test_python_of_a_page_runs(page, tmp_path, monkeypatch):
    """Run the blocks of a page one after the other; a block of `>>>` lines prints what it says."""
    monkeypatch.chdir(tmp_path)
    names, missing = {"__name__": "page"}, []
    for test in re.findall(r"literalinclude\} \.\./(tests/\S+\.py)", (ROOT / page).read_text()):
        names |= runpy.run_path(str(ROOT / test))  # The page shows code of this test, and uses it.
    for number, block in enumerate(blocks(page, "python"), start=1):
        if block.startswith(">>>"):
            example = doctest.DocTestParser().get_doctest(block, {}, f"{page}, block {number}", page, 0)
            example.globs = names
            assert doctest.DocTestRunner().run(example, clear_globs=False).failed == 0
            continue
        try:
            exec(compile(block, f"{page}, block {number}", "exec"), names)
        except ModuleNotFoundError as error:
            if error.name not in NOT_INSTALLED:
                raise
            missing.append(f"block {number} needs {error.name}")
    if missing:
        pytest.skip(f"all other blocks ran; {', '.join(missing)}")


@pytest.mark.parametrize("page", ["docs/export.md", "docs/session.md"])
def test_commands_of_a_page_run(page, tmp_path, monkeypatch):
    """Run the commands `creps-jax` of a page one after the other, with the JSON and the policy they read."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(policies_folder() / "walk.npz", "policy.npz")
    for block in blocks(page, "json"):
        Path("arm.json").write_text(block)
    commands = re.findall(r"^creps-jax .*$", "".join(blocks(page, "sh")), re.MULTILINE)
    assert commands
    for command in commands:
        assert cli.main(shlex.split(command, comments=True)[1:]) == 0, command


@pytest.mark.parametrize("page", PAGES)
def test_experiments_that_a_page_names_are_there(page):
    text = (ROOT / page).read_text()
    modules = re.findall(r"python -m ((?:experiments|creps_jax)[\w.]*)", text)
    assert not [module for module in modules if importlib.util.find_spec(module) is None]
    for name, preset in re.findall(r"(?:experiments|\.\.\.|`) ?run ([a-z]\w+)(?: --preset (\w+))?", text):
        if name != registry.ALL:
            assert not preset or preset in registry.EXPERIMENTS[name].presets, f"{name} {preset}"


@pytest.mark.parametrize("page", PAGES)
def test_no_number_was_left_to_be_filled_in(page):
    text = re.sub(r"`[^`]*`|```.*?```", "", (ROOT / page).read_text(), flags=re.DOTALL)
    assert not re.findall(r"\b[A-Z]{3,}_[A-Z]+\b|\bTODO\b|\bTBD\b|\bFIG[0-9]+\b|\bFITS\b", text)


@pytest.mark.parametrize("page", PAGES)
def test_files_that_a_page_names_are_there(page):
    text = (ROOT / page).read_text()
    folders = (ROOT, ROOT / "creps_jax")
    named = re.findall(r"`([a-z_]+/[\w/]+\.(?:py|md))`", text)
    assert not [name for name in named if not any((folder / name).is_file() for folder in folders)]
    links = re.findall(r"\]\(([^)#:\s]+)\)", text)
    assert not [link for link in links if not ((ROOT / page).parent / link).exists()]


def test_changelog_citation_and_package_have_one_version():
    citation, changelog = (ROOT / "CITATION.cff").read_text(), (ROOT / "CHANGELOG.md").read_text()
    cited = re.findall(r"^(?:version|date-released): (\S+)$", citation, re.MULTILINE)
    released = re.findall(r"^## \[(\d+\.\d+\.\d+)\] - (\d{4}-\d\d-\d\d)$", changelog, re.MULTILINE)
    assert tuple(cited) == released[0] and released[0][0] == creps_jax.__version__


def test_the_page_of_equations_says_where_they_are():
    spec = importlib.util.spec_from_file_location("equations", ROOT / "docs" / "equations.py")
    equations = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(equations)
    computed = {number for number, places in equations.tagged().items() if places}
    assert computed == set(range(1, 19)) - equations.NOT_COMPUTED.keys()
    assert equations.PAGE.read_text() == equations.page(), "write it anew: python docs/equations.py"


def test_there_are_notebooks():
    assert NOTEBOOKS


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=() if path.stem in QUICK else pytest.mark.slow)
        for path in NOTEBOOKS
    ],
)
def test_notebook_runs(path, monkeypatch, tmp_path):
    monkeypatch.setitem(os.environ, "FIRST_WALK_SECONDS", "3")
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(path.parent)}}).execute()

    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    complaints = [output.text for output in outputs if output.get("name") == "stderr"]
    assert not complaints
    figures = [output.data for output in outputs if "<Figure" in output.get("data", {}).get("text/plain", "")]
    assert figures
    # A figure that Jupyter was not told to draw is shown as its name.
    assert all("image/png" in data for data in figures)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_has_no_outputs_and_is_paired(path):
    notebook = nbformat.read(path, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    paired = jupytext.read(path.with_suffix(".py"))
    assert [cell.source for cell in paired.cells] == [cell.source for cell in notebook.cells]
