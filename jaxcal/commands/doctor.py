"""``jaxcal doctor``: what is installed, what the machine offers, for a bug report."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import re
import sys
from typing import Annotated

from jaxcal.commands.tables import write_json

__all__ = ["doctor", "report"]

_OTHERS = ("all", "bench", "dev", "docs")  # extras that name others, or are not used


def doctor(*, json: Annotated[bool, "print JSON"] = False) -> None:
    """Print the report.

    Nothing is changed and no port is opened.
    """
    found = report()
    if json:
        write_json("", found)
        return
    width = max(map(len, found))
    for name, value in found.items():
        print(f"{name:<{width}}  {value}")


def report() -> dict[str, str]:
    """Thing to what was found of it."""
    python = f"{platform.python_version()} ({sys.executable})"
    found = {
        "python": python,
        "platform": platform.platform(),
        "cores": str(os.cpu_count()),
        "jaxcal": _version("jaxcal", "a checkout that is not installed"),
    }
    for line in importlib.metadata.requires("jaxcal") or []:
        asked = re.match(r"([\w.-]+)(?:.*extra == ['\"](\w+)['\"])?", line)
        if asked and asked[2] not in _OTHERS:
            extra = f": pip install 'jaxcal[{asked[2]}]'" if asked[2] else ""
            found.setdefault(asked[1], _version(asked[1], f"not installed{extra}"))
    cache = "JAX_COMPILATION_CACHE_DIR"
    return found | {"devices": _devices(), cache: os.environ.get(cache, "not set")}


def _version(package: str, missing: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return missing


def _devices() -> str:
    if importlib.util.find_spec("jax") is None:
        return "none: JAX is not installed"
    import jax

    try:
        return ", ".join(f"{d.id} {d.platform} {d.device_kind}" for d in jax.devices())
    except RuntimeError as error:
        return " ".join(str(error).split())
