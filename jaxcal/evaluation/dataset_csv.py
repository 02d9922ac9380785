"""Datasets as .csv: one candidate a line, in any order; faults are named by line."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxcal.checks import axis_letter
from jaxcal.evaluation.csv_rows import read_columns
from jaxcal.evaluation.dataset import Dataset
from jaxcal.files import atomic_write

__all__ = ["read_csv", "save_csv"]

_LABELS = ("episode", "candidate")
_MASK = "available"


def save_csv(
    dataset: Dataset,
    path: str | os.PathLike[str],
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> None:
    """Write a .csv atomically, every number with all its digits; ranges are not kept.

    Args:
        dataset: what to write.
        path: of the file.
        progress: told how many episodes of how many are written.

    Raises:
        OSError: the folder is missing, not writable or full.
    """
    n, m, mask = dataset.num_inputs, dataset.num_outputs, dataset.available
    header = [*_LABELS, *(f"u_{axis_letter(i, n)}" for i in range(n))]
    values = [dataset.candidates]
    if dataset.measured is not None:
        header += [f"y_{axis_letter(i, m)}" for i in range(m)]
        values.append(dataset.measured)
    header += [] if mask is None else [_MASK]
    with atomic_write(path) as file:
        text = io.TextIOWrapper(file, "utf-8", newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(header)
        for e, episode in enumerate(zip(*values, strict=True)):
            if e % 1000 == 0:
                progress(f"write {os.path.basename(path)}", e, dataset.num_episodes)
            for i, row in enumerate(np.concatenate(episode, axis=1).tolist()):
                last = [] if mask is None else [int(mask[e, i])]
                writer.writerow([e, i, *row, *last])
        text.detach()


def read_csv(data: bytes) -> dict[str, Any]:
    """The fields of a ``Dataset``."""
    names, lines, table = read_columns(data, _columns)
    if not lines:
        raise ValueError("no candidates below the header")
    labels = table[:, :2]
    for row, place in np.argwhere((labels % 1 != 0) | (np.abs(labels) > 2.0**53)):
        raise ValueError(
            f'line {lines[row]}: "{names[place]}" must be a whole number of at most '
            f"2^53, got {labels[row, place]:g}"
        )
    order = np.lexsort(labels.T[::-1])
    labels = labels[order]
    for place in np.flatnonzero((labels[1:] == labels[:-1]).all(axis=1)):
        first, again = (lines[row] for row in order[place : place + 2])
        raise ValueError(
            f"line {again}: candidate {labels[place, 1]:.0f} of episode "
            f"{labels[place, 0]:.0f} was already given in line {first}"
        )
    episodes, counts = np.unique(labels[:, 0], return_counts=True)
    for other in np.flatnonzero(counts != counts[0]):
        raise ValueError(
            f"every episode must have as many candidates: episode {episodes[0]:.0f} "
            f"has {counts[0]}, episode {episodes[other]:.0f} has {counts[other]}"
        )
    sorted_table = table[order].reshape(len(episodes), counts[0], len(names))
    u, y, free = (
        [i for i, name in enumerate(names) if name.startswith(start)]
        for start in ("u_", "y_", _MASK)
    )
    fields: dict[str, Any] = {"candidates": sorted_table[..., u]}
    if y:
        fields["measured"] = sorted_table[..., y]
    if free:
        for row in np.flatnonzero(~np.isin(table[:, free[0]], (0, 1))):
            raise ValueError(
                f'line {lines[row]}: "{_MASK}" must be 0 or 1, got '
                f"{table[row, free[0]]:g}"
            )
        fields["available"] = sorted_table[..., free[0]] == 1.0
    return fields


def _columns(header: Sequence[str]) -> list[str]:
    """All of them, the labels first."""
    for name in _LABELS:
        if name not in header:
            raise ValueError(f'column "{name}" is missing, found {",".join(header)}')
    if not any(name.startswith("u_") for name in header):
        raise ValueError('no input column ("u_x", ...) in the header')
    for name in header:
        if name not in (*_LABELS, _MASK) and not name.startswith(("u_", "y_")):
            raise ValueError(f'unknown column "{name}"')
        if header.count(name) > 1:
            raise ValueError(f'column "{name}" comes twice')
    return [*_LABELS, *(name for name in header if name not in _LABELS)]
