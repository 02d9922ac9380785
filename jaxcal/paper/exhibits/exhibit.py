"""What the report is made of: exhibits, with their data, and claims with a verdict."""

from __future__ import annotations

import csv
import dataclasses
import functools
import io
import pathlib
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure

from jaxcal.paper.datasets import AXES

__all__ = [
    "STUDIES",
    "Claim",
    "Columns",
    "Exhibit",
    "Settings",
    "Verdict",
    "as_csv",
    "by_axis",
    "from_rows",
]

STUDIES = pathlib.Path(__file__).resolve().parents[3] / "studies"
"""Where the repository keeps training runs"""

Columns = Mapping[str, Sequence[Any] | np.ndarray]
Verdict = Literal["agrees", "agrees in part", "disagrees", "not comparable"]


@dataclasses.dataclass(frozen=True)
class Settings:
    """How much to compute; everything random hangs on ``seed``."""

    seed: int = 0
    quick: bool = False
    data: pathlib.Path | None = None  # real recordings in place of Datasets 4 and 5
    studies: pathlib.Path = STUDIES  # kept training runs

    @property
    def recorded(self) -> str:
        """What Datasets 4 and 5 are, for titles."""
        return "rig's simulator" if self.data is None else "rig recordings"

    @property
    def about_recordings(self) -> str:
        """Where Datasets 4 and 5 come from, in a sentence."""
        if self.data is not None:
            return f"Datasets 4 and 5: recordings given as --data {self.data}."
        return (
            "Datasets 4 and 5: shipped recordings, made by the rig's own code against "
            "its simulator (play, noise, a heading that drifts), not on a device."
        )

    @property
    def command(self) -> str:
        """What makes the same report again."""
        words = ["python -m jaxcal.paper"]
        words += [f"--seed {self.seed}"] if self.seed else []
        words += ["--quick"] if self.quick else []
        words += [f"--data {self.data}"] if self.data is not None else []
        return " ".join(words)

    @property
    def episodes(self) -> int:
        """Of dataset2."""
        return 200 if self.quick else 1_000

    @property
    def groups(self) -> int:
        """Of dataset0."""
        return 40 if self.quick else 200

    @property
    def random_draws(self) -> int:
        """Random selections per episode."""
        return 30 if self.quick else 100

    @property
    def resamples(self) -> int:
        """Of a bootstrap."""
        return 400 if self.quick else 2_000

    @property
    def repeats(self) -> int:
        """Simulated devices, or histories of one, in the accuracy studies."""
        return 100 if self.quick else 500

    def rng(self, *stream: int) -> np.random.Generator:
        """A stream of its own for each use."""
        return np.random.default_rng(
            np.random.SeedSequence(self.seed, spawn_key=stream)
        )


@dataclasses.dataclass(frozen=True)
class Exhibit:
    """One figure or table: what it shows, what the paper says of it, what came out."""

    key: str  # of its files: "figure_1"
    title: str
    caption: str  # what is drawn, sample sizes, what the intervals are
    paper: str = ""  # what the paper states, in our words
    ours: str = ""
    verdict: Verdict | None = None
    figures: Mapping[str, Figure] = field(default_factory=dict)
    data: Mapping[str, Columns] = field(default_factory=dict)
    numbers: Mapping[str, Any] = field(default_factory=dict)
    rows: Sequence[Sequence[str]] = ()  # a table, its header first
    pictures: Mapping[str, bytes] = field(default_factory=dict)  # PNG, GIF, by file
    notice: str = ""  # for the terminal: what had to be done otherwise

    @classmethod
    def told(cls, section: str, words: Mapping[str, Any], **fields: Any) -> Exhibit:
        """An exhibit with the texts of a section of texts.toml.

        Args:
            section: its name; the key too, where ``fields`` gives none.
            words: what its texts cite beside the numbers of the exhibit.
            fields: of the exhibit.
        """
        said = dict(_texts()[section])
        said.pop("missing", None)
        told = _filled(said, {**fields.get("numbers", {}), **words})
        return cls(**{"key": section, **told, **fields})

    @classmethod
    def missing(cls, section: str, **numbers: Any) -> Exhibit:
        """An exhibit whose kept runs are not there: how to make them."""
        said = _texts()[section]
        told = {"title": said["title"], "paper": said["paper"], "ours": said["missing"]}
        return cls(
            key=section,
            caption="",
            verdict="not comparable",
            numbers=numbers,
            **_filled(told, numbers),
        )

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
    def told(
        cls,
        section: str,
        exhibit: Exhibit,
        verdict: Verdict | None,
        key: str = "",
        **words: Any,
    ) -> Claim:
        """A claim with the texts of ``claims.section`` of texts.toml.

        Args:
            section: its name; the key too, where none is given.
            exhibit: with the evidence, whose numbers the texts cite.
            verdict: "not comparable" when None.
            key: of the claim.
            words: what else its texts cite.
        """
        known = {**exhibit.numbers, **words}
        told = _filled(_texts()["claims"][section], known)
        verdict = verdict or "not comparable"
        return cls(key=key or section, verdict=verdict, where=exhibit.key, **told)


@functools.cache
def _texts() -> dict[str, Any]:
    path = pathlib.Path(__file__).parent / "texts.toml"
    return tomllib.loads(path.read_text(encoding="utf-8"))


def _filled(texts: Mapping[str, str], known: Mapping[str, Any]) -> dict[str, Any]:
    """Texts on one line each, with the numbers in place of their names."""
    return {k: " ".join(text.split()).format_map(known) for k, text in texts.items()}


def by_axis(values: Mapping[str, np.ndarray], name: str = "{}_{}_deg") -> Columns:
    """Columns of (..., 3) arrays: pitch, yaw and roll of each, flattened.

    Args:
        values: arrays by name.
        name: of a column, from the array's name and the axis.
    """
    return {
        name.format(key, axis): np.ravel(array[..., i])
        for key, array in values.items()
        for i, axis in enumerate(AXES)
    }


def from_rows(names: Sequence[str], rows: Sequence[Sequence[Any]]) -> dict[str, Any]:
    """Columns by name of a table given row by row."""
    return dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=True))


def as_csv(columns: Columns) -> str:
    """Columns of equal length as text, numbers with twelve digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow([_cell(value) for value in row])
    return text.getvalue()


def _cell(value: Any) -> str:
    if isinstance(value, (float, np.floating)):
        return "" if np.isnan(value) else f"{value:.12g}"
    return str(value)
