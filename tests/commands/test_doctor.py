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
