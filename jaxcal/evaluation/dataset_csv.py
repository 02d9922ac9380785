"""Datasets as .csv: one candidate a line, in any order; faults are named by line."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxcal.checks import axis_letter
from jaxcal.evaluation.dataset import Dataset
from jaxcal.files import atomic_write
from jaxcal.tables import COMMANDS, MEASURED, Table, parse

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


def read_csv(source: str, data: bytes) -> dict[str, Any]:
    """The fields of a ``Dataset``; ``source`` is the file's name in errors."""
    table = parse(source, data)
    names = _columns(table)
    values = table.columns(names)
    for row, place in np.argwhere(
        (values[:, :2] % 1 != 0) | (abs(values[:, :2]) > 2.0**53)
    ):
        raise ValueError(
            f"{source}: line {table.lines[row]}, {names[place]} must be a whole number "
            f"of at most 2^53, got {values[row, place]:g}"
        )
    order = np.lexsort(values[:, 1::-1].T)
    labels = values[order, :2]
    for place in np.flatnonzero((labels[1:] == labels[:-1]).all(axis=1)):
        first, again = (table.lines[row] for row in order[place : place + 2])
        raise ValueError(
            f"{source}: line {again} repeats candidate {labels[place, 1]:.0f} of "
            f"episode {labels[place, 0]:.0f} of line {first}"
        )
    episodes, counts = np.unique(labels[:, 0], return_counts=True)
    for other in np.flatnonzero(counts != counts[0]):
        raise ValueError(
            f"{source}: every episode must have the same number of candidates: episode "
            f"{episodes[0]:.0f} has {counts[0]}, episode {episodes[other]:.0f} has "
            f"{counts[other]}"
        )
    shape = len(episodes), counts[0]
    in_order = values[order].reshape(*shape, len(names))
    u, y = (
        [i for i, name in enumerate(names) if name.startswith(start)]
        for start in (COMMANDS, MEASURED)
    )
    fields: dict[str, Any] = {"candidates": in_order[..., u]}
    if y:
        fields["measured"] = in_order[..., y]
    if _MASK in table.labels:  # 0 and 1 alone, as save_csv writes it
        table.columns([_MASK])
    if (mask := table.available()) is not None:
        fields["available"] = mask[order].reshape(shape)
    return fields


def _columns(table: Table) -> list[str]:
    """All of them, the labels first."""
    source, header = table.source, table.header
    for name in _LABELS:
        if name not in header or not table.headed:
            raise ValueError(
                f"{source}: column {name!r} is missing; columns: {', '.join(header)}"
            )
    if not any(name.startswith(COMMANDS) for name in header):
        raise ValueError(f"{source}: no column of commands, such as u_x, in the header")
    for name in header:
        if name not in (*_LABELS, _MASK) and not name.startswith((COMMANDS, MEASURED)):
            raise ValueError(f"{source}: unknown column {name!r}")
    return [*_LABELS, *(name for name in header if name not in (*_LABELS, _MASK))]
