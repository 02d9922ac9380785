"""Milliseconds of ``jaxcal.identify``, warm: twelve affine rows and 62 real contacts.

    OPENBLAS_NUM_THREADS=1 taskset -c 0 python -m benchmarks.identify_speed

The rows are four postures of three inputs, read three times each, and three outputs;
the contacts those of examples/contacts, of a Panda's ball in two sockets.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

import jaxcal
from benchmarks.harness import ROOT


def milliseconds(call: Callable[[], Any], rounds: int) -> tuple[float, float]:
    """Median and least of warm calls."""
    for _ in range(max(3, rounds // 20)):
        call()
    seconds = []
    for _ in range(rounds):
        begun = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begun)
    return 1e3 * float(np.median(seconds)), 1e3 * min(seconds)


def affine() -> Callable[[], Any]:
    rng = np.random.default_rng(0)
    postures = np.repeat(rng.uniform(0.0, 1.0, (4, 3)), 3, axis=0)
    matrix = np.eye(3) + 0.05 * rng.normal(size=(3, 3))
    readings = postures @ matrix.T + 0.01 * rng.normal(size=(12, 3))
    return lambda: jaxcal.identify(postures, readings)


def contacts() -> Callable[[], Any]:
    sys.path.insert(0, str(ROOT / "examples"))
    import contacts as example

    arm, table = example.arm("panda_1"), example.load("panda_1")["front"]
    commands = np.column_stack(table)
    zeros = np.zeros((len(commands), 3))
    return lambda: jaxcal.identify(commands, zeros, model=arm)


def main() -> None:
    warnings.simplefilter("ignore", UserWarning)
    print("case              median_ms   least_ms")
    for name, call, rounds in (
        ("12 affine rows", affine(), 3000),
        ("62 contacts", contacts(), 60),
    ):
        median, least = milliseconds(call, rounds)
        print(f"{name:17} {median:9.3f}  {least:9.3f}", flush=True)


if __name__ == "__main__":
    main()
