"""Measurements of a closed loop on disk, each before the next begins."""

from __future__ import annotations

import hashlib
import os
import pathlib
import re
from typing import Any

import jax
import numpy as np

from jaxcal.jsonlines import JsonLines, Record

_KIND = "jaxcal adaptive session"


def fingerprint(tree: Any) -> str:
    """A hash of a task or a decider: its tables, its numbers and its kind."""
    leaves, structure = jax.tree.flatten(tree)
    digest = hashlib.sha256(re.sub(r" at 0x[0-9a-f]+", "", str(structure)).encode())
    for leaf in leaves:
        array = np.ascontiguousarray(leaf)
        digest.update(f"{array.dtype}{array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


class SessionJournal:
    """A header, which says what is measured and how, and a record a measurement.

    Args:
        path: of the file; made where missing, in an existing folder.
        header: of this session. A file of another session is refused.

    Raises:
        ValueError: the file is of another task, decider or budget, damaged, or another
            process is writing it.
        OSError: it cannot be written.
    """

    def __init__(self, path: str | os.PathLike[str], header: dict[str, Any]) -> None:
        header = {"kind": _KIND, "version": 1, **header}

        def check(records: list[Record]) -> None:
            if records:
                _require_same(pathlib.Path(path), records[0], header)

        self._lines = JsonLines(path, _whole, check)
        if not self._lines.records:
            self._lines.append(lambda: header, sync=True)

    @property
    def entries(self) -> list[Record]:
        """Measurements so far: dicts with ``design`` and ``outcome``."""
        return self._lines.records[1:]

    def append(self, **entry: Any) -> None:
        """Write a measurement; it is on the disk when this returns."""
        self._lines.append(lambda: entry, sync=True)

    def close(self) -> None:
        """Let another process go on with the session."""
        self._lines.close()

    def __enter__(self) -> SessionJournal:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _whole(number: int, record: Record) -> bool:
    return number == 0 or {"design", "outcome"} <= record.keys()


def _require_same(
    path: pathlib.Path, written: dict[str, Any], header: dict[str, Any]
) -> None:
    if written.get("kind") != _KIND:
        raise ValueError(f"{path} is not a journal of a session")
    for name, value in header.items():
        if written.get(name) != value:
            raise ValueError(
                f"{path} is of a session with another {name}: {written.get(name)!r}, "
                f"not {value!r}. Use another path, or the same {name}"
            )
