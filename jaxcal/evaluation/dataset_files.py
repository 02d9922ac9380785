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
import os
import pathlib
import struct
import zipfile
import zlib
from collections.abc import Iterable
from typing import Any, NoReturn

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
        candidates, measured, available, ranges = fields
        return Dataset(
            name=file.name,
            candidates=candidates,
            measured=measured,
            available=available,
            ranges=ranges,
            sha256=hashlib.sha256(data).hexdigest(),
        )
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


_Fields = tuple[Array, Array | None, NDArray[np.bool_] | None, JointRanges | None]


def _read_npz(data: bytes) -> _Fields:
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
        candidates = _cube("candidates", _member(archive, "candidates"))
        measured = available = ranges = None
        if "measured" in keys:
            measured = _cube("measured", _member(archive, "measured"))
        if "available" in keys:
            available = _mask(_member(archive, "available"))
        if {"low", "high"} & keys:
            if not {"low", "high"} <= keys:
                raise ValueError('keys "low" and "high" must come together')
            low, high = (_member(archive, key) for key in ("low", "high"))
            ranges = JointRanges(low, high)
            if ranges.num_inputs != candidates.shape[2]:
                raise ValueError(
                    f'"low" and "high" must hold {candidates.shape[2]} numbers, got '
                    f"{ranges.num_inputs}"
                )
    return candidates, measured, available, ranges


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


def _read_csv(data: bytes) -> _Fields:
    try:
        reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""))
        table = _Table(reader)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ValueError(f"line {line}: not UTF-8 text") from None
    except csv.Error as error:
        raise ValueError(f"line {reader.line_num}: {error}") from None
    count = table.require_rectangle()
    order = np.lexsort((table.candidate, table.episode))
    values = table.values[order].reshape(-1, count, table.values.shape[1])
    n, m = table.num_inputs, table.num_outputs
    return (
        values[..., :n],
        values[..., n : n + m] if m else None,
        values[..., -1] == 1.0 if table.has_available else None,
        None,
    )


class _Table:
    """The lines of a .csv, parsed and checked one by one."""

    def __init__(self, reader: Any) -> None:  # csv.reader's type has no name
        rows = iter(reader)
        header = [name.strip() for name in next(rows, [])]
        inputs = [name for name in header if name.startswith("u_")]
        outputs = [name for name in header if name.startswith("y_")]
        self.has_available = "available" in header
        self.num_inputs, self.num_outputs = len(inputs), len(outputs)
        known = ["episode", "candidate", *inputs, *outputs]
        known += ["available"] if self.has_available else []
        for name in ("episode", "candidate"):
            if name not in header:
                self._fail(1, f'column "{name}" is missing, found {",".join(header)}')
        if not inputs:
            self._fail(1, 'no input column ("u_x", ...) in the header')
        for name in header:
            if name not in known:
                self._fail(1, f'unknown column "{name}"')
            if header.count(name) > 1:
                self._fail(1, f'column "{name}" comes twice')
        place = [header.index(name) for name in known]
        episodes, candidates, values = [], [], []
        self.lines: list[int] = []
        for row in rows:
            line: int = reader.line_num
            if not any(cell.strip() for cell in row):
                continue
            if len(row) != len(header):
                self._fail(line, f"{len(row)} cells, {len(header)} in the header")
            cells = [row[i] for i in place]
            episodes.append(self._whole(line, "episode", cells[0]))
            candidates.append(self._whole(line, "candidate", cells[1]))
            values.append(
                [
                    self._number(line, name, cell)
                    for name, cell in zip(known[2:], cells[2:], strict=True)
                ]
            )
            if self.has_available and values[-1][-1] not in (0.0, 1.0):
                self._fail(line, f'"available" must be 0 or 1, got {cells[-1]!r}')
            self.lines.append(line)
        if not values:
            raise ValueError("no candidates below the header")
        self.episode = np.array(episodes)
        self.candidate = np.array(candidates)
        self.values = np.array(values)

    def require_rectangle(self) -> int:
        """M; every episode must have as many candidates, each of them once."""
        seen: dict[tuple[int, int], int] = {}
        pairs = zip(self.episode.tolist(), self.candidate.tolist(), strict=True)
        for line, pair in zip(self.lines, pairs, strict=True):
            if pair in seen:
                self._fail(
                    line,
                    f"candidate {pair[1]} of episode {pair[0]} was already given in "
                    f"line {seen[pair]}",
                )
            seen[pair] = line
        labels, counts = np.unique(self.episode, return_counts=True)
        ragged = np.flatnonzero(counts != counts[0])
        if ragged.size:
            raise ValueError(
                f"every episode must have as many candidates: episode {labels[0]} has "
                f"{counts[0]}, episode {labels[ragged[0]]} has {counts[ragged[0]]}"
            )
        return int(counts[0])

    @staticmethod
    def _fail(line: int, problem: str) -> NoReturn:
        raise ValueError(f"line {line}: {problem}")

    def _whole(self, line: int, name: str, cell: str) -> int:
        try:
            number = int(cell)
        except ValueError:
            self._fail(line, f'"{name}" must be a whole number, got {cell!r}')
        if abs(number) > 2**53:
            self._fail(line, f'"{name}" is out of range, got {cell!r}')
        return number

    def _number(self, line: int, name: str, cell: str) -> float:
        try:
            number = float(cell)
        except ValueError:
            self._fail(line, f'"{name}" must be a number, got {cell!r}')
        if not np.isfinite(number):
            self._fail(line, f'"{name}" must be finite, got {cell!r}')
        return number
