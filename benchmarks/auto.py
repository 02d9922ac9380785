"""What ``select(method="auto")`` proves, and in what time.

    python benchmarks/auto.py [--sets 200]

For uniform sets of 50 or 500 and each K and least efficiency: how many answers were
proven optimal, the least D-efficiency that was proven, and the median time of a call,
everything warm.
"""

from __future__ import annotations

import argparse
import itertools
import statistics
import time

import numpy as np

import jaxcal

CASES = ((50, 4), (50, 6), (50, 8), (500, 4), (500, 8), (500, 12))
LEAST = (0.99, 0.999)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=200, help="candidate sets a row")
    number = parser.parse_args().sets
    print("  M   K  least efficiency  proven optimal  least proven     ms")
    for (m, k), least in itertools.product(CASES, LEAST):
        sets = np.random.default_rng([41, k]).random((number + 1, m, 3))
        found, taken = [], []
        for candidates in sets:
            begun = time.perf_counter()
            found.append(
                jaxcal.select(candidates, k, method="auto", least_efficiency=least)
            )
            taken.append(1e3 * (time.perf_counter() - begun))
        found = found[1:]  # the first call compiles
        proven = sum(bool(answer.proven) for answer in found)
        lowest = min(answer.efficiency for answer in found)
        print(
            f"{m:3d} {k:3d} {least:17} {proven:15d} {lowest:13.4f}"
            f" {statistics.median(taken[1:]):6.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
