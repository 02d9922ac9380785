"""Datasets as .csv: one candidate a line, in any order; faults are named by line."""

from __future__ import annotations

import csv
import io
import os
from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxcal.checks import axis_letter
from jaxcal.evaluation.csv_rows import finite, read_rows
from jaxcal.evaluation.dataset import Dataset
from jaxcal.files import atomic_write

__all__ = ["read_csv", "save_csv", "save_csv_parts"]


def save_csv(dataset: Dataset, path: str | os.PathLike[str]) -> None:
    """Write a .csv atomically, every number with all its digits; ranges are not kept.

    Raises:
        OSError: the folder is missing, not writable or full.
    """
    save_csv_parts([dataset], path)


def save_csv_parts(parts: Iterable[Dataset], path: str | os.PathLike[str]) -> None:
    """Write one .csv of a dataset that comes in parts, each with as many columns."""
    with atomic_write(path) as file:
        total = 0
        for dataset in parts:
            text = io.StringIO()
            writer = csv.writer(text, lineterminator="\n")
            if total == 0:
                writer.writerow(_header(dataset))
            mask = dataset.available
            values = dataset.candidates
            if dataset.measured is not None:
                values = np.concatenate([values, dataset.measured], axis=2)
            for e, episode in enumerate(values.tolist()):
                for i, row in enumerate(episode):
                    last = [] if mask is None else [int(mask[e, i])]
                    writer.writerow([total + e, i, *row, *last])
            file.write(text.getvalue().encode("utf-8"))
            total += dataset.num_episodes


def _header(dataset: Dataset) -> list[str]:
    n, m = dataset.num_inputs, dataset.num_outputs
    header = ["episode", "candidate", *(f"u_{axis_letter(i, n)}" for i in range(n))]
    if dataset.measured is not None:
        header += [f"y_{axis_letter(i, m)}" for i in range(m)]
    return header if dataset.available is None else [*header, "available"]


def read_csv(data: bytes) -> dict[str, Any]:
    """The fields of a ``Dataset``."""
    header, rows = read_rows(data)
    try:
        inputs, outputs, masks = _columns(header)
    except ValueError as error:
        raise ValueError(f"line 1: {error}") from None
    names = [*inputs, *outputs, *masks]
    found: dict[tuple[int, int], tuple[int, list[float]]] = {}  # line and values
    for line, row in rows:
        cells = dict(zip(header, row, strict=True))
        try:
            label = _whole("episode", cells), _whole("candidate", cells)
            if label in found:
                raise ValueError(
                    f"candidate {label[1]} of episode {label[0]} was already given in "
                    f"line {found[label][0]}"
                )
            found[label] = line, [finite(name, cells[name]) for name in names]
            if masks and found[label][1][-1] not in (0.0, 1.0):
                text = cells["available"]
                raise ValueError(f'"available" must be 0 or 1, got {text!r}')
        except ValueError as error:
            raise ValueError(f"line {line}: {error}") from None
    if not found:
        raise ValueError("no candidates below the header")
    counts = Counter(episode for episode, _ in sorted(found))
    (label0, size), *others = counts.items()
    for episode, count in others:
        if count != size:
            raise ValueError(
                f"every episode must have as many candidates: episode {label0} has "
                f"{size}, episode {episode} has {count}"
            )
    table = np.array([found[label][1] for label in sorted(found)])
    table = table.reshape(len(counts), size, len(names))
    n, m = len(inputs), len(outputs)
    fields: dict[str, Any] = {"candidates": table[..., :n]}
    if outputs:
        fields["measured"] = table[..., n : n + m]
    if masks:
        fields["available"] = table[..., -1] == 1.0
    return fields


def _columns(header: list[str]) -> tuple[list[str], list[str], list[str]]:
    """Inputs, outputs and, where it is there, ``available``."""
    for name in ("episode", "candidate"):
        if name not in header:
            raise ValueError(f'column "{name}" is missing, found {",".join(header)}')
    inputs, outputs = ([n for n in header if n.startswith(w)] for w in ("u_", "y_"))
    if not inputs:
        raise ValueError('no input column ("u_x", ...) in the header')
    known = {"episode", "candidate", "available", *inputs, *outputs}
    for name in header:
        if name not in known:
            raise ValueError(f'unknown column "{name}"')
        if header.count(name) > 1:
            raise ValueError(f'column "{name}" comes twice')
    return inputs, outputs, ["available"] if "available" in header else []


def _whole(name: str, cells: dict[str, str]) -> int:
    try:
        number = int(cells[name])
    except ValueError:
        raise ValueError(
            f'"{name}" must be a whole number, got {cells[name]!r}'
        ) from None
    if abs(number) > 2**53:
        raise ValueError(f'"{name}" is out of range, got {cells[name]!r}')
    return number
