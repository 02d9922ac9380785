"""``jaxcal doctor``: what it prints is what is installed."""

from __future__ import annotations

import importlib.metadata
import json

import jaxcal
from jaxcal.commands import main


def test_it_names_versions_extras_and_devices(capsys):
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["jaxcal"] == jaxcal.__version__
    assert found["numpy"] == importlib.metadata.version("numpy")
    assert found["formulaic"] == importlib.metadata.version("formulaic")
    assert "cpu" in found["devices"]


def test_a_missing_package_is_named_with_what_installs_it(monkeypatch, capsys):
    real = importlib.metadata.version

    def version(name):
        if name == "formulaic":
            raise importlib.metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    told = "not installed: pip install 'jaxcal[models]'"
    assert main(["doctor"]) == 0
    (line,) = [x for x in capsys.readouterr().out.splitlines() if "formulaic" in x]
    assert line.split(maxsplit=1) == ["formulaic", told]
