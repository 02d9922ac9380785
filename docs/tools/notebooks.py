"""The three pages of docs/start as notebooks that were run: ``examples/*.ipynb``.

``python docs/tools/notebooks.py`` makes and executes them; it needs the extra docs.
"""

from __future__ import annotations

import os
import pathlib
import re
import sys
import tempfile

import nbformat
from nbclient import NotebookClient

ROOT = pathlib.Path(__file__).parents[2]
DOORS = {"table": "candidates", "arm": "arm", "device": "device"}  # notebook: page


def made(name: str) -> nbformat.NotebookNode:
    """A page as cells that were not run; commands of the shell begin with ``!``."""
    text = (ROOT / "docs" / "start" / f"{DOORS[name]}.md").read_text(encoding="utf-8")
    pieces = re.split(r"^```(\w+)\n(.*?)^```\n", text, flags=re.M | re.S)
    v4 = nbformat.v4
    cells = [v4.new_markdown_cell(_plain(pieces[0]))]
    for language, code, words in zip(*(pieces[i::3] for i in (1, 2, 3)), strict=True):
        lines = code.rstrip().splitlines()
        if language == "bash":
            lines = [f"!{line}" for line in lines]
        elif language == "text":  # what was printed; a command follows a dollar
            lines = [f"!{line[2:]}" for line in lines if line.startswith("$ ")]
        if lines:
            cells.append(v4.new_code_cell("\n".join(lines)))
        if words.strip():
            cells.append(v4.new_markdown_cell(_plain(words)))
    for number, cell in enumerate(cells):
        cell["id"] = f"{name}-{number}"
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return v4.new_notebook(cells=cells, metadata={"kernelspec": kernel})


def _plain(text: str) -> str:
    """Links to other pages lead from examples/ into docs/."""
    text = re.sub(r"\]\(\.\./examples/", "](", text.strip())
    return re.sub(r"\]\(\.\./", "](../docs/", text)


def executed(name: str, folder: str) -> nbformat.NotebookNode:
    """The notebook after a run in ``folder``; an error of a cell is raised."""
    notebook = made(name)
    scripts = str(pathlib.Path(sys.executable).parent)
    os.environ["PATH"] = scripts + os.pathsep + os.environ["PATH"]
    client = NotebookClient(
        notebook,
        timeout=300,
        coalesce_streams=True,
        resources={"metadata": {"path": folder}},
    )
    client.execute()
    for cell in notebook.cells:
        cell["metadata"].pop("execution", None)  # times
    return notebook


if __name__ == "__main__":
    for each in DOORS:
        with tempfile.TemporaryDirectory() as place:
            nbformat.write(executed(each, place), ROOT / "examples" / f"{each}.ipynb")
