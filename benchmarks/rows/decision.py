"""One decision on a rig: ``jaxcal.select`` in a new process, and again in the same."""

from __future__ import annotations

import json
import statistics

from benchmarks.harness import Budget, Line, Row, Verdict, fresh_process

NAME = "decision"
TITLE = "One decision on a rig: 4 of 50 by the shipped policy"

_CODE = """
import json, time
begun = time.perf_counter()
import numpy as np
import jaxcal
sets = np.random.default_rng(0).random((41, 50, 3))
jaxcal.select(sets[0], 4, METHOD)
cold = time.perf_counter() - begun
warm = []
for candidates in sets[1:]:
    begun = time.perf_counter()
    jaxcal.select(candidates, 4, METHOD)
    warm.append(time.perf_counter() - begun)
print(json.dumps({"cold": cold, "warm": sorted(warm)[len(warm) // 2]}))
"""


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    rounds = budget.pick(5, 1)
    for method in ("policy", "exchange", "exact"):
        code = _CODE.replace("METHOD", repr(method))
        fresh_process(code)  # numba compiles at a first use on this machine
        taken = [json.loads(fresh_process(code)) for _ in range(rounds)]
        cold = statistics.median(t["cold"] for t in taken)
        warm = 1e3 * statistics.median(t["warm"] for t in taken)
        row.lines += [
            Line("new process", f"jaxcal {method}", cold, "s", "imports included"),
            Line("same process", f"jaxcal {method}", warm, "ms"),
        ]
        if method == "policy":
            row.verdicts += [
                Verdict("select, new process", cold, 3.0, larger=False, unit="s"),
                Verdict("select, same process", warm, 5.0, larger=False, unit="ms"),
            ]
    row.notes.append(
        "compiled code is on disk, as after any earlier use on the machine; "
        "without it see the row startup"
    )
    return row
