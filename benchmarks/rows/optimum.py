"""The proven optimum, against brute force and against heuristics that prove nothing."""

from __future__ import annotations

import statistics

from benchmarks.harness import Budget, Line, Row, Verdict, median_ratio
from benchmarks.peers import designs as peer_designs
from benchmarks.rows.designs import CASES, Solver, measure, own, peers, sets_of
from jaxcal import select

NAME = "optimum"
TITLE = "The exact optimum, proven"


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    for m, k in CASES:
        case = f"M = {m}, K = {k}"
        print(f"  {case} ...", flush=True)
        sets = sets_of(m, budget)
        distinct, repeats = own("exact", False), own("exact", True)
        others, missing = peers()
        brute = Solver(
            "brute force, NumPy", False, peer_designs.brute_force, only_k=4, only_m=50
        )
        heuristics = [s for s in others if s.fits(m, k)]
        solvers = [distinct, repeats, *heuristics]
        if brute.fits(m, k):
            solvers.append(brute)
        measure(solvers, sets, k)
        for solver in solvers:
            milliseconds = 1e3 * statistics.median(solver.seconds)
            row.lines.append(Line(case, solver.who, milliseconds, "ms", solver.quality))
        proven = all(
            select(c, k, "exact", max_replicates=cap).proven
            for c in sets
            for cap in (1, k)
        )
        row.verdicts.append(
            Verdict(f"{case}: proven in every set", float(proven), 1.0, unit="")
        )
        for solver in solvers[2:]:
            mine = repeats if solver.repeats else distinct
            row.verdicts.append(
                Verdict(
                    f"{case}: against {solver.who}",
                    median_ratio(solver.seconds, mine.seconds),
                    1.0,
                )
            )
        if m == 50 and k == 4:
            row.notes += missing
    for m, k in CASES:
        if (m, k) != (50, 4):
            subsets = peer_designs.num_subsets(m, k)
            row.notes.append(
                f"brute force at M = {m}, K = {k} is {subsets:.1e} subsets: not run"
            )
    row.notes.append(
        "pyoptex and pydoe may repeat a candidate: their ratio is to the optimum with "
        "repeats, and the speed beside them is that of exact with repeats"
    )
    return row
