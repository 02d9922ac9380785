"""Measurements of a closed loop on disk, each before the next begins."""

from __future__ import annotations

import hashlib
import os
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


def open_journal(path: str | os.PathLike[str], header: dict[str, Any]) -> JsonLines:
    """A header, which says what is measured and how, and a record a measurement.

    Args:
        path: of the file; made where missing, in an existing folder.
        header: of this session. A file of another session is refused.

    Raises:
        ValueError: the file is of another task, decider or budget, damaged, or another
            process is writing it.
        OSError: it cannot be written.
    """
    header = {"kind": _KIND, "version": 1, **header}

    def whole(number: int, record: Record) -> bool:
        return number == 0 or {"design", "outcome"} <= record.keys()

    def check(records: list[Record]) -> None:
        if not records:
            return
        if records[0].get("kind") != _KIND:
            raise ValueError(f"{path} is not a journal of a session")
        for name, value in header.items():
            if (written := records[0].get(name)) != value:
                raise ValueError(
                    f"{path} is of a session with another {name}: {written!r}, "
                    f"not {value!r}. Use another path, or the same {name}"
                )

    lines = JsonLines(path, whole, check)
    if not lines.records:
        lines.append(lambda: header, sync=True)
    return lines
