"""Fedorov exchange at equal quality: the optimum found in nearly every set.

Every solver gets restarts until it finds the optimum in at least 95 % of the sets, or
until its largest number of restarts; the time quoted is that of the first number that
does.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.harness import Budget, Line, Row, Verdict, available
from benchmarks.peers import designs
from benchmarks.rows.designs import (
    CASES,
    Solver,
    measure,
    measure_algdesign,
    peers,
    sets_of,
)
from jaxcal import select

NAME = "exchange"
TITLE = "Exchange at equal quality"
ENOUGH = 0.95  # share of sets in which the optimum has to be found
_OWN = (5, 10, 20, 50, 100, 200)
_ALGDESIGN = (1, 5, 20, 50, 100)
_PYOPTEX = (10, 30)


def ours(restarts: int, repeats: bool) -> Solver:
    cap = ", repeats allowed" if repeats else ""

    def choose(c: NDArray[np.float64], k: int) -> NDArray[np.int64]:
        most = k if repeats else 1
        return select(c, k, "exchange", restarts=restarts, max_replicates=most).indices

    return Solver(f"jaxcal exchange{cap}, {restarts} starts", repeats, choose)


def ladder(
    make: Callable[[int], Solver | None], steps: tuple[int, ...]
) -> Solver | None:
    """The first solver that is good enough, or the last tried."""
    solver = None
    for step in steps:
        solver = make(step)
        if solver is None or solver.hits >= ENOUGH:
            break
    return solver


def contenders(
    m: int, k: int, budget: Budget
) -> tuple[dict[bool, Solver], list[Solver]]:
    """Ours, by whether candidates may repeat, and the peers, all measured."""
    sets = sets_of(m, budget)

    def tried(solver: Solver) -> Solver:
        measure([solver], sets, k)
        return solver

    def pyoptex(tries: int) -> Solver:
        who = f"pyoptex, {tries} tries"
        return tried(Solver(who, True, lambda c, k: designs.by_pyoptex(c, k, tries)))

    def algdesign(starts: int) -> Solver | None:
        return measure_algdesign(sets, k, starts)

    def good(make: Callable[[int], Solver | None], steps: tuple[int, ...]) -> None:
        solver = ladder(make, steps)
        if solver is not None:
            foreign.append(solver)

    mine = {}
    for repeats in (False, True):
        solver = ladder(lambda n, r=repeats: tried(ours(n, r)), _OWN)
        assert solver is not None
        mine[repeats] = solver
    foreign: list[Solver] = []
    if available("pyoptex"):
        good(pyoptex, _PYOPTEX[:1] if m == 500 or budget.quick else _PYOPTEX)
    foreign += [tried(s) for s in peers()[0] if s.who.startswith("pydoe mod")]
    good(algdesign, _ALGDESIGN)
    return mine, foreign


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    for m, k in CASES:
        case = f"M = {m}, K = {k}"
        print(f"  {case} ...", flush=True)
        mine, foreign = contenders(m, k, budget)
        for solver in [*mine.values(), *foreign]:
            milliseconds = 1e3 * statistics.median(solver.seconds)
            row.lines.append(Line(case, solver.who, milliseconds, "ms", solver.quality))
        for solver in foreign:
            own = statistics.median(mine[solver.repeats].seconds)
            reached = "" if solver.hits >= ENOUGH else "it never is as good"
            row.verdicts.append(
                Verdict(
                    f"{case}: against {solver.who}",
                    statistics.median(solver.seconds) / own,
                    1.0,
                    note=reached,
                )
            )
    if not designs.has_algdesign():
        row.notes.append("R with AlgDesign is not installed: not measured")
    return row
