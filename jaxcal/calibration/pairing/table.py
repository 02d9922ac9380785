"""A table of commands and readings, and which command each reading may belong to."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Array
from jaxcal.models.model import Model
from jaxcal.models.predictions import derivative, predict

Rows = NDArray[np.intp]
Path = tuple[tuple[int, int], ...]  # shifts by rows, and from which row on

AS_IT_IS = "as it is"  # kind of a hypothesis
FOREIGN = 99  # shift of readings that belong to no command


@dataclasses.dataclass(frozen=True)
class ColumnChange:
    """Columns of a table as they should be."""

    words: str  # what is wrong with them
    of_readings: bool
    order: tuple[int, ...]  # column i is the table's order[i]
    factors: tuple[float, ...]  # times this

    def __call__(self, values: Array) -> Array:
        """(N, k) put right."""
        return values[:, self.order] * self.factors

    @property
    def log_size(self) -> float:
        """Log of what it makes of the size of a reading, of all outputs together."""
        return float(np.log(np.abs(self.factors)).sum()) if self.of_readings else 0.0


@dataclasses.dataclass(frozen=True)
class Hypothesis:
    """Which command each reading belongs to."""

    kind: str
    match: Rows  # (N,) row of the command of each reading, -1 of none
    code: float = 0.0  # -log of its prior probability
    starts: Path = ()
    change: ColumnChange | None = None
    extra: Array | None = None  # (N, e) columns that are fitted too, of each output


@dataclasses.dataclass(frozen=True)
class Table:
    """N rows of commands and readings, and the model that shall explain them."""

    model: Model
    commands: Array  # (N, n)
    measured: Array  # (N, q)
    counted: NDArray[np.bool_]  # (N,) False: the reading was left out
    mean: Array  # (p,) of the prior
    precision: Array  # (p,) of it
    free: NDArray[np.bool_]  # (p,)
    theta: Array  # (p,) where the model is linearised
    scale: Array  # (q,) in which outputs are compared
    width: Array  # (q,) spread of the readings, in scales
    shared: bool  # outputs share one regressor, and nothing is known of its factors

    @property
    def flat(self) -> int:
        """Free parameters of which nothing is known."""
        return int((self.free & (self.precision == 0.0)).sum())

    @property
    def outputs(self) -> int:
        """q."""
        return len(self.scale)

    @property
    def sensed(self) -> int:
        """Columns of the commands that come with the readings."""
        return self.commands[:, self.model.sensed].shape[1]

    @property
    def levels(self) -> int:
        """Levels of noise: one of each output, one of all where a prior counts."""
        return 1 if (self.precision[self.free] > 0.0).any() else len(self.scale)

    def costs(self) -> Array:
        """(N,) -log density of readings that are paired with nothing."""
        middle = np.median(self.measured[self.counted], axis=0)
        off = (self.measured - middle) / self.scale / self.width
        log = 0.5 * np.log(2.0 * np.pi) + np.log(self.width)
        return np.asarray((log + np.minimum(0.5 * off**2, 4.5)).sum(axis=1))

    def commands_of(self, hypothesis: Hypothesis, rows: Rows) -> Array:
        """(K, n) commands that the readings of these rows belong to."""
        commands = self.commands[hypothesis.match[rows]]
        sensed = self.model.sensed
        commands[:, sensed] = self.commands[rows, sensed]
        change = hypothesis.change
        if change is not None and not change.of_readings:
            commands = change(commands)
        return commands

    def readings_of(self, hypothesis: Hypothesis, rows: Rows) -> Array:
        """(K, q) readings of these rows."""
        change = hypothesis.change
        if change is not None and change.of_readings:
            return change(self.measured[rows])
        return self.measured[rows]

    def residuals(self, hypothesis: Hypothesis, rows: Rows, theta: Array) -> Array:
        """(K, q) readings less predictions, in scales."""
        commands = self.commands_of(hypothesis, rows)
        off = self.readings_of(hypothesis, rows) - predict(
            self.model, commands, theta, finite=False
        )
        return np.asarray(self.model.wrapped(off, commands) / self.scale)

    def system(self, hypothesis: Hypothesis, rows: Rows) -> tuple[Array, Array]:
        """The readings as linear in what is free, less its mean.

        Returns:
            (K, a, r) and (K, a, c): each of a readings and c columns has r factors.
        """
        extra = np.zeros((len(self.commands), 0))
        if hypothesis.extra is not None:
            extra = hypothesis.extra
        if self.shared:
            regressors = self.model.blocks(self.commands_of(hypothesis, rows))
            return (
                np.concatenate([regressors, extra[rows, None]], axis=-1),
                self.readings_of(hypothesis, rows)[:, None] / self.scale,
            )
        slopes = np.zeros((len(rows), self.outputs, 0))
        off = self.residuals(hypothesis, rows, self.theta)
        if self.free.any():
            commands = self.commands_of(hypothesis, rows)
            slopes = derivative(self.model, commands, self.theta)[..., self.free]
            slopes = slopes / self.scale[:, None]
            off = off + slopes @ (self.theta - self.mean)[self.free]
        more = np.einsum("ke,ab->kaeb", extra[rows], np.eye(self.outputs))
        more = more.reshape(len(rows), self.outputs, -1)
        return np.concatenate([slopes, more], axis=-1), off[..., None]

    def ridge(self, columns: int) -> Array:
        """(r,) precision of ``columns`` factors of ``system``."""
        known = np.zeros(columns)
        if not self.shared:
            known[: self.free.sum()] = self.precision[self.free]
        return known


def as_it_is(table: Table, extra: Array | None = None, code: float = 0.0) -> Hypothesis:
    """Each reading belongs to the command beside it."""
    match = np.arange(len(table.commands))
    return Hypothesis(AS_IT_IS, match, code, extra=extra)


def shifted(count: int, by: int) -> Rows:
    """(count,) the row of the command ``by`` rows on, -1 where there is none."""
    match = np.arange(count) + by
    return np.where((match >= 0) & (match < count), match, -1)


def path_match(count: int, path: Sequence[tuple[int, int]]) -> Rows:
    """(count,) match of shifts that begin at rows."""
    match = np.full(count, -1)
    ends = [*(start for start, _ in path[1:]), count]
    for (start, by), end in zip(path, ends, strict=True):
        if by != FOREIGN:
            match[start:end] = shifted(count, by)[start:end]
    return match
