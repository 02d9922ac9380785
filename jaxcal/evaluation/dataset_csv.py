"""Datasets as .csv: one candidate a line, in any order; faults are named by line."""

from __future__ import annotations

import csv
import io
import math
import os
from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxcal.checks import axis_letter
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
    """Write one .csv of a dataset that comes in parts, each with as many columns.

    Raises:
        OSError: the folder is missing, not writable or full.
    """
    with atomic_write(path) as file:
        episode = 0
        for dataset in parts:
            text = io.StringIO()
            writer = csv.writer(text, lineterminator="\n")
            if episode == 0:
                writer.writerow(_header(dataset))
            _write_rows(writer, dataset, episode)
            file.write(text.getvalue().encode("utf-8"))
            episode += dataset.num_episodes


def _header(dataset: Dataset) -> list[str]:
    n, m = dataset.num_inputs, dataset.num_outputs
    header = ["episode", "candidate", *(f"u_{axis_letter(i, n)}" for i in range(n))]
    if dataset.measured is not None:
        header += [f"y_{axis_letter(i, m)}" for i in range(m)]
    return header if dataset.available is None else [*header, "available"]


def _write_rows(writer: Any, dataset: Dataset, first_episode: int) -> None:
    columns = [dataset.candidates]
    if dataset.measured is not None:
        columns.append(dataset.measured)
    for e, episode in enumerate(np.concatenate(columns, axis=2).tolist()):
        for i, row in enumerate(episode):
            mask = [] if dataset.available is None else [int(dataset.available[e, i])]
            writer.writerow([first_episode + e, i, *row, *mask])


def read_csv(data: bytes) -> dict[str, Any]:
    """The fields of a ``Dataset``."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ValueError(f"line {line}: not UTF-8 text") from None
    reader = csv.reader(io.StringIO(text, newline=""))
    lines: dict[tuple[int, int], int] = {}  # of each (episode, candidate)
    values: dict[tuple[int, int], list[float]] = {}
    try:
        header = [name.strip() for name in next(reader, [])]
        inputs, outputs, masks = _columns(header)
        names = [*inputs, *outputs, *masks]
        place = [header.index(name) for name in names]
        first, second = header.index("episode"), header.index("candidate")
        for row in reader:
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != len(header):
                raise ValueError(f"{len(row)} cells, {len(header)} in the header")
            label = _whole("episode", row[first]), _whole("candidate", row[second])
            if label in lines:
                raise ValueError(
                    f"candidate {label[1]} of episode {label[0]} was already given in "
                    f"line {lines[label]}"
                )
            lines[label] = reader.line_num
            values[label] = [
                _number(name, row[i]) for name, i in zip(names, place, strict=True)
            ]
    except (ValueError, csv.Error) as error:
        raise ValueError(f"line {max(reader.line_num, 1)}: {error}") from None
    if not values:
        raise ValueError("no candidates below the header")
    counts = Counter(episode for episode, _ in sorted(values))
    (label0, size), *others = counts.items()
    for episode, count in others:
        if count != size:
            raise ValueError(
                f"every episode must have as many candidates: episode {label0} has "
                f"{size}, episode {episode} has {count}"
            )
    table = np.array([values[label] for label in sorted(values)])
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
    inputs = [name for name in header if name.startswith("u_")]
    outputs = [name for name in header if name.startswith("y_")]
    if not inputs:
        raise ValueError('no input column ("u_x", ...) in the header')
    known = {"episode", "candidate", "available", *inputs, *outputs}
    for name in header:
        if name not in known:
            raise ValueError(f'unknown column "{name}"')
        if header.count(name) > 1:
            raise ValueError(f'column "{name}" comes twice')
    return inputs, outputs, ["available"] if "available" in header else []


def _whole(name: str, cell: str) -> int:
    try:
        number = int(cell)
    except ValueError:
        raise ValueError(f'"{name}" must be a whole number, got {cell!r}') from None
    if abs(number) > 2**53:
        raise ValueError(f'"{name}" is out of range, got {cell!r}')
    return number


def _number(name: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        raise ValueError(f'"{name}" must be a number, got {cell!r}') from None
    if not math.isfinite(number):
        raise ValueError(f'"{name}" must be finite, got {cell!r}')
    if name == "available" and number not in (0.0, 1.0):
        raise ValueError(f'"available" must be 0 or 1, got {cell!r}')
    return number
