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

import time

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import add_block, factor
from jaxcal.selection.fastest.heuristic import local_search
from jaxcal.selection.fastest.task import SAME_TIME, Search, Task
from jaxcal.selection.fastest.tour_kernel import extend
from jaxcal.selection.solver import Found

__all__ = ["search"]

_CHUNK = 20_000  # nodes between checks of the clock


def search(task: Task, seed: int) -> Search:
    """The compiled search, started from the local search, within the time limit."""

    def solve(wanted: float) -> Found | None:
        start, seconds = local_search(task, wanted, np.random.default_rng(seed))
        k, prior = task.k, task.problem.prior
        chosen = np.zeros(k, np.int64) if start is None else np.sort(start)
        value = -np.inf if start is None else task.log_det(chosen)
        best = np.array([seconds, value])
        state, stack = np.array([-1, 0]), np.zeros(k + 1, np.int64)
        tours = np.full((1 << k, k), np.inf)
        relaxed = task.information(task.optimum) - prior
        deadline = time.perf_counter() + task.time_limit
        complete = False
        while not complete and time.perf_counter() < deadline:
            complete = _search(
                task.blocks, np.array(prior), task.times, task.start, task.fixed, k,
                relaxed, wanted, tours, stack, state, best, chosen, _CHUNK,
            )  # fmt: skip
        if not np.isfinite(best[0]):
            return None
        return Found(chosen, proven=bool(complete), nodes=int(state[1]), method="exact")

    return solve


@njit(cache=True, nogil=True)
def _gram(blocks, prior, chosen, count, gram):
    """``gram`` (p, p): prior and the first ``count`` of ``chosen``, into blocks."""
    gram[:] = prior
    for c in range(count):
        add_block(gram, blocks, chosen[c], 1.0)


@njit(cache=True, nogil=True)
def _bound(blocks, prior, chosen, count, first, k, relaxed, gram, inverse, gains):
    """Upper bound on log det of the held with k - count more from ``first`` on.

    Args:
        blocks: (M, q, p) float64.
        prior: (p, p) float64 information beforehand.
        chosen: (k + 1,) int64, of which the first ``count`` are held.
        count, first, k: see above.
        relaxed: (p, p) information of the D-optimum without the prior.
        gram, inverse: (p, p) room to work in.
        gains: (k,) likewise.
    """
    num_blocks, q, p = blocks.shape
    more = k - count
    if num_blocks - first < more:
        return -np.inf
    _gram(blocks, prior, chosen, count, gram)
    log_det = factor(gram + (more / k) * relaxed, inverse)
    if log_det == -np.inf:
        return np.inf
    trace = (inverse * gram).sum()
    gains[:more] = -1.0  # the largest so far, ascending
    for j in range(first, num_blocks):
        gain = 0.0
        for r in range(q):
            for a in range(p):
                for b in range(p):
                    gain += blocks[j, r, a] * inverse[a, b] * blocks[j, r, b]
        if gain <= gains[0]:
            continue
        place = 0
        while place + 1 < more and gains[place + 1] < gain:
            gains[place] = gains[place + 1]
            place += 1
        gains[place] = gain
    return log_det + p * np.log((trace + gains[:more].sum()) / p)


@njit(cache=True, nogil=True)
def _search(
    blocks, prior, times, start, fixed, k, relaxed, wanted, tours, chosen, state,
    best, best_chosen, limit,
):  # fmt: skip
    """Go on with the search for at most ``limit`` nodes.

    Args:
        blocks: (M, q, p) float64 whitened.
        prior: (p, p) float64 information beforehand.
        times: (M, M) float64 seconds, a metric.
        start: (M,) float64 seconds to each from the start, zero where there is none.
        fixed: postures in every subset, the first of ``blocks``; fewer than k.
        k: postures in all.
        relaxed: (p, p) information of a good selection of k, without the prior; any
            leaves the bound true.
        wanted: log det a subset must have.
        tours: (2^k, k) float64, see ``extend``.
        chosen: (k + 1,) int64, the subset on the stack.
        state: (2,) int64 depth, -1 at first, and nodes so far.
        best: (2,) float64 seconds and log det of the incumbent; of two runs that take
            as long the one with the larger determinant wins.
        best_chosen: (k,) int64, the incumbent.
        limit: nodes.

    Returns:
        Whether the search is complete.
    """
    num_blocks, _, p = blocks.shape
    gram = np.empty((p, p))
    inverse = np.empty((p, p))
    gains = np.empty(k)
    depth = state[0]
    if depth < 0:
        for depth in range(fixed):
            chosen[depth] = depth
            extend(tours, times, start, chosen, depth)
        depth = fixed
        chosen[depth] = fixed - 1  # the next one tried is one further
    done = 0
    while depth >= fixed:
        chosen[depth] += 1
        if chosen[depth] + (k - depth) > num_blocks:
            depth -= 1
            continue
        if done >= limit:
            chosen[depth] -= 1
            state[0] = depth
            state[1] += done
            return False
        done += 1
        least = extend(tours, times, start, chosen, depth)
        if least > best[0] + SAME_TIME:
            continue
        if depth == k - 1:
            _gram(blocks, prior, chosen, k, gram)
            log_det = factor(gram, inverse)
            if log_det >= wanted and (
                least < best[0] - SAME_TIME or log_det > best[1] + 1e-12
            ):
                best[0], best[1] = min(least, best[0]), log_det
                best_chosen[:] = chosen[:k]
            continue
        bound = _bound(
            blocks, prior, chosen, depth + 1, chosen[depth] + 1, k, relaxed, gram,
            inverse, gains,
        )  # fmt: skip
        if bound < wanted or (least > best[0] - SAME_TIME and bound <= best[1]):
            continue
        depth += 1
        chosen[depth] = chosen[depth - 1]
    state[0] = depth
    state[1] += done
    return True
