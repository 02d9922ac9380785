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
import struct
import zipfile
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.candidates import JointRanges
from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.dataset_csv import read_csv, save_csv, save_csv_parts
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
            fields = read_csv(data)
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
