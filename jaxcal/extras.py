"""What is installed: extras, what other packages offer, versions."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import os
import pathlib
import platform
import shutil
import sys
import urllib.parse
from collections.abc import Iterator

_COMPUTE = ("jaxcal", "numpy", "scipy", "jax", "jaxlib", "flax", "optax")


class MissingExtraError(ImportError):
    """A package of an extra is not installed; the message names the command."""


@contextlib.contextmanager
def needs(extra: str, purpose: str) -> Iterator[None]:
    """Imports inside the block belong to an extra of jaxcal: a MissingExtraError where
    one of them is not installed, whose subject is ``purpose``: ``'method="policy"'``.
    """
    try:
        yield
    except (ModuleNotFoundError, MissingExtraError) as error:
        package = (error.name or "").partition(".")[0]
        if package in ("", "jaxcal", "rig"):
            raise
        raise MissingExtraError(
            f"{purpose} needs {package}, which is not installed: {install(extra)}",
            name=error.name,
        ) from error


def typed(program: str) -> str:
    """A program of this Python's environment as it is typed here: its name where the
    shell finds it, else its path: ``python``, ``.venv/bin/jaxcal``."""
    beside = pathlib.Path(sys.executable)
    if program != "python":
        beside = beside.with_name(program)
        if not beside.exists():
            return program
    if (there := shutil.which(program)) and pathlib.Path(there) == beside:
        return program
    return _as_typed(beside)


def install(extra: str) -> str:
    """The command that installs an extra of jaxcal into this Python."""
    source, editable = _source()
    flag = " -e" if editable else ""
    return f"{typed('python')} -m pip install{flag} '{source}[{extra}]'"


def _source() -> tuple[str, bool]:
    """From where jaxcal was installed, and whether so that changes show."""
    folder = pathlib.Path(__file__).parents[1]
    described = "{}"
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        direct_url = importlib.metadata.distribution("jaxcal").read_text(
            "direct_url.json"
        )
        described = direct_url or described
    origin = json.loads(described)
    editable = bool(origin.get("dir_info", {}).get("editable"))
    if not (folder / "pyproject.toml").exists():  # installed, not a checkout
        if "dir_info" not in origin:
            return "jaxcal", False
        url = urllib.parse.urlsplit(origin["url"])
        folder = pathlib.Path(urllib.parse.unquote(url.path))
    return _as_typed(folder), editable


def _as_typed(path: pathlib.Path) -> str:
    """A path, relative to the working directory where it lies within."""
    with contextlib.suppress(OSError, ValueError):
        return os.fspath(path.relative_to(pathlib.Path.cwd()))
    return os.fspath(path)


def installed(group: str) -> dict[str, importlib.metadata.EntryPoint]:
    """What installed packages offer under an entry-point group, by name."""
    return {p.name: p for p in importlib.metadata.entry_points(group=group)}


def versions() -> dict[str, str]:
    """What computed a result: Python and the packages that matter, where installed."""
    found = {"python": platform.python_version()}
    for name in (*_COMPUTE, "orbax-checkpoint"):
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found
