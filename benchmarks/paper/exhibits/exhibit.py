"""What the report is made of: exhibits, with their data, and claims with a verdict."""

from __future__ import annotations

import dataclasses
import functools
import pathlib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from jaxcal.paper.datasets import AXES

Verdict = Literal["agrees", "agrees in part", "disagrees", "not comparable"]
Columns = Mapping[str, Sequence[Any] | np.ndarray]
"""A table by the names of its columns, written as CSV"""


@dataclasses.dataclass(frozen=True)
class Exhibit:
    """One figure or table: what it shows, what the paper says of it, what came out."""

    key: str  # of its files: "figure_1"
    title: str
    policy: str = ""  # which policies it shows, and how they were trained
    caption: str = ""  # what is drawn, sample sizes, what the intervals are
    paper: str = ""  # what the paper states, in our words
    ours: str = ""
    verdict: Verdict | None = None
    figures: Mapping[str, Figure] = field(default_factory=dict)
    data: Mapping[str, Columns] = field(default_factory=dict)
    numbers: Mapping[str, Any] = field(default_factory=dict)
    rows: Sequence[Sequence[str]] = ()  # a table, its header first

    @classmethod
    def from_texts(
        cls, section: str, words: Mapping[str, Any], **fields: Any
    ) -> Exhibit:
        """An exhibit with the texts of a section of texts.toml, its key by default.

        The texts cite the exhibit's numbers and the ``words``.
        """
        known = {**fields.get("numbers", {}), **words}
        texts = _of_exhibit(section)
        return cls(**{"key": section, **_filled(texts, known), **fields})

    @classmethod
    def missing(cls, section: str, **numbers: Any) -> Exhibit:
        """An exhibit whose kept runs are not there: how to make them."""
        held = _of_exhibit(section)
        texts = {name: held[name] for name in ("title", "paper")}
        texts["ours"] = held["missing"]
        filled = _filled(texts, numbers)
        return cls(section, verdict="not comparable", numbers=numbers, **filled)

    @property
    def tables(self) -> dict[str, Columns]:
        """The data by the name of its CSV file."""
        return {f"{self.key}_{name}.csv": rows for name, rows in self.data.items()}


@dataclasses.dataclass(frozen=True)
class Claim:
    """One statement of the paper and what became of it."""

    key: str
    claim: str
    paper: str  # its figure
    ours: str
    verdict: Verdict
    where: str  # key of the exhibit with the evidence

    @classmethod
    def from_texts(
        cls,
        section: str,
        exhibit: Exhibit,
        verdict: Verdict | None,
        key: str = "",
        **words: Any,
    ) -> Claim:
        """A claim with the texts of ``claims.section`` of texts.toml, and its key.

        The texts cite the numbers of the exhibit, which is the evidence, and the
        ``words``. Without a verdict it is "not comparable".
        """
        filled = _filled(_texts()["claims"][section], {**exhibit.numbers, **words})
        verdict = verdict or "not comparable"
        return cls(key=key or section, verdict=verdict, where=exhibit.key, **filled)


@functools.cache
def _texts() -> dict[str, Any]:
    path = pathlib.Path(__file__).parent / "texts.toml"
    return tomllib.loads(path.read_text(encoding="utf-8"))


def _of_exhibit(section: str) -> dict[str, str]:
    """The texts of a section, with its policies in words."""
    texts = _texts()[section]
    return texts | {"policy": _texts()["policies"][texts.get("policy", "none")]}


def _filled(texts: Mapping[str, str], known: Mapping[str, Any]) -> dict[str, Any]:
    """Texts on one line each, with the numbers in place of their names."""
    return {
        name: " ".join(text.split()).format_map(known)
        for name, text in texts.items()
        if name != "missing"
    }


def judge(true: Any, partly: Any = False) -> Verdict:
    """What a claim that is true, or true in one of its senses, comes to."""
    if true:
        return "agrees"
    return "agrees in part" if partly else "disagrees"


def by_axis(values: Mapping[str, np.ndarray], name: str = "{}_{}_deg") -> Columns:
    """Columns of (..., 3) arrays by name: pitch, yaw and roll of each, flattened."""
    return {
        name.format(key, axis): np.ravel(array[..., i])
        for key, array in values.items()
        for i, axis in enumerate(AXES)
    }


def from_rows(names: Sequence[str], rows: Sequence[Sequence[Any]]) -> dict[str, Any]:
    """Columns by name of a table given row by row."""
    return dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))
