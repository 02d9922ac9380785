"""Compiled kernels: loading them, and whether a checkout's are those of its sources."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import os
import pathlib
import sys
import threading
from importlib.machinery import EXTENSION_SUFFIXES, PathFinder
from typing import Any

UNCHECKED = "JAXCAL_KERNELS_UNCHECKED"  # of the environment

_LOADING = threading.Lock()


@functools.cache
def kernel(name: str) -> Any:
    """The kernel ``name``, which calls BLAS, without loading the package scipy.linalg.

    A compiled ``cimport`` asks for the modules scipy.linalg.cython_blas, cython_lapack
    and only for their functions; the package around them loads for 0.4 s. So both are
    loaded from their files here, and forgotten again: whoever imports them later gets
    the same modules in the usual way.
    """
    with _LOADING:
        import scipy

        both = "scipy.linalg.cython_blas", "scipy.linalg.cython_lapack"
        alone = [part for part in both if part not in sys.modules]
        try:
            for part in () if name in sys.modules else alone:
                spec = PathFinder.find_spec(part, [f"{scipy.__path__[0]}/linalg"])
                if spec is not None and spec.loader is not None:
                    module = importlib.util.module_from_spec(spec)
                    spec.loader.exec_module(module)
                    sys.modules[part] = module  # whole: for another thread to find
            return importlib.import_module(name)
        finally:
            for part in alone:
                sys.modules.pop(part, None)


def check(package: pathlib.Path) -> None:
    """One line on stderr where a kernel of a package in a checkout is older than its
    source; an ImportError where it was never compiled for this Python. None where
    ``UNCHECKED`` is set, as by a program that calls no kernel."""
    if UNCHECKED in os.environ:
        return
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
            run = f"run: {sys.executable} -m pip install"
            if some is missing:
                raise ImportError(f"{what}: {files}; {run} -e {package.parent}")
            said = f"{what}: {files}; {run} --no-deps -e {package.parent}"
            with contextlib.suppress(OSError):  # a terminal that is gone
                print(f"jaxcal: {said}", file=sys.stderr)
