"""``jaxcal doctor``: what is installed and what the machine offers, for a bug report.

Nothing is changed and no port is opened.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import os
import platform
import sys
from collections.abc import Iterator
from typing import Any

__all__ = ["add_arguments", "report", "run"]

_CORE = ("numpy", "scipy")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Flags of the command."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> None:
    """Print the report."""
    found = report()
    if arguments.json:
        print(json.dumps(found, indent=1))
        return
    for title, rows in found.items():
        print(title)
        width = max(map(len, rows), default=0)
        for name, value in rows.items():
            print(f"  {name:<{width}}  {value}")


def report() -> dict[str, dict[str, str]]:
    """Part to name to what was found."""
    return {
        "system": {
            "jaxcal": _version("jaxcal"),
            "python": f"{platform.python_version()} ({sys.executable})",
            "platform": platform.platform(),
            "cores": str(os.cpu_count()),
        },
        "packages": {name: _version(name) for name in _CORE},
        "extras": dict(_extras()),
        "devices": _devices(),
        "caches": _caches(),
        "ports": _ports(),
    }


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _extras() -> Iterator[tuple[str, str]]:
    """Each extra with the versions of its packages, or what installs it."""
    try:
        about = importlib.metadata.metadata("jaxcal")
        lines = importlib.metadata.requires("jaxcal") or []
    except importlib.metadata.PackageNotFoundError:
        return
    for extra in about.get_all("Provides-Extra") or []:
        named = [
            _name(line)
            for line in lines
            if line.partition(";")[2].replace('"', "'").strip().endswith(f"'{extra}'")
        ]
        versions = {name: _version(name) for name in named if name != "jaxcal"}
        missing = [name for name, found in versions.items() if found == "not installed"]
        text = ", ".join(f"{name} {found}" for name, found in versions.items())
        if missing:
            text = f"no {', '.join(missing)}: pip install 'jaxcal[{extra}]'"
        if versions:
            yield extra, text


def _name(requirement: str) -> str:
    """The package of a requirement, without extras, versions and markers."""
    end = next((i for i, c in enumerate(requirement) if c in "[<>=!~; ("), None)
    return requirement[:end]


def _devices() -> dict[str, str]:
    if importlib.util.find_spec("jax") is None:
        return {"jax": "not installed"}
    import jax

    try:
        return {str(each.id): f"{each.platform} {each.device_kind}"
                for each in jax.devices()}  # fmt: skip
    except RuntimeError as error:
        return {"jax": " ".join(str(error).split())}


def _caches() -> dict[str, str]:
    name = "JAX_COMPILATION_CACHE_DIR"
    return {name: os.environ.get(name, "not set")}


def _ports() -> dict[str, str]:
    if importlib.util.find_spec("serial") is None:
        return {"serial": "pyserial is not installed"}
    from serial.tools import list_ports  # type: ignore[import-untyped]  # no stubs

    found: list[Any] = sorted(list_ports.comports())
    return {p.device: p.description for p in found} or {"serial": "none"}
