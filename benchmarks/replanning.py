"""Re-planning in the middle of a run: the policy against the exact conditional optimum.

    python benchmarks/replanning.py [--sets 300] [--candidates 50] [--seed 1]

Candidates are uniform in [0, 1]^3. Two ways to be in the middle of a run:

unreachable  the policy chose K; its first r are measured, then the next it wanted turns
             out unreachable: go on from the r without that one
random       r random postures were measured already, and 30 % of the others are masked

A row: how, K, r, the mean of det S / det S*, the share of sets where the conditional
optimum is hit (log det within 1e-8), the mean D-efficiency, and the worst one, for one
greedy pass of the policy, then the same ratio for plain greedy completion. S* is the
best among all selections that hold the r postures and respect the mask, proven.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.regression import log_det_information
from jaxcal.selection import exact_batch, greedy_batch
from jaxcal.selection.policy import select_batch

HIT = 1e-8
MASKED = 0.3

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


def unreachable_cases(sets: np.ndarray, k: int, r: int) -> tuple[Indices, Mask]:
    """The policy's first r picks as required, its next one masked: (B, r), (B, M)."""
    wanted = select_batch(sets, k)
    available = np.ones(sets.shape[:2], dtype=bool)
    available[np.arange(len(sets)), wanted[:, r]] = False
    return wanted[:, :r], available


def random_cases(
    sets: np.ndarray, r: int, rng: np.random.Generator
) -> tuple[Indices, Mask]:
    """r random postures as required, and a mask that leaves them: (B, r), (B, M)."""
    order = rng.permuted(np.tile(np.arange(sets.shape[1]), (len(sets), 1)), axis=1)
    available = rng.random(sets.shape[:2]) >= MASKED
    np.put_along_axis(available, order[:, :r], True, axis=1)
    return order[:, :r], available


def row(sets: np.ndarray, k: int, required: Indices, available: Mask) -> str:
    """The figures of one line of the table."""
    options = {"available": available, "required": required}
    best = exact_batch(sets, k, **options)
    assert best.proven.all()
    picked = select_batch(sets, k, **options)
    chosen = np.take_along_axis(sets, picked[..., None], axis=1)
    behind = np.asarray(log_det_information(chosen)) - best.log_det
    plain = greedy_batch(sets, k, **options).log_det - best.log_det
    efficiency = np.exp(behind / 12)
    return (
        f"{np.exp(behind).mean():8.4f} {(behind > -HIT).mean():9.1%} "
        f"{efficiency.mean():11.5f} {efficiency.min():8.4f} {np.exp(plain).mean():8.4f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=300, help="candidate sets a row")
    parser.add_argument("--candidates", type=int, default=50, help="M")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    print("case         K  r    ratio  hit_rate  efficiency    worst   greedy")
    for k in (4, 6, 8):
        for r in (1, 2, 3):
            sets = rng.random((arguments.sets, arguments.candidates, 3))
            for name, (required, available) in (
                ("unreachable", unreachable_cases(sets, k, r)),
                ("random", random_cases(sets, r, rng)),
            ):
                print(f"{name:11} {k:2d} {r:2d} {row(sets, k, required, available)}")


if __name__ == "__main__":
    main()
