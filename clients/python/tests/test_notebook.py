"""The notebook runs from its first cell to its last, and is kept without what it showed."""

from __future__ import annotations

import os
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from served import ROOT

NOTEBOOK = ROOT / "clients/python/examples/first_question.ipynb"


def test_the_notebook_is_kept_without_outputs() -> None:
    for cell in nbformat.read(NOTEBOOK, as_version=4).cells:
        assert not cell.get("outputs"), f"strip the notebook's outputs: {cell.source}"
        assert cell.get("execution_count") is None


@pytest.mark.usefixtures("scene")
def test_the_notebook_ends_with_pictures_and_a_table(tmp_path: Path) -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    for cell in notebook.cells:
        # The tests' own environment is what `pip install` makes; making it again takes long.
        if cell.source.startswith("%pip"):
            cell.source = ""
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(NOTEBOOK.parent)}}).execute()
    if folder := os.environ.get("UNIGROUND_NOTEBOOK_OUT"):
        nbformat.write(notebook, Path(folder) / NOTEBOOK.name)
    shown = [output.data for cell in notebook.cells for output in cell.get("outputs", []) if "data" in output]
    # Two photographs as they come, and the floor, which Pillow shows as both.
    assert [sorted(kind for kind in data if kind.startswith("image/")) for data in shown if "image/jpeg" in data] == [
        ["image/jpeg"],
        ["image/jpeg"],
        ["image/jpeg", "image/png"],
    ]
    assert "spaceship" in shown[-1]["text/html"]
