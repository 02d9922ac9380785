"""The examples of docs/models.md run in their order, and print what the page shows."""

from __future__ import annotations

import pathlib
import re
import shutil

import jax

ROOT = pathlib.Path(__file__).parents[2]


def test_the_examples_run_and_print_what_the_page_shows(tmp_path, monkeypatch, capsys):
    shutil.copytree(ROOT / "examples" / "ur5", tmp_path / "examples" / "ur5")
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "models.md").read_text()
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        with jax.numpy_rank_promotion("allow"):  # as it is for a reader
            exec(compile(block, "docs/models.md", "exec"), names)
    (printed,) = re.findall(r"```text\n(.*?)```", page, re.DOTALL)
    assert capsys.readouterr().out == printed
