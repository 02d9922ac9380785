"""One design for 50 scenarios: greedy, exchange, and proofs of 99 %.

M = 200, K = 12, p = 12, three readings a candidate. A block of scenario s is B + a E_s,
B and all E_s standard normal, so a = 0.1 is 10 % apart. A proof that is open after 10 s
counts with the efficiency that it reached; ``--only scenarios`` takes ten minutes.
"""

from __future__ import annotations

import statistics
import time
from typing import Any

import numpy as np

from benchmarks.harness import Budget, Line, Row, Verdict
from jaxcal import Design, Mean, Worst
from jaxcal.selection.exact.exact import relaxed
from jaxcal.selection.exchange.exchange import exchange_indices, greedy_indices

NAME = "scenarios"
TITLE = "One design for 50 scenarios"

_COUNT, _M, _Q, _P, _K = 50, 200, 3, 12, 12
_APART = (0.1, 0.5)
_PROBLEMS = {"D": 10, "A": 3, "I": 3, "E": 3}  # of which proofs are asked for
_SEARCHES = 10  # problems of greedy and exchange
_LIMIT, _WANTED = 10.0, 0.99
_WANTED_MS = 100.0


def design(seed: int, apart: float) -> Design:
    """One of the problems."""
    rng = np.random.default_rng(seed)
    shared = rng.standard_normal((_M, _Q, _P))
    return Design.from_blocks(
        shared + apart * rng.standard_normal((_COUNT, _M, _Q, _P))
    )


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    limit = budget.pick(int(_LIMIT), 1)
    for apart in _APART:
        designs = [design(seed, apart) for seed in range(budget.pick(_SEARCHES, 1))]
        for joined in (Mean, Worst):
            for letter, many in _PROBLEMS.items():
                criterion = joined(letter)
                case = f"{criterion}, {apart:.0%} apart"
                _searches(row, case, designs, criterion)
                _proofs(row, case, designs[:many], criterion, limit)
                _root(row, case, designs[0], criterion, budget)
    for letter in "DA":  # of one scenario, as many readings as parameters
        blocks = np.random.default_rng(0).standard_normal((_M, 1, _P))
        one = [Design.from_blocks(blocks)]
        _proofs(row, f"{letter}, one scenario, one reading", one, letter, limit)
    row.notes.append(
        "processor time of one thread; a proof is `select(12, criterion, "
        f"least_efficiency={_WANTED}, time_limit={limit})`, the whole call"
    )
    return row


def _searches(
    row: Row, case: str, designs: list[Design], criterion: Mean | Worst
) -> None:
    """Greedy and exchange alone, the problem being made."""
    ways = {"greedy": greedy_indices, "exchange": exchange_indices}
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    values: dict[str, list[float]] = {name: [] for name in ways}
    for one in designs:
        problem = one.problem(_K, criterion)
        for name, way in ways.items():
            begun = time.process_time()
            chosen = way(problem)
            seconds[name].append(time.process_time() - begun)
            values[name].append(float(problem.values(chosen[None])[0][0]))
    for name in ways:
        middle = 1e3 * statistics.median(seconds[name])
        note = f"median value {statistics.median(values[name]):.5g}"
        row.lines.append(Line(case, name, middle, "ms", note))
        row.verdicts.append(Verdict(f"{case}: {name}", middle, _WANTED_MS, False, "ms"))


def _root(
    row: Row, case: str, one: Design, criterion: Mean | Worst, budget: Budget
) -> None:
    """What the relaxation alone proves of a selection found with much time."""
    problem = one.problem(_K, criterion)
    starts = budget.pick(12 if problem.criterion.kind == "least" else 100, 2)
    chosen = np.sort(exchange_indices(problem, starts, seed=1))
    best, usual = problem.values(
        np.stack([chosen, np.sort(exchange_indices(problem))])
    )[0]
    bound = float(problem.criterion.reported(relaxed(problem, chosen)))
    share = problem.criterion.efficiency
    note = f"best of {starts} starts; the default exchange: {share(usual, best):.4f}"
    row.lines.append(
        Line(case, "efficiency by the relaxation", share(best, bound), "", note)
    )


def _proofs(
    row: Row, case: str, designs: list[Design], criterion: Any, limit: float
) -> None:
    seconds, efficiencies = [], []
    for one in designs:
        begun = time.process_time()
        answer = one.select(_K, criterion, least_efficiency=_WANTED, time_limit=limit)
        seconds.append(time.process_time() - begun)
        efficiencies.append(answer.efficiency)
    proven = sum(efficiency >= _WANTED for efficiency in efficiencies)
    middle = statistics.median(efficiencies)
    note = (
        f"{proven} of {len(designs)} proven, efficiency at least {middle:.4f} "
        f"(median), {min(efficiencies):.4f} (least)"
    )
    median = statistics.median(seconds) if middle >= _WANTED else None
    row.lines.append(Line(case, "proof of 0.99", median, "s", note))
    row.verdicts.append(
        Verdict(f"{case}: proof of 0.99", median, _LIMIT, False, "s", note)
    )
