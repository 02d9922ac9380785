"""``jaxcal doctor``: what is installed, what the machine offers, for a bug report."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import sys
from collections.abc import Iterator
from typing import Annotated, Any

__all__ = ["doctor", "report"]

_CORE = ("numpy", "scipy")
_CACHE, _MISSING = "JAX_COMPILATION_CACHE_DIR", "not installed"


def doctor(*, json_: Annotated[bool, "print JSON"] = False) -> None:
    """Print the report.

    Nothing is changed and no port is opened.
    """
    found = report()
    if json_:
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
        "caches": {_CACHE: os.environ.get(_CACHE, "not set")},
        "ports": _ports(),
    }


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return _MISSING


def _extras() -> Iterator[tuple[str, str]]:
    """Each extra with the versions of its packages, or what installs it."""
    try:
        about = importlib.metadata.metadata("jaxcal")
        lines = importlib.metadata.requires("jaxcal") or []
    except importlib.metadata.PackageNotFoundError:
        return
    for extra in about.get_all("Provides-Extra") or []:
        ours = re.compile(rf"([\w.-]+).*;.*extra == ['\"]{extra}['\"]")
        named = [found[1] for line in lines if (found := ours.match(line))]
        versions = {name: _version(name) for name in named if name != "jaxcal"}
        missing = [name for name, found in versions.items() if found == _MISSING]
        text = ", ".join(f"{name} {found}" for name, found in versions.items())
        if missing:
            text = f"no {', '.join(missing)}: pip install 'jaxcal[{extra}]'"
        if versions:
            yield extra, text


def _devices() -> dict[str, str]:
    if importlib.util.find_spec("jax") is None:
        return {"jax": _MISSING}
    import jax

    try:
        return {str(d.id): f"{d.platform} {d.device_kind}" for d in jax.devices()}
    except RuntimeError as error:
        return {"jax": " ".join(str(error).split())}


def _ports() -> dict[str, str]:
    if importlib.util.find_spec("serial") is None:
        return {"serial": "pyserial is not installed"}
    from serial.tools import list_ports  # type: ignore[import-untyped]  # no stubs

    found: list[Any] = sorted(list_ports.comports())
    return {p.device: p.description for p in found} or {"serial": "none"}
