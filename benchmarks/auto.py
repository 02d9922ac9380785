"""What ``select(method="auto")`` proves, and how often the policy is enough.

    python benchmarks/auto.py [--sets 200]

For uniform sets of 50 and each K and least efficiency: how often the policy answered,
how many answers were proven optimal, the least D-efficiency that was proven, and the
median time of a call, everything warm.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np

import jaxcal

CASES = ((4, 0.999), (6, 0.99), (6, 0.999), (8, 0.99), (8, 0.999))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=200, help="candidate sets a row")
    number = parser.parse_args().sets
    print(" K  least efficiency  policy answered  proven optimal  least proven  ms")
    for k, least in CASES:
        sets = np.random.default_rng([41, k]).random((number + 1, 50, 3))
        found, taken = [], []
        for candidates in sets:
            begun = time.perf_counter()
            found.append(
                jaxcal.select(candidates, k, method="auto", least_efficiency=least)
            )
            taken.append(1e3 * (time.perf_counter() - begun))
        found = found[1:]  # the first call compiles
        answered = sum(answer.method == "policy" for answer in found)
        proven = sum(bool(answer.proven) for answer in found)
        lowest = min(float(answer.efficiency or 0.0) for answer in found)
        print(
            f"{k:2d} {least:17} {answered:16d} {proven:15d} {lowest:13.4f}"
            f" {statistics.median(taken[1:]):4.1f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
