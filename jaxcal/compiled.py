"""Whether a checkout's compiled kernels are those of its sources."""

from __future__ import annotations

import os
import pathlib
import sys
from importlib.machinery import EXTENSION_SUFFIXES

__all__ = ["check"]


def check(package: pathlib.Path) -> None:
    """One line on stderr where a kernel is older than its source.

    Args:
        package: folder of a package in a checkout; an installed one holds no sources.

    Raises:
        ImportError: a kernel was never compiled for this Python.
    """
    missing, older = [], []
    for folder, _, names in os.walk(package):
        for name in names:
            if not name.endswith("kernel.py"):
                continue
            source = os.path.join(folder, name)
            module = source.removesuffix(".py") + EXTENSION_SUFFIXES[0]
            if not os.path.exists(module):
                missing.append(source)
            elif os.stat(module).st_mtime < os.stat(source).st_mtime:
                older.append(source)
    for some, what in ((missing, "not compiled"), (older, "changed since compiled")):
        if some:
            files = ", ".join(os.path.relpath(path, package.parent) for path in some)
            said = f"{what}: {files}; run: pip install --no-deps -e {package.parent}"
            if some is missing:
                raise ImportError(said)
            print(f"jaxcal: {said}", file=sys.stderr)
