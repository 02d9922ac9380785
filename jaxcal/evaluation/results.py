"""What an evaluation finds: methods on the same cases, in numbers that reports show."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import numpy as np

from jaxcal.checks import Array


@dataclasses.dataclass(frozen=True)
class _Named:
    method: str  # as asked for: "greedy", "policy:first", ...
    checkpoint: Any  # of a policy, for the JSON; None: the shipped one, a baseline

    @property
    def is_policy(self) -> bool:
        return self.method.startswith("policy")


@dataclasses.dataclass(frozen=True)
class MethodNumbers(_Named):
    """One method in the numbers that the table, the JSON and the page show."""

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
class MethodResult(_Named):
    """What one method reached in each of E cases; R draws, 1 unless random."""

    label: str  # in words
    values: Array  # (E, R) larger is better
    seconds: float  # a decision, averaged over a batch, compilation left out


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
        return tuple(
            MethodNumbers(r.method, r.checkpoint, self.summary(r)) for r in self.results
        )

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
