"""Files of candidates: one table, a pool to draw from, or a dataset of whole sets."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxcal.checks import Array
from jaxcal.tables import read_table


def holds_sets(path: str) -> bool:
    """Whether a file holds episodes of candidates, in the format of datasets."""
    if path.lower().endswith(".npz"):
        return True
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        return "episode" in [cell.strip() for cell in file.readline().split(",")]


def read_pool(path: str) -> tuple[Array, Any]:
    """(N, n) candidates of a table, and (N,) available; None where all are."""
    table = read_table(path)
    mask = table.available()
    return table.columns(table.commands(None, option=None), mask), mask


def draw_sets(path: str, episodes: int, seed: int, size: int = 50) -> Array:
    """(episodes, M, n): of each episode M of the available rows, at most ``size``."""
    rows, mask = read_pool(path)
    rows = rows if mask is None else rows[mask]
    rng = np.random.default_rng(seed)
    count = min(size, len(rows))
    picked = [rng.choice(len(rows), count, replace=False) for _ in range(episodes)]
    return rows[np.stack(picked)]
