"""Datasets as .npz and .csv files; malformed ones are refused by row, line or key.

.npz: ``candidates`` (episodes, M, n); optional ``measured`` (episodes, M, m),
``available`` (episodes, M) and ``low``, ``high`` (n,), the ranges that [0, 1] stands
for. .csv: one candidate a line under the header ``episode,candidate,u_x,u_y,u_z`` and
optionally ``,y_x,y_y,y_z`` and ``,available``; any columns ``u_...`` are inputs and any
``y_...`` outputs, in their order; lines may come in any order.
"""

from __future__ import annotations

import hashlib
import io
import os
import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.candidates import JointRanges
from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.dataset_csv import read_csv, save_csv
from jaxcal.files import atomic_write

__all__ = ["load_dataset", "save_csv", "save_npz"]

_KEYS = ("candidates", "measured", "available")
_ENDS = ("low", "high")


def load_dataset(path: str | os.PathLike[str]) -> Dataset:
    """Read a .npz or .csv dataset.

    Raises:
        OSError: the file cannot be read.
        ValueError: naming the file and the key, row or line at fault.
    """
    file = pathlib.Path(path)
    data, ending = file.read_bytes(), file.suffix.lower()
    sha256 = hashlib.sha256(data).hexdigest()
    if ending == ".csv":  # its errors name the file
        return Dataset(file.name, sha256=sha256, **read_csv(os.fspath(path), data))
    try:
        if not data:
            raise ValueError("the file is empty")
        if ending != ".npz":
            raise ValueError("a dataset must be a .npz or .csv file")
        return Dataset(file.name, sha256=sha256, **_read_npz(data))
    except ValueError as error:
        raise ValueError(f"{os.fspath(path)}: {error}") from None


def save_npz(dataset: Dataset, path: str | os.PathLike[str]) -> None:
    """Write a .npz atomically.

    Raises:
        OSError: the folder is missing, not writable or full.
    """
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
