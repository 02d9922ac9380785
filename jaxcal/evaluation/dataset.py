"""Candidate sets to evaluate on, and their files; malformed ones are refused.

.npz: ``candidates`` (episodes, M, n); optional ``measured`` (episodes, M, m),
``available`` (episodes, M) and ``low``, ``high`` (n,), the ranges that [0, 1] stands
for. .csv: one candidate a line, in any order, under ``episode,candidate,u_...`` and
optionally ``y_...`` and ``available``.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import os
import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.candidates import JointRanges
from jaxcal.checks import Array, Mask, array_of, require_none
from jaxcal.files import atomic_write
from jaxcal.tables import COMMANDS, MEASURED, Table, parse

_KEYS = ("candidates", "measured", "available")
_ENDS = ("low", "high")
LABELS = ("episode", "candidate")
MASK = "available"


@dataclasses.dataclass(frozen=True, eq=False)
class Dataset:
    """Candidate sets, and what was measured at them where that is known."""

    name: str
    candidates: Array  # (E, M, n) commands
    measured: Array | None = None  # (E, M, m) postures reached
    available: Mask | None = None  # (E, M) True where a candidate may be chosen
    ranges: JointRanges | None = None  # what [0, 1] stands for, where normalised
    seed: int | None = None  # of a generated dataset
    sha256: str | None = None  # of the file it was read from

    def __post_init__(self) -> None:
        arrays = {
            "candidates": array_of("candidates", self.candidates, "episodes", "M", "n")
        }
        sizes = arrays["candidates"].shape[:2]
        if self.measured is not None:
            arrays["measured"] = array_of("measured", self.measured, *sizes, "m")
        for name, array in arrays.items():
            if 0 in array.shape:
                raise ValueError(
                    f"{name} must have no axis of length 0, got {array.shape}"
                )
            object.__setattr__(self, name, array)
        if self.available is not None:
            mask = array_of("available", self.available, *sizes)
            require_none(~np.isin(mask, (0, 1)), mask, "available must be 1 or 0")
            object.__setattr__(self, "available", mask == 1)
        if self.ranges is not None and len(self.ranges.low) != self.num_inputs:
            raise ValueError(
                f"ranges must hold {self.num_inputs} numbers, got "
                f"{len(self.ranges.low)}"
            )

    @property
    def num_episodes(self) -> int:
        """E."""
        return self.candidates.shape[0]

    @property
    def num_candidates(self) -> int:
        """M."""
        return self.candidates.shape[1]

    @property
    def num_inputs(self) -> int:
        """n."""
        return self.candidates.shape[2]

    @property
    def num_outputs(self) -> int:
        """Axes of ``measured``, those of the inputs where nothing was measured."""
        return self.num_inputs if self.measured is None else self.measured.shape[2]

    def facts(self) -> dict[str, Any]:
        """Name, sizes and origin, as reports and JSON documents give them."""
        sizes = ("num_candidates", "num_inputs", "num_outputs", "seed", "sha256")
        facts = {"name": self.name, "episodes": self.num_episodes}
        return facts | {name: getattr(self, name) for name in sizes}

    def part(self, begin: int, end: int) -> Dataset:
        """Episodes ``begin`` to ``end``, the last one not included."""
        held = {name: getattr(self, name) for name in _KEYS}
        cut = {k: array[begin:end] for k, array in held.items() if array is not None}
        return dataclasses.replace(self, **cut)


def load_dataset(path: str | os.PathLike[str]) -> Dataset:
    """Read a .npz or .csv dataset; a ValueError names the file and the key, row or line
    at fault."""
    file = pathlib.Path(path)
    data, ending = file.read_bytes(), file.suffix.lower()
    sha256 = hashlib.sha256(data).hexdigest()
    if ending == ".csv":  # its errors name the file
        return Dataset(file.name, sha256=sha256, **_read_csv(os.fspath(path), data))
    try:
        if not data:
            raise ValueError("the file is empty")
        if ending != ".npz":
            raise ValueError("a dataset must be a .npz or .csv file")
        return Dataset(file.name, sha256=sha256, **_read_npz(data))
    except ValueError as error:
        raise ValueError(f"{os.fspath(path)}: {error}") from None


def save_npz(dataset: Dataset, path: str | os.PathLike[str]) -> None:
    """Write a .npz atomically."""
    held = {name: getattr(dataset, name) for name in _KEYS}
    if dataset.ranges is not None:
        held |= {"low": dataset.ranges.low, "high": dataset.ranges.high}
    arrays = {name: array for name, array in held.items() if array is not None}
    with atomic_write(path) as file:
        np.savez(file, allow_pickle=False, **arrays)


def _read_npz(data: bytes) -> dict[str, Any]:
    """The fields of a ``Dataset``."""
    try:
        archive = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception:  # zipfile and numpy raise ten kinds on bytes that are damaged
        raise ValueError("not a .npz file, or truncated") from None
    if not isinstance(archive, np.lib.npyio.NpzFile):
        raise ValueError("a single array, not a .npz file")
    with archive:
        held = {k: _member(archive, k) for k in archive.files if k in (*_KEYS, *_ENDS)}
        if "candidates" not in held:
            keys = ", ".join(sorted(archive.files)) or "nothing"
            raise ValueError(f'key "candidates" is missing, found {keys}')
    ends = [held.pop(key) for key in _ENDS if key in held]
    if len(ends) == 1:
        raise ValueError('keys "low" and "high" must come together')
    return held | ({"ranges": JointRanges(ends[0], ends[1])} if ends else {})


def _member(archive: np.lib.npyio.NpzFile, key: str) -> NDArray[Any]:
    try:
        member: NDArray[Any] = archive[key]
    except Exception as error:  # of many kinds, where bytes are damaged
        if isinstance(error, ValueError) and "pickle" in str(error):
            raise ValueError(
                f'key "{key}" must be an array of numbers, not of objects (such as '
                "ragged episodes)"
            ) from None
        raise ValueError(f'key "{key}" is damaged') from None
    if member.dtype.kind not in "biuf":
        raise ValueError(f'key "{key}" must hold numbers, got dtype {member.dtype}')
    return member


def _read_csv(source: str, data: bytes) -> dict[str, Any]:
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
    if MASK in table.labels:  # 0 and 1 alone
        table.columns([MASK])
    if (mask := table.available()) is not None:
        fields["available"] = mask[order].reshape(shape)
    return fields


def _columns(table: Table) -> list[str]:
    """All of them, the labels first."""
    source, header = table.source, table.header
    for name in LABELS:
        if name not in header or not table.headed:
            raise ValueError(
                f"{source}: column {name!r} is missing; columns: {', '.join(header)}"
            )
    if not any(name.startswith(COMMANDS) for name in header):
        raise ValueError(f"{source}: no column of commands, such as u_x, in the header")
    for name in header:
        if name not in (*LABELS, MASK) and not name.startswith((COMMANDS, MEASURED)):
            raise ValueError(f"{source}: unknown column {name!r}")
    return [*LABELS, *(name for name in header if name not in (*LABELS, MASK))]
