"""Test that the notebooks of docs/notebooks run, and that stored outputs are complete and small."""

from __future__ import annotations

import ast
import re
from importlib import import_module

import nbformat
import pytest

from tests.helpers.notebooks import NOTEBOOKS, cell_outputs, execute_notebook
from tests.helpers.paths import ROOT

EVERY_NOTEBOOK = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
MOST_BYTES = 300_000
SHORT = "episodes=2, steps=20)"
SMALLER = {"STEPS = 1200": "STEPS = 30", "episodes=10)": SHORT, "episodes=20)": SHORT, "--episodes 20": "--episodes 2"}
"""Text of notebooks -> text that takes less time."""


def test_all_expected_notebooks_exist():
    assert {path.stem for path in NOTEBOOKS} == {"explore", "train_ad_pytorch", "own_agent_and_teammate"}


@EVERY_NOTEBOOK
def test_stored_outputs_are_complete_and_small(path):
    """All code cells ran in order without errors, pictures are stored, and no path of this machine is shown."""
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    found = list(cell_outputs(notebook))
    assert not [output for output in found if output.output_type == "error"]
    assert re.search("image/(png|gif)", str([output.get("data") for output in found]))
    text = path.read_text(encoding="utf-8")
    assert len(text) < MOST_BYTES
    assert str(ROOT) not in text


@EVERY_NOTEBOOK
def test_files_linked_from_notebooks_exist(path):
    text = "\n".join(cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "markdown")
    for target in re.findall(r"\]\((.*?)\)", text):
        assert (path.parent / target).is_file(), target


@EVERY_NOTEBOOK
def test_names_that_notebooks_import_exist(path):
    cells = [cell.source for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    code = "\n".join(line for text in cells if text[:2] != "%%" for line in text.splitlines() if line[:1] not in "%!")
    imports = [node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.ImportFrom)]
    own = [
        (node.module, alias.name) for node in imports for alias in node.names if str(node.module).startswith("icrl4aht")
    ]
    assert own
    for module, name in own:
        assert hasattr(import_module(str(module)), name), f"{module} has no {name}"


@pytest.mark.slow
@EVERY_NOTEBOOK
def test_notebook_runs_without_errors(path, tmp_path):
    executed, stored = execute_notebook(path, tmp_path, SMALLER), nbformat.read(path, as_version=4)
    assert len(executed.cells) == len(stored.cells)
    assert [bool(cell.get("outputs")) for cell in executed.cells] == [
        bool(cell.get("outputs")) for cell in stored.cells
    ]
