"""Datasets as .npz and .csv files; malformed ones are refused by row, line or key.

.npz: ``candidates`` (episodes, M, n); optional ``measured`` (episodes, M, m),
``available`` (episodes, M) and ``low``, ``high`` (n,), the ranges that [0, 1] stands
for. .csv: one candidate a line under the header ``episode,candidate,u_x,u_y,u_z`` and
optionally ``,y_x,y_y,y_z`` and ``,available``; any columns ``u_...`` are inputs and any
``y_...`` outputs, in their order; lines may come in any order.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import os
import pathlib
import struct
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.candidates import JointRanges
from jaxcal.checks import axis_letter
from jaxcal.evaluation.dataset import Dataset
from jaxcal.files import atomic_write

__all__ = ["load_dataset", "save_csv", "save_csv_parts", "save_npz"]

Array = NDArray[np.float64]

# What zipfile and numpy raise on bytes that are not what they say.
_DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    KeyError,
    MemoryError,
    OSError,
    OverflowError,
    RuntimeError,
)


def load_dataset(path: str | os.PathLike[str]) -> Dataset:
    """Read a .npz or .csv dataset.

    Raises:
        OSError: the file cannot be read.
        ValueError: naming the file and the key, row or line at fault.
    """
    file = pathlib.Path(path)
    data = file.read_bytes()
    try:
        if not data:
            raise ValueError("the file is empty")
        if file.suffix.lower() == ".npz":
            fields = _read_npz(data)
        elif file.suffix.lower() == ".csv":
            fields = _read_csv(data)
        else:
            raise ValueError("a dataset must be a .npz or .csv file")
        sha256 = hashlib.sha256(data).hexdigest()
        return Dataset(name=file.name, sha256=sha256, **fields)
    except ValueError as error:
        raise ValueError(f"{os.fspath(path)}: {error}") from None


def save_npz(dataset: Dataset, path: str | os.PathLike[str]) -> None:
    """Write a .npz atomically.

    Raises:
        OSError: the folder is missing, not writable or full.
    """
    arrays: dict[str, NDArray[np.generic]] = {"candidates": dataset.candidates}
    if dataset.measured is not None:
        arrays["measured"] = dataset.measured
    if dataset.available is not None:
        arrays["available"] = dataset.available
    if dataset.ranges is not None:
        arrays |= {"low": dataset.ranges.low, "high": dataset.ranges.high}
    with atomic_write(path) as file:
        np.savez(file, allow_pickle=False, **arrays)


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


def _read_npz(data: bytes) -> dict[str, Any]:
    """The fields of a ``Dataset``."""
    try:
        archive = np.load(io.BytesIO(data), allow_pickle=False)
    except (*_DAMAGE, ValueError):
        raise ValueError("not a .npz file, or a truncated one") from None
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise ValueError("not a .npz file but a single array")
    with archive:
        keys = set(archive.files)
        if "candidates" not in keys:
            found = ", ".join(sorted(keys)) or "nothing"
            raise ValueError(f'key "candidates" is missing, found {found}')
        fields: dict[str, Any] = {
            key: _cube(key, _member(archive, key))
            for key in ("candidates", "measured")
            if key in keys
        }
        if "available" in keys:
            fields["available"] = _mask(_member(archive, "available"))
        if {"low", "high"} & keys:
            if not {"low", "high"} <= keys:
                raise ValueError('keys "low" and "high" must come together')
            ranges = JointRanges(_member(archive, "low"), _member(archive, "high"))
            width = fields["candidates"].shape[2]
            if ranges.num_inputs != width:
                raise ValueError(
                    f'"low" and "high" must hold {width} numbers, got '
                    f"{ranges.num_inputs}"
                )
            fields["ranges"] = ranges
    return fields


def _member(archive: np.lib.npyio.NpzFile, key: str) -> NDArray[np.generic]:
    try:
        member: NDArray[np.generic] = archive[key]
    except _DAMAGE:
        raise ValueError(f'key "{key}" is damaged') from None
    except ValueError as error:
        if "pickle" in str(error):
            raise ValueError(
                f'key "{key}" must be an array of numbers; objects (ragged episodes, '
                "say) are not read"
            ) from None
        raise ValueError(f'key "{key}" is damaged') from None
    return member


def _cube(key: str, array: NDArray[np.generic]) -> Array:
    if array.dtype.kind not in "iuf":
        raise ValueError(f'key "{key}" must hold numbers, got dtype {array.dtype}')
    if array.ndim != 3 or 0 in array.shape:
        raise ValueError(
            f'key "{key}" must have shape (episodes, M, axes), none of them 0, got '
            f"{array.shape}"
        )
    values = array.astype(np.float64)
    if not np.isfinite(values).all():
        episode, row, axis = (int(i) for i in np.argwhere(~np.isfinite(values))[0])
        raise ValueError(
            f'key "{key}" must be finite, got {values[episode, row, axis]} in episode '
            f"{episode}, row {row}, axis {axis}"
        )
    return values


def _mask(array: NDArray[np.generic]) -> NDArray[np.bool_]:
    if array.dtype.kind not in "biuf" or not np.isin(array, (0, 1)).all():
        raise ValueError('key "available" must hold true and false (or 1 and 0)')
    return array.astype(np.bool_)


def _read_csv(data: bytes) -> dict[str, Any]:
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
