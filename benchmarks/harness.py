"""What every row shares: how time is taken, and what a row's result is.

Times are wall times of one call, taken in turn (A B A B ...) so that a busy machine
slows all alike; a figure is the median over the rounds, a ratio the median of the
ratios within a round.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.metadata
import os
import pathlib
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

CORES = len(os.sched_getaffinity(0))
ROOT = pathlib.Path(__file__).resolve().parent.parent
_PACKAGES = (
    "jax",
    "brax",
    "numpy",
    "scipy",
    "torch",
    "gymnasium",
    "stable-baselines3",
    "sb3-contrib",
    "pydoe",
    "pyoptex",
)


@dataclasses.dataclass(frozen=True)
class Budget:
    """How much a row may spend."""

    quick: bool = False  # seconds a row: figures that only show that it runs
    train_seconds: float = 600.0  # of each peer in the row "training"
    data: pathlib.Path | None = None  # folder of the suites' own files, for "records"

    def pick(self, full: int, quick: int) -> int:
        """A size: the full one, or the quick one."""
        return quick if self.quick else full


@dataclasses.dataclass(frozen=True)
class Line:
    """One measured figure."""

    case: str  # what is measured, e.g. "M = 50, K = 4"
    who: str  # "jaxcal ..." or the peer
    value: float | None  # None where it never got there
    unit: str
    note: str = ""  # quality reached, settings


@dataclasses.dataclass(frozen=True)
class Verdict:
    """A promise: a ratio or a figure, and what it has to be."""

    case: str
    value: float | None  # None where there is nothing to divide by
    target: float
    larger: bool = True  # True: at least the target; False: at most
    unit: str = "x"
    note: str = ""

    @property
    def met(self) -> bool:
        if self.value is None:
            return False
        wanted, value = self.target, self.value
        return bool(value >= wanted if self.larger else value <= wanted)


@dataclasses.dataclass
class Row:
    """One row of the table of docs/performance.md."""

    name: str
    title: str
    lines: list[Line] = dataclasses.field(default_factory=list)
    verdicts: list[Verdict] = dataclasses.field(default_factory=list)
    notes: list[str] = dataclasses.field(default_factory=list)
    series: dict[str, Any] = dataclasses.field(default_factory=dict)  # for figures


def interleaved(
    functions: Mapping[str, Callable[[], Any]], rounds: int, warm: int = 1
) -> dict[str, list[float]]:
    """Seconds of every function in every round, called in turn.

    Args:
        functions: name to a call that returns when its work is done.
        rounds: timed calls of each.
        warm: calls of each before, not timed: compilation, caches.
    """
    for function in functions.values():
        for _ in range(warm):
            function()
    seconds: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds):
        for name, function in functions.items():
            begun = time.perf_counter()
            function()
            seconds[name].append(time.perf_counter() - begun)
    return seconds


def median_ratio(slower: list[float], faster: list[float]) -> float:
    """Median over the rounds of slower / faster."""
    return statistics.median(a / b for a, b in zip(slower, faster, strict=True))


def side_by_side(calls: Sequence[Callable[[], Any]]) -> Callable[[], Any]:
    """A call that makes all of them at once, each in a thread."""
    if len(calls) == 1:
        return calls[0]
    pool = ThreadPoolExecutor(len(calls))
    return lambda: list(pool.map(lambda call: call(), calls))


def copy_bandwidth() -> float:
    """Bytes a second that a plain copy reads and writes, one thread a core."""
    arrays = [np.zeros(2**24, np.float32) for _ in range(2 * CORES)]
    copies = [
        functools.partial(np.copyto, target, source)
        for target, source in zip(arrays[:CORES], arrays[CORES:], strict=True)
    ]
    seconds = interleaved({"copy": side_by_side(copies)}, 5)["copy"]
    return sum(array.nbytes for array in arrays) / min(seconds)


def fresh_process(
    code: str, environment: Mapping[str, str] | None = None, timeout: float = 900.0
) -> str:
    """Run Python code in a new process at the repository's root; its output.

    Raises:
        RuntimeError: it failed; with the last lines it wrote.
    """
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        env={**os.environ, **(environment or {})},
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
    )
    if done.returncode:
        raise RuntimeError("\n".join(done.stderr.strip().splitlines()[-5:]))
    return done.stdout


def available(module: str) -> bool:
    """Whether a peer can be imported."""
    import importlib.util

    return importlib.util.find_spec(module) is not None


def machine() -> dict[str, Any]:
    """What the figures depend on."""
    versions = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return {
        "cores": CORES,
        "processor": _processor(),
        "load_before": round(os.getloadavg()[0], 2),
        "threads": "every library's default, at most one a core",
        "versions": versions,
    }


def _processor() -> str:
    information = pathlib.Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
