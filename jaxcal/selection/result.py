"""What every solver returns."""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.criteria import Criteria, criteria, d_efficiency
from jaxcal.selection.problem import Problem

__all__ = ["BatchSelection", "Selection", "Subset"]

Indices = NDArray[np.int64]


class Subset(NamedTuple):
    """One subset and its worth."""

    indices: Indices  # (k,)
    log_det: float  # natural log det S, in the candidates' unit


@dataclasses.dataclass(frozen=True, eq=False)
class Selection:
    """The postures chosen, how, and how good they are.

    ``bound``, ``gap``, ``efficiency`` and ``criteria`` are computed when first read.
    """

    indices: Indices  # (k,) into the candidates, in the order picked
    log_det: float  # natural log det S, in the candidates' unit
    method: str  # the solver, or "score" for a subset made elsewhere
    proven: bool  # True: no selection is better by more than 1e-9
    seconds: float  # wall time of the solver
    seed: int | None = None  # where the solver draws at random
    restarts: int | None = None  # random starts of the exchange
    nodes: int | None = None  # branch-and-bound nodes, or subsets enumerated
    alternatives: tuple[Subset, ...] = ()  # the best subsets, best first
    known_bound: float | None = dataclasses.field(default=None, repr=False)
    problem: Problem | None = dataclasses.field(default=None, repr=False)

    @cached_property
    def bound(self) -> float | None:
        """Upper bound on log det S of every selection allowed.

        The proven optimum where the solver or ``reference="exact"`` gave one, or where
        k = n + 1 makes it cheap; otherwise the concave relaxation.
        """
        if self.known_bound is not None:
            return max(self.known_bound, self.log_det)
        if self.problem is None:
            return None
        from jaxcal.selection.exact.exact import upper_bound

        return max(upper_bound(self.problem), self.log_det)

    @property
    def gap(self) -> float | None:
        """``bound - log_det``, zero where optimality is proven."""
        return None if self.bound is None else self.bound - self.log_det

    @property
    def efficiency(self) -> float | None:
        """D-efficiency against ``bound``: at least this share of the best possible."""
        if self.bound is None or self.problem is None:
            return None
        parameters = self.problem.num_outputs * self.problem.num_regressors
        return d_efficiency(self.log_det, self.bound, parameters)

    @cached_property
    def criteria(self) -> Criteria | None:
        """D, A, I, E, G and O1 to O5; I and G over the available candidates."""
        if self.problem is None:
            return None
        candidates = self.problem.candidates
        return criteria(
            candidates[self.indices],
            candidates[self.problem.available],
            self.problem.num_outputs,
        )


@dataclasses.dataclass(frozen=True, eq=False)
class BatchSelection:
    """One selection a candidate set."""

    indices: Indices  # (B, k)
    log_det: NDArray[np.float64]  # (B,) natural log det S
    proven: NDArray[np.bool_]  # (B,)
    bound: NDArray[np.float64]  # (B,) upper bound on log det S, inf where none is known
    nodes: Indices  # (B,) nodes or subsets examined, 0 where not counted
    method: str
    seconds: float  # wall time of the whole batch
