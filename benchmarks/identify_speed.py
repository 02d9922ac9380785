"""Milliseconds of ``jaxcal.identify``, warm: twelve affine rows and 62 real contacts.

    OPENBLAS_NUM_THREADS=1 taskset -c 0 python -m benchmarks.identify_speed
    OPENBLAS_NUM_THREADS=1 python -m benchmarks.identify_speed many   once each

The rows are four postures of three inputs, read three times each, and three outputs;
the contacts those of examples/contacts, of a Panda's ball in two sockets. ``many``:
10,000 positions of arms with 7, 15 and 30 joints, and 200 postures with a ball of 30
joints in a socket, in seconds of the clock and of the processor.
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
from jaxcal.arms.sensors import Socket
from jaxcal.models import SerialChain


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


def arm(joints: int, **more: Any) -> SerialChain:
    rows = [
        (0.0 if i % 2 else 50.0, -90.0 if i % 2 else 90.0, 100.0 + 40.0 * (i % 3), 0.0)
        for i in range(joints)
    ]
    return SerialChain.from_dh(rows, tool=(0, 0, 80), **more)


def positions(joints: int) -> Callable[[], Any]:
    rng, chain = np.random.default_rng(1), arm(joints)
    postures = rng.uniform(-90.0, 90.0, (10_000, joints))
    off = 0.3 * chain.parameter_sizes() * rng.normal(size=chain.num_parameters)
    readings = chain.predict(postures, chain.nominal + off)
    readings += rng.normal(0.0, 0.05, readings.shape)
    return lambda: jaxcal.identify(postures, readings, model=chain)


def socket_of(joints: int) -> Callable[[], Any]:
    place = arm(joints).predict(np.full((1, joints), 20.0))
    chain = arm(joints, sensor=Socket(1, place))
    return lambda: chain.postures(200)


def once() -> None:
    print("case                           clock_s  processor_s")
    cases = [(f"10,000 positions, {j} joints", positions(j)) for j in (7, 15, 30)]
    for name, call in [*cases, ("200 postures in a socket, 30", socket_of(30))]:
        begun, spent = time.perf_counter(), time.process_time()
        call()
        print(
            f"{name:29} {time.perf_counter() - begun:8.2f}  "
            f"{time.process_time() - spent:11.2f}",
            flush=True,
        )


def main() -> None:
    warnings.simplefilter("ignore", UserWarning)
    if "many" in sys.argv[1:]:
        return once()
    print("case              median_ms   least_ms")
    for name, call, rounds in (
        ("12 affine rows", affine(), 3000),
        ("62 contacts", contacts(), 60),
    ):
        median, least = milliseconds(call, rounds)
        print(f"{name:17} {median:9.3f}  {least:9.3f}", flush=True)


if __name__ == "__main__":
    main()
