"""The proven fastest run: a compiled depth-first search over subsets.

Subsets grow in the order of the pool; a level keeps the best open tours through its
postures (Held and Karp), so going one deeper costs only the new ones.

Two bounds close a branch. Time: travel times are a metric, so a tour through more
postures takes no less than the best one through those already held. Determinant: for
any positive definite W, ``log det M <= -log det W + p log(trace(W M) / p)``; W is taken
as the inverse of what the held postures and the D-optimum's share of the rest give, and
the trace is completed by the largest gains that are left. Source of the bound: Ponte,
Fampa and Lee, arXiv 2302.07386.
"""

from __future__ import annotations

import numpy as np

from jaxcal.selection.fastest.heuristic import local_search
from jaxcal.selection.fastest.kernel import fastest_subset
from jaxcal.selection.fastest.task import SAME_TIME, Search, Task
from jaxcal.selection.solver import Found

__all__ = ["search"]


def search(task: Task, seed: int) -> Search:
    """The compiled search, started from the local search, within the time limit."""

    def solve(wanted: float) -> Found | None:
        start, seconds = local_search(task, wanted, np.random.default_rng(seed))
        prior = np.array(task.problem.prior)
        chosen = np.zeros(task.k, np.int64) if start is None else np.sort(start)
        value = -np.inf if start is None else task.log_det(chosen)
        best = np.array([seconds, value])
        relaxed = task.information(task.optimum) - prior
        complete, nodes = fastest_subset(
            task.blocks, prior, task.times, task.start, task.fixed, relaxed, wanted,
            SAME_TIME, chosen, best, task.time_limit,
        )  # fmt: skip
        if not np.isfinite(best[0]):
            return None
        return Found(chosen, proven=complete, nodes=nodes, method="exact")

    return solve
