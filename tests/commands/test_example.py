"""Example files are there, and the commands printed beside them answer."""

from __future__ import annotations

import shlex

import numpy as np
import pytest

import jaxcal
from jaxcal.commands import main


@pytest.mark.parametrize("which", ["table", "arm"])
def test_printed_commands_answer(which, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["example", which]) == 0
    first, *typed = capsys.readouterr().out.splitlines()
    assert first.startswith("wrote ") and len(typed) == 3
    for line in typed:
        program, *words = shlex.split(line)
        assert program == "jaxcal"
        assert main(words) == 0, line
    assert "good" in capsys.readouterr().out


def test_the_table_is_of_the_machine_that_start_pages_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main(["example", "table", "--folder", "t"])
    main(["identify", "t/measured.csv", "--out", "c.json"])
    found = jaxcal.Calibration.load("c.json")
    np.testing.assert_allclose(np.diag(found.matrix), [0.43, 0.71, 0.87], atol=0.01)
    np.testing.assert_allclose(found.bias, [3.1, -5.8, 2.41], atol=0.1)


def test_the_device_is_a_configuration_that_checks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main(["example", "device"])
    from rig.config import load_config

    names = [axis.name for axis in load_config("rig.toml").axes]
    assert names == ["pitch", "yaw", "roll"]


def test_a_file_that_exists_is_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "targets.csv").write_text("mine")
    assert main(["example", "table"]) == 2
    assert "targets.csv exists" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["targets.csv"]
