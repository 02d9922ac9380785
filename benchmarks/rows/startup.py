"""From the command to the first result: with empty caches, and the second time.

``train.py`` to its first update and ``evaluate.py`` to its first result, each as a new
process, with empty caches and with those the first run left. Training compiles and the
second run must gain by it; evaluating the shipped policy compiles nothing.
"""

from __future__ import annotations

import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time

from benchmarks.harness import ROOT, Budget, Line, Row, Verdict

NAME = "startup"
TITLE = "Start-up: the second run in a new process against the first"
TARGET = 3.0  # first run over second, of the command that compiles
LIMIT = 1.0  # seconds of the first run, of the command that compiles nothing
_COMMANDS = {
    "train.py to the first update": ["train.py", "--episodes", "2048", "--out", "OUT"],
    "evaluate.py to the first result": [
        "evaluate.py",
        "--episodes",
        "64",
        "--methods",
        "policy,exact",
        "--quiet",
    ],
}


def seconds_of(command: list[str], caches: str) -> float:
    """Wall time of a command with its caches in one folder."""
    environment = {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": f"{caches}/jax",
        "XDG_CACHE_HOME": caches,
    }
    with tempfile.TemporaryDirectory() as folder:
        out = str(pathlib.Path(folder) / "run")
        begun = time.perf_counter()
        subprocess.run(
            [sys.executable] + [out if part == "OUT" else part for part in command],
            cwd=ROOT,
            env=environment,
            check=True,
            capture_output=True,
        )
        return time.perf_counter() - begun


def run(budget: Budget) -> Row:
    row = Row(NAME, TITLE)
    rounds = budget.pick(3, 1)
    for name, command in _COMMANDS.items():
        first, second = [], []
        for _ in range(rounds):
            with tempfile.TemporaryDirectory() as caches:
                first.append(seconds_of(command, caches))
                second.append(seconds_of(command, caches))
        row.lines += [
            Line(name, "first run, empty caches", statistics.median(first), "s"),
            Line(name, "second run", statistics.median(second), "s"),
        ]
        if name.startswith("train"):
            ratio = statistics.median(a / b for a, b in zip(first, second, strict=True))
            row.verdicts.append(Verdict(name, ratio, TARGET))
        else:
            taken = statistics.median(first)
            row.verdicts.append(Verdict(name, taken, LIMIT, larger=False, unit="s"))
    row.notes.append("a whole command with one update, the final save included")
    return row
