"""What the documents say runs: the README's example, and the notebooks from top to bottom."""

import doctest
import importlib.util
import os
import re
from pathlib import Path

import jupytext
import nbformat
import pytest
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
# `.ci/run` builds the pages of docs/, which executes the others; they take too long to be run here each time.
QUICK = ("first_policy", "first_walk")


def test_readme_example_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.testfile(str(ROOT / "README.md"), module_relative=False)
    assert failed == 0
    assert tried >= 10


PAGES = [
    "README.md",
    "CONTRIBUTING.md",
    "experiments/DEVIATIONS.md",
    *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md"))),
]


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
