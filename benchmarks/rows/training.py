"""Wall time from a cold start to a given share of the proven optimum.

Every contender begins as a new process with empty compilation caches, so imports and
compilation count; the greedy policy is measured every two seconds on the same 500 sets,
inside the time.
"""

from __future__ import annotations

import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

import numpy as np

from benchmarks.harness import ROOT, Budget, Line, Row, Verdict, available
from jaxcal.selection import exact_batch

NAME = "training"
TITLE = "Training from a cold start to a share of the optimum"
LEVELS = (0.8, 0.9, 0.95)
TARGET = 10.0

Curve = list[tuple[float, float]]  # seconds, ratio to exact


def contend(who: str, file: pathlib.Path, budget: float) -> Curve:
    """Run one contender with empty caches."""
    print(f"  {who}, at most {budget:.0f} s ...", flush=True)
    with tempfile.TemporaryDirectory() as empty:
        environment = {
            **os.environ,
            "JAX_COMPILATION_CACHE_DIR": f"{empty}/jax",
            "XDG_CACHE_HOME": empty,
        }
        command = [
            sys.executable,
            "-m",
            "benchmarks.peers.train_contender",
            who,
            str(file),
            str(budget),
            repr(time.time()),
        ]
        # A contender ends itself at its next look; one that compiles for longer is cut.
        with subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        ) as process:
            try:
                output, problem = process.communicate(timeout=budget + 60.0)
            except subprocess.TimeoutExpired:
                process.kill()
                output, problem = process.communicate()
    # A library may print something of its own between the pairs.
    pairs = [line.split() for line in output.splitlines() if line[:1].isdigit()]
    curve = [(float(seconds), float(ratio)) for seconds, ratio in pairs]
    if process.returncode > 0 and not curve:
        raise RuntimeError(f"{who}: " + "\n".join(problem.strip().splitlines()[-5:]))
    return curve


def reached(curve: Curve, level: float) -> float | None:
    """Seconds until the level was first seen."""
    return next((seconds for seconds, ratio in curve if ratio >= level), None)


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    sets = np.random.default_rng(20261123).random((500, 50, 3))
    best = exact_batch(sets, 4, num_outputs=1).log_det
    limit = 25.0 if budget.quick else budget.train_seconds
    peers = {"brax": "brax ppo.train", "sb3": "sb3-contrib MaskablePPO"}
    if not available("sb3_contrib"):
        del peers["sb3"]
        row.notes.append("sb3-contrib is not installed: not measured")
    with tempfile.TemporaryDirectory() as folder:
        file = pathlib.Path(folder) / "sets.npz"
        np.savez(file, sets=sets, best=best)
        # jaxcal twice, around the peers: what the machine did in between shows.
        own = [contend("jaxcal", file, limit)]
        curves = {name: contend(who, file, limit) for who, name in peers.items()}
        limits = dict.fromkeys(curves, limit)
        if not budget.quick:
            name = "jaxcal's PPO, the observation only"
            limits[name] = limit / 3.0  # no peer: a third of the time says enough
            curves[name] = contend("jaxcal-observation", file, limits[name])
            own.append(contend("jaxcal", file, limit))
    for level in LEVELS:
        case = f"det S / det S* = {level}"
        seconds = [reached(curve, level) for curve in own]
        known = [s for s in seconds if s is not None]
        mine = statistics.median(known) if len(known) == len(seconds) else None
        row.lines.append(Line(case, "jaxcal, compact preset", mine, "s"))
        times: list[float] = []
        for name, curve in curves.items():
            taken = reached(curve, level)
            top = max((ratio for _, ratio in curve), default=0.0)
            end = f"stopped after {limits[name]:.0f} s at {top:.3f}"
            note = end if taken is None else ""
            row.lines.append(Line(case, name, taken, "s", note))
            if taken is not None and name in peers.values():
                times.append(taken)
        never = "" if times else f"no peer gets there in {limit:.0f} s: at least this"
        value = None if mine is None else min([*times, limit]) / mine
        row.verdicts.append(
            Verdict(f"{case}: against the better peer", value, TARGET, note=never)
        )
    row.series = {"jaxcal": own, **curves}
    row.notes.append(
        "jaxcal's compact network sees the candidates' geometry and look-ahead, the "
        "peers the paper's 210 numbers: the row compares what a user gets from each; "
        "the line 'the observation only' is jaxcal's trainer with the peers' sight"
    )
    row.notes.append("MaskablePPO runs with its defaults; nothing was tuned for it")
    return row
