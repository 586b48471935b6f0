"""Execute the notebooks of docs/notebooks. `python -m tests.helpers.notebooks [NAME...]` stores their outputs."""

from __future__ import annotations

import base64
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

from icrl4aht_baselines.plotting import shrink_picture

from tests.helpers.paths import ROOT

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def execute_notebook(path: Path, folder: Path, changes: Mapping[str, str] | None = None) -> Any:
    """Execute a notebook in a new kernel and return the notebook with its outputs.

    Args:
        path: path of the notebook.
        folder: working folder of the kernel.
        changes: replacements in the cells' code, old text -> new text.

    Raises:
        CellExecutionError: if a cell fails.
    """
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        for old, new in (changes or {}).items():
            cell.source = cell.source.replace(old, new)
    variables = {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    with mock.patch.dict(os.environ, variables):
        resources = {"metadata": {"path": str(folder)}}
        client = NotebookClient(
            notebook, timeout=1800, kernel_name="python3", coalesce_streams=True, resources=resources
        )
        return client.execute()


def cell_outputs(notebook: Any) -> Iterator[Any]:
    """Yield the outputs of all cells of a notebook."""
    for cell in notebook.cells:
        yield from cell.get("outputs", ())


def store_outputs(path: Path) -> None:
    """Execute a notebook and store its outputs; remove times, and replace this machine's paths by neutral paths."""
    import nbformat

    with tempfile.TemporaryDirectory() as folder:
        notebook = execute_notebook(path, Path(folder))
    text = re.sub(r"(?<=data:image/png;base64,)[\w+/=]+", _shrink_image, nbformat.writes(_remove_times(notebook)))
    for found, shown in ((str(ROOT), "/home/you/icrl4aht-data"), (folder, "/home/you/work")):
        text = text.replace(found, shown)
    path.write_text(text + "\n", encoding="utf-8")
    print(f"wrote {path}: {path.stat().st_size // 1000} kB")


def _shrink_image(picture: re.Match[str]) -> str:
    """Reduce a base64-encoded PNG image to 64 colours."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        path.write_bytes(base64.b64decode(picture[0]))
        shrink_picture(path, path)
        return base64.b64encode(path.read_bytes()).decode()


def _remove_times(notebook: Any) -> Any:
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number:02}"
        cell["metadata"] = {}
    for output in cell_outputs(notebook):
        output.get("metadata", {}).clear()
        if output["output_type"] == "stream":
            output["text"] = re.sub(r"\x1b\[[0-9;]*m", "", output["text"])  # remove colour codes
    notebook["metadata"] = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    return notebook


if __name__ == "__main__":
    for each in NOTEBOOKS:
        if each.stem in sys.argv[1:] or len(sys.argv) == 1:
            store_outputs(each)
