"""The first answer: ``jaxcal.select`` in a new process, and again in the same.

"First use" is a process that finds no cache at all, not even Python's compiled modules.
"""

from __future__ import annotations

import json
import statistics
import tempfile

from benchmarks.harness import Budget, Line, Row, Verdict, fresh_process

NAME = "decision"
TITLE = "The first answer, and one decision on a rig"

_CODE = """
import json, time
begun = time.perf_counter()
import numpy as np
import jaxcal
from jaxcal import select
rng = np.random.default_rng(0)
sets = rng.random((41, 50, 3))
CALL
cold = time.perf_counter() - begun
warm = []
for candidates in sets[1:REPEATS]:
    sets = sets[1:]
    begun = time.perf_counter()
    CALL
    warm.append(time.perf_counter() - begun)
print(json.dumps({"cold": cold, "warm": sorted(warm)[len(warm) // 2]}))
"""
_ARM = """
from jaxcal.models import SerialChain
rows = [(0, 90, 0.4, 0), (0.5, 0, 0, 0), (0.4, 0, 0, 0), (0.1, 90, 0.1, 0)]
select(rng.uniform(-90, 90, (200, 4)), 8, model=SerialChain.from_dh(rows))
"""
# what; calls in the same process; seconds at first use, in a new process
_CASES = {
    "4 of 50": ("select(sets[0], 4)", 41, 1.0, 0.4),
    "6 of 50": ("select(sets[0], 6)", 41, 1.0, 0.4),
    "4 of 50, random": ("select(sets[0], 4, 'random')", 41, 1.0, 0.4),
    "6 of 50, exchange": ("select(sets[0], 6, 'exchange')", 41, 1.0, 0.4),
    "8 of 50, exchange": ("select(sets[0], 8, 'exchange')", 41, 1.0, 0.4),
    "12 of 50, exchange": ("select(sets[0], 12, 'exchange')", 41, 1.0, 0.4),
    "4 of 50, policy": ("select(sets[0], 4, 'policy')", 41, 1.0, 0.4),
    "12 of 200 with 6 inputs, policy": (
        "select(rng.random((200, 6)), 12, 'policy')", 41, 1.0, 0.5,
    ),
    "arm, 8 of 200": (_ARM, 2, 3.0, 2.6),
}  # fmt: skip


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    rounds = budget.pick(3, 1)
    for case, (call, repeats, first_wanted, wanted) in _CASES.items():
        indented = call.strip().replace("\n", "\n    ")
        code = _CODE.replace("\nCALL", f"\n{call.strip()}").replace("CALL", indented)
        code = code.replace("REPEATS", str(repeats))
        first = []
        for _ in range(rounds):
            with tempfile.TemporaryDirectory() as empty:
                caches = {"PYTHONPYCACHEPREFIX": empty, "XDG_CACHE_HOME": empty}
                first.append(json.loads(fresh_process(code, caches))["cold"])
        taken = [json.loads(fresh_process(code)) for _ in range(rounds)]
        cold = statistics.median(t["cold"] for t in taken)
        warm = 1e3 * statistics.median(t["warm"] for t in taken)
        new = statistics.median(first)
        row.lines += [
            Line("first use", case, new, "s", "imports included"),
            Line("new process", case, cold, "s", "imports included"),
            Line("same process", case, warm, "ms"),
        ]
        row.verdicts += [
            Verdict(f"{case}, first use", new, first_wanted, larger=False, unit="s"),
            Verdict(f"{case}, new process", cold, wanted, larger=False, unit="s"),
        ]
    row.notes.append("of the arm 2 s are its time limit")
    return row
