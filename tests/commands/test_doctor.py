"""``jaxcal doctor``: what it prints is what is installed."""

from __future__ import annotations

import importlib.metadata
import json

import jaxcal
from jaxcal.commands import doctor, main


def test_it_names_versions_extras_and_devices(capsys):
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["system"]["jaxcal"] == jaxcal.__version__
    assert found["packages"]["numpy"] == importlib.metadata.version("numpy")
    assert found["extras"]["models"] == (
        f"formulaic {importlib.metadata.version('formulaic')}"
    )
    assert "cpu" in " ".join(found["devices"].values())
    assert found["ports"]


def test_a_missing_package_is_named_with_what_installs_it(monkeypatch, capsys):
    real = importlib.metadata.version

    def version(name):
        if name == "formulaic":
            raise importlib.metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert doctor.report()["extras"]["models"] == (
        "no formulaic: pip install 'jaxcal[models]'"
    )
    assert main(["doctor"]) == 0
    assert "  models" in capsys.readouterr().out
