"""``jaxcal doctor``: what it prints is what is installed."""

from __future__ import annotations

import importlib.metadata
import json

import jaxcal
from jaxcal.commands import main
from jaxcal.commands.program import _required


def test_it_names_versions_extras_and_devices(capsys):
    assert main(["doctor", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["jaxcal"] == jaxcal.__version__
    assert found["numpy"] == importlib.metadata.version("numpy")
    assert found["formulaic"] == importlib.metadata.version("formulaic")
    assert "cpu" in found["devices"]


def test_a_package_is_named_with_the_smallest_extra_that_brings_it(monkeypatch):
    extras = {"all": "b c d e", "live": "b c d", "plots": "b", "rig": "b c", "dev": "f"}
    lines = ["a<3,>=2", "a[x]; extra == 'live'", "jaxcal[plots]; extra == 'rig'"]
    for extra, packages in extras.items():
        lines += [f"{name}>=1; extra == '{extra}'" for name in packages.split()]
    monkeypatch.setattr(importlib.metadata, "requires", lambda _: lines)
    assert _required() == {"a": "", "b": "plots", "c": "rig", "d": "live"}


def test_a_missing_package_is_named_with_what_installs_it(monkeypatch, capsys):
    real = importlib.metadata.version

    def version(name):
        if name == "formulaic":
            raise importlib.metadata.PackageNotFoundError(name)
        return real(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    assert main(["doctor"]) == 0
    (line,) = [x for x in capsys.readouterr().out.splitlines() if "formulaic" in x]
    assert line.split(maxsplit=1)[1].startswith("not installed: ")
    assert line.endswith("[models]'")
