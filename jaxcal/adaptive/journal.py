"""Measurements on disk, one per line, for a closed loop that may be killed.

The first line says what is measured and how; each further one is a measurement and is
on the disk (fsync) before the next begins. One process writes it at a time. A torn
last line, as a kill or a full disk leave it, is dropped; other damage is an error.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import pathlib
import re
from typing import Any

import jax
import numpy as np

__all__ = ["Journal", "fingerprint"]

_KIND = "jaxcal adaptive session"


def fingerprint(tree: Any) -> str:
    """A hash of a task or a decider: its tables, its numbers and its kind."""
    leaves, structure = jax.tree.flatten(tree)
    found = hashlib.sha256(re.sub(r" at 0x[0-9a-f]+", "", str(structure)).encode())
    for leaf in leaves:
        array = np.ascontiguousarray(leaf)
        found.update(f"{array.dtype}{array.shape}".encode())
        found.update(array.tobytes())
    return found.hexdigest()


class Journal:
    """An append-only file of a header and measurements.

    Args:
        path: of the file; made where missing, in an existing folder.
        header: of this session. A file of another session is refused.

    Raises:
        ValueError: the file is of another task, decider or budget, damaged, or another
            process is writing it.
        OSError: it cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], header: dict[str, Any]) -> None:
        self.path = pathlib.Path(path)
        header = {"kind": _KIND, "version": 1, **header}
        self._file = self.path.open("ab")
        try:
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise ValueError(f"{path}: a running session is writing it") from None
            lines, self._size = _whole_lines(self.path.read_bytes(), self.path)
            self.entries = lines[1:]
            """Measurements so far: dicts with ``design`` and ``outcome``."""
            if lines:
                _require_same(self.path, lines[0], header)
            self._file.truncate(self._size)
            if not lines:
                self._write(header)
        except BaseException:
            self._file.close()
            raise

    def append(self, **entry: Any) -> None:
        """Write a measurement; it is on the disk when this returns."""
        self._write(entry)
        self.entries.append(entry)

    def _write(self, record: dict[str, Any]) -> None:
        line = json.dumps(record, separators=(",", ":"), allow_nan=False) + "\n"
        try:
            self._file.write(line.encode())
            self._file.flush()
            os.fsync(self._file.fileno())
        except BaseException:
            self._file.truncate(self._size)
            raise
        self._size += len(line.encode())

    def close(self) -> None:
        self._file.close()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _whole_lines(data: bytes, path: pathlib.Path) -> tuple[list[Any], int]:
    """Records, and the bytes that they take."""
    *lines, torn = data.split(b"\n")
    records: list[Any] = []
    size = 0
    for number, line in enumerate(lines):
        try:
            record = json.loads(line)
            if not isinstance(record, dict):
                raise ValueError
            if number and not {"design", "outcome"} <= record.keys():
                raise ValueError
        except ValueError:
            if number == len(lines) - 1 and not torn:
                break  # a damaged last line counts as torn, also with its newline
            raise ValueError(
                f"{path}: line {number + 1} is damaged; the session cannot be resumed"
            ) from None
        records.append(record)
        size += len(line) + 1
    return records, size


def _require_same(
    path: pathlib.Path, found: dict[str, Any], header: dict[str, Any]
) -> None:
    if found.get("kind") != _KIND:
        raise ValueError(f"{path} is not a journal of a session")
    for name, value in header.items():
        if found.get(name) != value:
            raise ValueError(
                f"{path} is of a session with another {name}: {found.get(name)!r}, "
                f"not {value!r}. Give another path, or the same {name}"
            )
