"""How good and how fast each selection method is, against the proven optimum.

    python benchmarks/selection_speed.py [--sets 100] [--large-sets 20] [--seed 1]

Candidates are uniform in [0, 1]^3. A row: the method, M, K, the cap on replicates, the
mean of det S / det S*, the share of sets where the optimum is hit (log det within 1e-8)
and milliseconds a ``jaxcal.select`` call, warm.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from jaxcal.selection import exact_batch, select

HIT = 1e-8


def row(method: str, sets: np.ndarray, k: int, cap: int, optima: np.ndarray) -> str:
    """One line of the table."""
    select(sets[0], k, method, max_replicates=cap)
    log_dets, times = [], []
    for candidates in sets:
        start = time.perf_counter()
        found = select(candidates, k, method, max_replicates=cap)
        times.append(1e3 * (time.perf_counter() - start))
        log_dets.append(found.log_det)
    behind = np.array(log_dets) - optima
    hits = (np.abs(behind) <= HIT).mean()
    return (
        f"{method:9} {sets.shape[1]:4d} {k:3d} {cap:4d} {np.exp(behind).mean():15.4f} "
        f"{hits:9.1%} {np.median(times):10.2f} {max(times):8.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=100, help="sets of 50 candidates")
    parser.add_argument("--large-sets", type=int, default=20, help="sets of 500")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    print("method       M   K  cap  ratio_to_exact  hit_rate  median_ms   max_ms")
    for num_sets, m in ((arguments.sets, 50), (arguments.large_sets, 500)):
        sets = rng.random((num_sets, m, 3))
        for k in (4, 8, 12):
            for cap in (1, 2, k):
                found = [select(c, k, "exact", max_replicates=cap) for c in sets]
                optima = np.array([each.log_det for each in found])
                for method in ("random", "greedy", "exchange", "exact"):
                    print(row(method, sets, k, cap, optima), flush=True)
    for k in (4, 8, 12):
        episodes = rng.random((1000, 50, 3))
        print(
            f"exact_batch, 1000 sets, K={k}: {exact_batch(episodes, k).seconds:.2f} s"
        )


if __name__ == "__main__":
    main()
