"""The agent of the paper's 210 numbers at other K and M, one set of weights.

    python benchmarks/observation.py [--sizes 50:4,50:5,...] [--sets 200]
        [--checkpoint checkpoints/paper.npz]

For each M:K, means over the same sets of uniform candidates: det S / det S* of the 12
parameters, the share of sets where the optimum is hit, and the time of one set, of the
agent, of greedy choice and of exchange. S* is the proven optimum, or where the search
takes over two seconds a set the best that any of the methods found.
"""

from __future__ import annotations

import argparse
import pathlib
import time
from collections.abc import Callable

import numpy as np

import jaxcal
from jaxcal.information.regression import log_det_information
from jaxcal.learning.runtime import processes
from jaxcal.selection.policy import select_batch

SIZES = "50:4,50:5,50:6,50:8,20:4,100:4,200:4"
HIT = 1e-8
SECONDS = 2.0
TIMED = 32  # sets, of the agent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", default=SIZES, help="M:K, separated by commas")
    parser.add_argument("--sets", type=int, default=200, help="sets measured")
    shipped = pathlib.Path(__file__).parents[1] / "checkpoints" / "paper.npz"
    parser.add_argument("--checkpoint", type=pathlib.Path, default=shipped)
    arguments = parser.parse_args()
    processes.keep_compiled_programs()
    for size in arguments.sizes.split(","):
        m, k = map(int, size.split(":"))
        sets = np.random.default_rng(20261130).random((arguments.sets, m, 3))
        print(f"\n{m} candidates, {k} chosen, {len(sets)} sets")
        table(sets, k, arguments.checkpoint)


def table(sets: np.ndarray, k: int, checkpoint: pathlib.Path) -> None:
    def by(method: str, **options: float) -> np.ndarray:
        chosen = [jaxcal.select(x, k, method, **options).indices for x in sets]
        return np.array(chosen)

    def agent(sets: np.ndarray = sets[:TIMED]) -> np.ndarray:
        return select_batch(sets, k, checkpoint=checkpoint)

    agent()  # compiled
    ms = timed(agent, sets[:TIMED])[1]
    rows = {
        "agent": (timed(lambda: agent(sets), sets)[0], ms),
        "greedy": timed(lambda: by("greedy"), sets),
        "exchange": timed(lambda: by("exchange"), sets),
        "exact": timed(lambda: by("exact", time_limit=SECONDS), sets),
    }
    best = np.max([values for values, _ in rows.values()], axis=0)
    for name, (values, ms) in rows.items():
        ratio, hits = np.exp(values - best).mean(), (values > best - HIT).mean()
        print(f"  {name:9} {ratio:.4f}  {hits:6.1%}  {ms:8.2f} ms", flush=True)


def timed(call: Callable[[], np.ndarray], sets: np.ndarray) -> tuple[np.ndarray, float]:
    """Log det S of what a method chooses, and its milliseconds a set."""
    begun = time.perf_counter()
    chosen = call()
    ms = 1e3 * (time.perf_counter() - begun) / len(sets)
    picked = np.take_along_axis(sets, chosen[..., None], axis=1)
    return np.asarray(log_det_information(picked)), ms


if __name__ == "__main__":
    main()
