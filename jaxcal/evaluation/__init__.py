"""How close each way of choosing postures comes to the proven optimum."""

from __future__ import annotations

import importlib
from typing import Any

_HOMES = {  # loaded when first used: methods load scipy, figures matplotlib
    "Dataset": "dataset",
    "Evaluation": "results",
    "Summary": "results",
    "evaluate": "methods",
    "evaluation_figures": "figures",
    "load_dataset": "dataset_files",
    "save_csv": "dataset_files",
    "save_npz": "dataset_files",
    "text_table": "report",
}

__all__ = list(_HOMES)  # the names above


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
