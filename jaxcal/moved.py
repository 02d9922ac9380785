"""Import paths of 0.2 whose modules have moved; they work, and warn, until 0.4."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import sys
import warnings
from typing import Any

__all__ = ["MOVED", "install_finder"]

MOVED = {  # longer names first
    "jaxcal.calibration.budget": "jaxcal.reports.budget",
    "jaxcal.calibration.report": "jaxcal.reports.calibration",
    "jaxcal.csvtable": "jaxcal.tables",
    "jaxcal.evaluation.sequential": "jaxcal.adaptive.evaluation",
    "jaxcal.models.sensors": "jaxcal.arms.sensors",
    "jaxcal.models.serial.kernel": "jaxcal.arms.chain_kernel",
    "jaxcal.models.serial.arm_files": "jaxcal.arms.files.write",
    "jaxcal.models.serial.recordings": "jaxcal.arms.files.recordings",
    "jaxcal.models.serial.servos": "jaxcal.arms.files.servos",
    "jaxcal.models.serial.urdf": "jaxcal.arms.files.urdf",
    "jaxcal.models.serial": "jaxcal.arms",
    "jaxcal.pages": "jaxcal.reports.page",
    "jaxcal.plots": "jaxcal.reports.plots",
    "jaxcal.selection.continuous": "jaxcal.designs.continuous",
    "jaxcal.selection.fastest": "jaxcal.designs.travel",
}


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds a module that has moved, asked first: a folder that an older checkout left
    would be an empty package."""

    def find_spec(
        self, fullname: str, path: Any = None, target: Any = None
    ) -> importlib.machinery.ModuleSpec | None:
        if _new_name(fullname) is None:
            return None
        return importlib.machinery.ModuleSpec(fullname, self)

    def exec_module(self, module: Any) -> None:
        old = module.__name__
        new = _new_name(old)
        assert new is not None  # find_spec has asked
        warnings.warn(
            f"{old} is {new} since jaxcal 0.3; the old name goes with 0.4",
            DeprecationWarning,
            stacklevel=2,
        )
        sys.modules[old] = importlib.import_module(new)


def _new_name(name: str) -> str | None:
    for old, new in MOVED.items() if name.startswith("jaxcal.") else ():
        if name == old or name.startswith(f"{old}."):
            return new + name[len(old) :]
    return None


def install_finder() -> None:
    """Let old paths be imported."""
    sys.meta_path.insert(0, _Finder())
