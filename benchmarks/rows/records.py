"""The hardest optima: suites that others published, with what is proven in a minute.

    python -m benchmarks --only records --data FOLDER

FOLDER holds the suites' own files, data63.mat, data90.mat, data124.mat and E's *.cbf;
without it covariances and E are own draws. The other families are own draws always.
"""

from __future__ import annotations

import time
from collections.abc import Iterable

import numpy as np

from benchmarks import suites
from benchmarks.harness import Budget, Line, Row, Verdict
from benchmarks.suites import Instance
from jaxcal import Design
from jaxcal.models import Polynomial

NAME = "records"
TITLE = "Suites of the field, proven within a minute"

_SECONDS = 60  # wall time of one problem
_MANY = ((100_000, 12), (100_000, 20), (1_000_000, 12), (1_000_000, 20))  # M, K


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    seconds = float(budget.pick(_SECONDS, 1))
    for n in (63, 90, 124):
        matrix = suites.covariance(budget.data, n)
        sizes = range(2, n - 1) if n < 124 else range(10, 121, 10)
        some = [suites.entropy(matrix, s) for s in sizes][:: budget.pick(1, 20)]
        source = "its file" if budget.data else "own draw"
        _prove(row, f"entropy, {n} places ({source})", some, seconds, 0.01)
    for criterion, fusion in (("D", False), ("A", False), ("D", True), ("A", True)):
        some = [
            suites.family(criterion, m, m // 4, 0, correlated=related, fusion=fusion)
            for m in (80, 100, 120)[: budget.pick(3, 1)]
            for related in (False, True)
        ]
        title = f"{criterion}{', fusion' * fusion}, m = 80 to 120, n = m / 4"
        _prove(row, title, some, seconds, None)
    files = sorted(budget.data.glob("*.cbf")) if budget.data else []
    some = [suites.cbf(path) for path in files] or [
        suites.smallest(m, n, size, seed)
        for m, n, size in ((50, 7, 10), (80, 8, 12), (100, 10, 15))[: budget.pick(3, 1)]
        for seed in range(budget.pick(3, 1))
    ]
    _prove(row, f"E ({'files' if files else 'own draws'})", some, seconds, None)
    for count, k in _MANY[: budget.pick(4, 1)]:
        for times in (1, k):
            _of_many(row, count, k, times, budget)
    row.notes.append(
        f"wall time, {_SECONDS} s a problem at most; what is left is between the best "
        "found and the bound: nats of entropy, else one less the efficiency"
    )
    return row


def _design(one: Instance) -> Design:
    blocks = one.rows[:, None]
    return Design.from_blocks(blocks, prior=one.prior, max_replicates=one.most)


def _prove(
    row: Row, case: str, some: Iterable[Instance], seconds: float, nats: float | None
) -> None:
    """How many are proven to 1e-10, and what is left of the others: within ``nats`` of
    log det, else within a percent."""
    proven, near, left, times = 0, 0, [], []
    for one in some:
        begun = time.perf_counter()
        answer = _design(one).select(
            one.size, one.criterion, "exact", time_limit=seconds
        )
        times.append(time.perf_counter() - begun)
        assert answer.bound is not None and answer.efficiency is not None
        gap = answer.bound - answer.value if nats else 1.0 - answer.efficiency
        proven += answer.proven
        near += gap <= (nats or 0.01)
        if not answer.proven:
            left.append((gap, one.name))
    note = f"{near} within {f'{nats} nats' if nats else 'a percent'}; "
    note += f"slowest {max(times):.1f} s"
    if left:
        gap, name = max(left)
        note += f"; left open {len(left)}, the widest {gap:.2g} ({name})"
    row.lines.append(Line(case, f"proven of {len(times)}", float(proven), "", note))
    row.verdicts.append(Verdict(case, near / len(times), 1.0, unit=""))


def _of_many(row: Row, count: int, k: int, times: int, budget: Budget) -> None:
    """A quadratic in three inputs: the default in ten seconds against the best that
    the exchange finds in six times as long."""
    commands = np.random.default_rng(0).uniform(-1.0, 1.0, (count, 3))
    design = Design(commands, Polynomial(2, 3, 1), max_replicates=times)
    begun = time.perf_counter()
    answer = design.select(k, "D", time_limit=budget.pick(10, 1))
    seconds = time.perf_counter() - begun
    longer = max(
        design.select(k, "D", "exchange", seed=seed, time_limit=10.0).value
        for seed in range(1, budget.pick(7, 2))
    )
    share = float(np.exp((answer.value - max(longer, answer.value)) / 10))
    case = f"K = {k} of {count:,}, a quadratic in three" + ", repeated" * (times > 1)
    note = (
        f"of the best of six seeds; {answer.efficiency:.4f} proven in {seconds:.1f} s"
    )
    row.lines.append(Line(case, "jaxcal, default", share, "", note))
    row.verdicts.append(Verdict(case, share, 0.999, unit=""))
