"""Methods on the same cases in numbers, as a table, as JSON and as one HTML page."""

from __future__ import annotations

import abc
import dataclasses
import json
import pathlib
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from jaxcal.checks import Array, aligned
from jaxcal.extras import versions
from jaxcal.files import atomic_write
from jaxcal.reports.page import Block, Code, Figure, Page, Section, Table, Text, render


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class MethodResult:
    """What one method reached in each of E cases; R draws, 1 unless random."""

    method: str  # as asked for: "greedy", "policy:first", ...
    checkpoint: Any  # of a policy, for the JSON; None: the shipped one, a baseline
    label: str  # in words
    values: Array  # (E, R) larger is better
    seconds: float  # a decision, averaged over a batch, compilation left out

    @property
    def is_policy(self) -> bool:
        return self.method.startswith("policy")


class MethodNumbers(NamedTuple):
    """One method, and the numbers that the table, the JSON and the page show."""

    result: MethodResult
    numbers: dict[str, Any]  # as documented in docs/evaluation.md; "label": in words


Column = tuple[str, Callable[[MethodNumbers], str]]
"""Title of a column of the table, and its cell in a row"""


@dataclasses.dataclass(frozen=True)
class Summary:
    """All methods of an evaluation, in the numbers that reports show."""

    name: str  # of the dataset: begins the names of its figures' files, unless empty
    heading: str
    columns: tuple[Column, ...]  # the first names the method
    rows: tuple[MethodNumbers, ...]
    facts: Mapping[str, Any]  # what the JSON holds beside the methods
    notes: tuple[str, ...] = ()  # what a reader must know beside the numbers


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation(abc.ABC):
    """Methods on the same cases; a subclass makes and scores them."""

    title: ClassVar[str]  # of the page
    about: ClassVar[str]  # what the columns mean

    results: tuple[MethodResult, ...]  # in the order asked for
    reference: Array  # (E,) the value that those of each case are compared with
    seed: int

    def less(self, result: MethodResult) -> Array:
        """(E, R) values less the reference of their case."""
        return result.values - self.reference[:, None]

    def rows(self) -> tuple[MethodNumbers, ...]:
        """The numbers of every method."""
        return tuple(MethodNumbers(r, self.summary(r)) for r in self.results)

    @abc.abstractmethod
    def summary(self, result: Any) -> dict[str, Any]:
        """The numbers of one method."""

    @abc.abstractmethod
    def summarise(self) -> Summary:
        """What table, page and JSON show."""


def moments(values: Array) -> dict[str, float | None]:
    """Mean, std and median."""
    with np.errstate(invalid="ignore", over="ignore"):
        return {
            "mean": finite(values.mean()),
            "std": finite(values.std()),
            "median": finite(np.median(values)),
        }


def finite(value: Any) -> float | None:
    """A float, or None where it is too large for one."""
    return float(value) if np.isfinite(value) else None


def text_table(shown: Summary) -> str:
    """One evaluation as a table, with its notes."""
    lines = aligned(_rows(shown), "<>", ruled=True)
    return "\n  ".join([shown.heading, *lines, *shown.notes])


def json_document(summaries: Sequence[Summary], *, command: Sequence[str]) -> str:
    """The numbers of several evaluations; the layout is in docs/evaluation.md."""
    whole = {
        "format": "jaxcal-evaluation",
        "version": 1,
        "command": list(command),
        "versions": versions(),
        "results": [entry for shown in summaries for entry in _entries(shown)],
    }
    return json.dumps(whole, indent=1, allow_nan=False) + "\n"


def write_report(
    folder: pathlib.Path,
    evaluations: Sequence[Evaluation],
    draw: Callable[[Any], Mapping[str, Any]],
    training: Mapping[str, Any],
    *,
    command: Sequence[str],
) -> int:
    """Draw everything, then write each figure as SVG and PNG, and ``index.html`` last;
    returns how many figures there are. ``draw`` makes those of an evaluation, by name,
    ``training`` are others, ``command`` is what was typed, for the record."""
    files: dict[str, bytes] = {}
    summaries = [evaluation.summarise() for evaluation in evaluations]
    prefixes = file_prefixes([shown.name for shown in summaries])
    sections = []
    for evaluation, shown, prefix in zip(evaluations, summaries, prefixes, strict=True):
        head, *rows = _rows(shown)
        blocks: list[Block] = [Table(head, rows)]
        blocks += [Text(note, "note") for note in shown.notes]
        blocks += _drawn(draw(evaluation), files, prefix and f"{prefix}_")
        sections.append(Section(shown.heading, blocks))
    if training:
        sections.append(Section("Training", _drawn(training, files)))
    made_with = ", ".join(f"{name} {v}" for name, v in versions().items())
    page = Page(
        evaluations[0].title,
        sections,
        intro=[Text(Code(" ".join(command)), "note"), Text(made_with, "note")],
        footer=[Text(evaluations[0].about, "note")],
    )
    number = len(files) // 2
    files["index.html"] = render(page).encode()
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in files.items():
        with atomic_write(folder / name) as file:
            file.write(data)
    return number


def file_prefixes(names: Sequence[str]) -> list[str]:
    """What the figure files of each dataset are called first; no two alike."""

    stems = [pathlib.PurePath(name).stem or name for name in names]
    prefixes = [re.sub(r"[^\w.-]|_", "-", stem) for stem in stems]
    return [
        name if prefixes.count(name) == 1 else f"{name}-{number}"
        for number, name in enumerate(prefixes, start=1)
    ]


def _drawn(
    figures: Mapping[str, Any], files: dict[str, bytes], prefix: str = ""
) -> list[Block]:
    """Figures of a page; their files are added to those that are given."""
    from jaxcal.reports.plots import as_files

    blocks: list[Block] = []
    for name, figure in ((prefix + name, figures[name]) for name in figures):
        svg, files[f"{name}.png"] = as_files(figure, "svg", "png")
        files[f"{name}.svg"] = svg
        blocks.append(Figure(svg, name.replace("_", " ")))
    return blocks


def _rows(shown: Summary) -> list[tuple[str, ...]]:
    """Head and rows of the table; of several checkpoints each row names its own."""
    many = len(_checkpoints(shown)) > 1
    table = [tuple(title for title, _ in shown.columns)]
    for row in shown.rows:
        name, *cells = (cell(row) for _, cell in shown.columns)
        if many and row.result.is_policy:
            name += f" ({row.result.checkpoint or 'default'})"
        table.append((name, *cells))
    return table


def _checkpoints(shown: Summary) -> list[Any]:
    """The checkpoints of the policies, without repeats."""
    checkpoints: list[Any] = []  # of tasks they are dictionaries, without a hash
    for result, _ in shown.rows:
        if result.is_policy and result.checkpoint not in checkpoints:
            checkpoints.append(result.checkpoint)
    return checkpoints


def _entries(shown: Summary) -> list[dict[str, Any]]:
    """One entry a checkpoint, each with every baseline; one without where no policy."""
    checkpoints = _checkpoints(shown)
    return [
        {
            **shown.facts,
            "checkpoint": (checkpoint or "default") if checkpoints else None,
            "methods": {
                result.method: numbers
                for result, numbers in shown.rows
                if not result.is_policy or result.checkpoint == checkpoint
            },
        }
        for checkpoint in checkpoints or [None]
    ]
