"""How the time of a decision grows with M, K, the inputs and the batch.

The exponent is the slope of log time over log size in the upper half of the sizes. The
policy's memory at the largest M is that of a process of its own.
"""

from __future__ import annotations

import functools
import json
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.harness import Budget, Line, Row, Verdict, fresh_process
from jaxcal.selection import exact_batch, exchange_batch, greedy_batch, select
from jaxcal.selection.policy import select_batch

NAME = "scaling"
TITLE = "Growth with candidates M, postures K, inputs and batch"
METHODS = ("greedy", "exchange", "exact", "policy")
LIMIT = 60.0  # seconds a call: beyond, larger sizes are left out

_PEAK = """
import json, pathlib, time
import numpy as np, jaxcal
candidates = np.random.default_rng(0).random((M, 3))
jaxcal.select(candidates[:50], 4, METHOD)
begun = time.perf_counter()
found = jaxcal.select(candidates, 4, METHOD)
seconds = time.perf_counter() - begun
for line in pathlib.Path("/proc/self/status").read_text().splitlines():
    if line.startswith("VmHWM"):
        peak = int(line.split()[1]) / 1024
best = jaxcal.select(candidates, 4, "exact").log_det
print(json.dumps({"peak": peak, "seconds": seconds, "behind": found.log_det - best}))
"""


def exponent(sizes: list[int], seconds: list[float]) -> float:
    """Slope in the upper half, by least squares."""
    half = max(2, (len(sizes) + 1) // 2)
    x, y = np.log(sizes[-half:]), np.log(seconds[-half:])
    return float(np.polyfit(x, y, 1)[0]) if len(sizes) > 1 else float("nan")


def curve(
    sizes: tuple[int, ...], call: Callable[[int], Callable[[], Any]], rounds: int
) -> dict[str, Any]:
    """Median seconds at every size, until one takes longer than the limit."""
    done: list[int] = []
    taken: list[float] = []
    for size in sizes:
        once = call(size)
        begun = time.perf_counter()
        once()
        compiling = time.perf_counter() - begun
        times = []
        for _ in range(rounds):
            begun = time.perf_counter()
            once()
            times.append(time.perf_counter() - begun)
            if sum(times) > LIMIT / 4:
                break
        done.append(size)
        taken.append(statistics.median(times))
        if taken[-1] > LIMIT / 4 or compiling > LIMIT:
            break
    return {"size": done, "seconds": taken, "exponent": exponent(done, taken)}


def selecting(m: int, k: int, n: int, method: str) -> Callable[[], Any]:
    """A ``select`` call; exact above n + 1 is given a minute."""
    candidates = np.random.default_rng([m, k, n]).random((m, n))
    limit = LIMIT if method == "exact" else None
    return lambda: select(candidates, k, method, time_limit=limit)


def batched(size: int, method: str) -> Callable[[], Any]:
    sets = np.random.default_rng(size).random((size, 50, 3))
    calls: dict[str, Callable[[], Any]] = {
        "greedy": lambda: greedy_batch(sets, 4),
        "exchange": lambda: exchange_batch(sets, 4),
        "exact": lambda: exact_batch(sets, 4),
        "policy": lambda: select_batch(sets, 4),
    }
    return calls[method]


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    quick = budget.quick
    axes: dict[str, tuple[tuple[int, ...], Callable[[int, str], Callable[[], Any]]]] = {
        "candidates M (K = 4, 3 inputs)": (
            (50, 200) if quick else (50, 100, 200, 500, 1000, 2000, 5000),
            lambda size, method: selecting(size, 4, 3, method),
        ),
        "postures K (M = 200, 3 inputs)": (
            (4, 8) if quick else (4, 8, 12, 20, 35, 50),
            lambda size, method: selecting(200, size, 3, method),
        ),
        "inputs (M = 100, K = inputs + 1)": (
            (1, 2) if quick else (1, 2, 3, 4, 6, 8),
            lambda size, method: selecting(100, size + 1, size, method),
        ),
        "sets at once (M = 50, K = 4)": (
            (1, 8) if quick else (1, 8, 64, 512, 4096),
            lambda size, method: batched(size, method),
        ),
    }
    for axis, (sizes, make) in axes.items():
        row.series[axis] = {}
        for method in METHODS:
            print(f"  {axis}: {method} ...", flush=True)
            call = functools.partial(make, method=method)
            found = curve(sizes, call, budget.pick(3, 1))
            row.series[axis][method] = found
            row.lines.append(
                Line(
                    axis,
                    method,
                    found["exponent"],
                    "exponent",
                    f"{found['seconds'][-1]:.3g} s at {found['size'][-1]:,}",
                )
            )
    m = budget.pick(5000, 200)
    for method in METHODS:
        code = _PEAK.replace("(M, 3)", f"({m}, 3)").replace("METHOD", repr(method))
        found = json.loads(fresh_process(code))
        ratio = float(np.exp(found["behind"]))
        row.lines.append(
            Line(
                f"M = {m}, K = 4, new process",
                method,
                found["peak"],
                "MiB",
                f"highest memory; ratio {ratio:.4f}; "
                f"first call {found['seconds']:.1f} s",
            )
        )
        if method == "policy":
            row.verdicts.append(
                Verdict(
                    f"policy at M = {m}: highest memory",
                    found["peak"] / 1024,
                    2.0,
                    larger=False,
                    unit="GiB",
                )
            )
    return row
