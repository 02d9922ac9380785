"""Which few of many candidate postures to measure: one problem, many questions."""

from __future__ import annotations

import importlib
from typing import Any

from jaxcal.selection.criteria import As, Ds, I, Mean, Worst
from jaxcal.selection.design import Design, select
from jaxcal.selection.result import Selection

__all__ = [
    "As",
    "Design",
    "Ds",
    "I",
    "Mean",
    "Selection",
    "Worst",
    "exact_batch",
    "exchange_batch",
    "greedy_batch",
    "random_batch",
    "select",
]

_MOVED = ("Motion", "Refinement", "optimise")  # to jaxcal.designs


def __getattr__(name: str) -> Any:
    if name not in (*__all__, *_MOVED):
        raise AttributeError(f"module 'jaxcal.selection' has no attribute {name!r}")
    home = "jaxcal.designs" if name in _MOVED else "jaxcal.selection.batch"
    globals()[name] = value = getattr(importlib.import_module(home), name)
    return value
