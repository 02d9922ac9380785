"""Rows that commands write, CSV or JSON, ``-`` for stdout; files of candidates."""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import pathlib
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np

from jaxcal.checks import Array
from jaxcal.files import write_text
from jaxcal.tables import read_table

TablePath = Annotated[str, "CSV, or - (standard input)"]


@dataclasses.dataclass
class Output:
    """Where the answer goes and in which form."""

    json: Annotated[bool, "print JSON"] = False
    csv: Annotated[bool, "print CSV"] = False
    out: Annotated[str, "write to FILE (.csv or .json) instead of printing", "FILE"] = (
        ""
    )

    def written(
        self, names: Sequence[str], rows: Sequence[Sequence[Any]], document: Any = None
    ) -> bool:
        """Write where a form or a file is asked for; False where neither is. As JSON
        the document, an object for each row where there is none."""
        if self.json and self.csv:
            raise ValueError("Leave out --json or --csv")
        ending = pathlib.PurePath(self.out).suffix.lower()
        if (self.json and ending == ".csv") or (self.csv and ending == ".json"):
            form = "--json" if self.json else "--csv"
            raise ValueError(f"{form} and --out {self.out} differ: leave one out")
        if ending not in ("", ".csv", ".json", ".txt"):
            raise ValueError(f"--out must end in .csv or .json, got {self.out}")
        if self.json or ending == ".json":
            objects = [dict(zip(names, row, strict=True)) for row in rows]
            write_json(self.out, objects if document is None else document)
        elif self.csv or self.out:
            write_rows(self.out, names, rows)
        else:
            return False
        return True


def write_rows(out: str, names: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Write rows as CSV to a file, atomically, or to standard output."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([names, *rows])
    _emit(out, text.getvalue())


def write_json(out: str, document: Any) -> None:
    """Write a JSON document to a file, atomically, or to standard output."""
    _emit(out, json.dumps(document, indent=1, default=_plain) + "\n")


def _emit(out: str, text: str) -> None:
    if out in ("", "-"):
        sys.stdout.write(text)
    else:
        write_text(out, text)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"cannot write {type(value).__name__} as JSON")


def holds_sets(path: str) -> bool:
    """Whether a file holds episodes of candidates, in the format of datasets."""
    if path.lower().endswith(".npz"):
        return True
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        return "episode" in [cell.strip() for cell in file.readline().split(",")]


def read_pool(path: str) -> tuple[Array, Any]:
    """(N, n) candidates of a table, and (N,) available; None where all are."""
    table = read_table(path)
    mask = table.available()
    return table.columns(table.commands(None, option=None), mask), mask


def draw_sets(path: str, episodes: int, seed: int) -> Array:
    """(episodes, M, n): of each episode M of the available rows, at most 50."""
    rows, mask = read_pool(path)
    rows = rows if mask is None else rows[mask]
    rng = np.random.default_rng(seed)
    count = min(50, len(rows))
    picked = [rng.choice(len(rows), count, replace=False) for _ in range(episodes)]
    return rows[np.stack(picked)]
