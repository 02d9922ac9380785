"""What is printed to be typed can be typed: this Python, this checkout, these paths."""

from __future__ import annotations

import json
import pathlib
import shlex
import shutil
import subprocess
import sys

import pytest

from jaxcal import extras
from jaxcal.arguments import typed_line

ROOT = pathlib.Path(__file__).parents[1]


@pytest.mark.parametrize("folder", [".", "tests", "/"])
@pytest.mark.parametrize("on_path", [True, False])
def test_what_installs_an_extra_names_this_python_and_this_checkout(
    monkeypatch, folder, on_path
):
    bin_folder = pathlib.Path(sys.executable).parent
    monkeypatch.setenv("PATH", f"{bin_folder}:/usr/bin" if on_path else "/usr/bin")
    monkeypatch.chdir(ROOT / folder)
    python, *words = shlex.split(extras.install("rig"))
    code = "import sys, jaxcal; print(sys.prefix)"
    run = subprocess.run(
        [python, "-c", code], capture_output=True, text=True, check=True
    )
    assert pathlib.Path(run.stdout.strip()).samefile(sys.prefix)
    assert (python == "python") == on_path
    assert words[:3] == ["-m", "pip", "install"]
    source = words[-1].removesuffix("[rig]")
    assert (pathlib.Path(source) / "pyproject.toml").samefile(ROOT / "pyproject.toml")


def test_an_installed_jaxcal_names_where_it_came_from(monkeypatch, tmp_path):
    class Distribution:
        def __init__(self, origin):
            self.origin = origin

        def read_text(self, name):
            return self.origin and json.dumps(self.origin)

    monkeypatch.setattr(extras, "__file__", str(tmp_path / "jaxcal" / "extras.py"))
    checkout = {"url": "file:///home/an%20engineer/jaxcal", "dir_info": {}}
    for origin, source in (
        (checkout, "/home/an engineer/jaxcal"),
        ({"url": "https://example.org/a.whl", "archive_info": {}}, "jaxcal"),
        (None, "jaxcal"),
    ):
        made = Distribution(origin)
        monkeypatch.setattr("importlib.metadata.distribution", lambda _, m=made: m)
        assert shlex.split(extras.install("live"))[-1] == f"{source}[live]"


def test_a_program_is_named_by_its_path_where_the_shell_does_not_find_it(monkeypatch):
    beside = pathlib.Path(sys.executable).with_name("jaxcal")
    monkeypatch.setattr(shutil, "which", lambda name: None)
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", ["train.py"])
    script, train = shlex.split(typed_line("evaluate.py")), typed_line("jaxcal train")
    assert pathlib.Path(script[0]).absolute() == pathlib.Path(sys.executable)
    assert (ROOT / script[1]).is_file()
    assert pathlib.Path(train.split()[0]).absolute() == beside
    monkeypatch.chdir("/")
    monkeypatch.setattr(sys, "argv", [str(ROOT / "train.py")])
    assert pathlib.Path(shlex.split(typed_line("evaluate.py"))[1]).is_file()
