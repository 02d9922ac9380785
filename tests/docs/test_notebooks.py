"""The notebooks are the pages of docs/start, and they run."""

from __future__ import annotations

import importlib
import pathlib
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[2]
NAMES = ("table", "arm", "device")


@pytest.fixture(scope="module")
def notebooks():
    pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    sys.path.insert(0, str(ROOT / "docs" / "tools"))
    return importlib.import_module("notebooks")


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_its_page(notebooks, name):
    kept = notebooks.nbformat.read(ROOT / "examples" / f"{name}.ipynb", as_version=4)
    notebooks.nbformat.validate(kept)
    wanted = [(cell.cell_type, cell.source) for cell in notebooks.made(name).cells]
    assert [(cell.cell_type, cell.source) for cell in kept.cells] == wanted
    for cell in kept.cells:
        if cell.cell_type == "code":
            assert cell.execution_count
            assert not any(out.output_type == "error" for out in cell.outputs)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs(notebooks, name, tmp_path):
    notebook = notebooks.executed(name, str(tmp_path))
    printed = "".join(
        out.get("text", "")
        for cell in notebook.cells
        for out in cell.get("outputs", ())
    )
    wanted = {"table": "proven optimal", "arm": "mm after", "device": "held-out error"}
    assert wanted[name] in printed
