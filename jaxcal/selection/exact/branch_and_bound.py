"""Exact selection for any k and criterion by branch and bound on the relaxation.

Source: Ponte, Fampa and Lee, Branch-and-bound for integer D-Optimality with fast local
search and variable-bound tightening, arXiv 2302.07386. A node is closed when its bound
is within ``TOLERANCE`` of the incumbent, far above the rounding of either (1e-13, which
fused products only make smaller), so "proven" means: no selection is better by more
than that.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcal import compiled
from jaxcal.checks import Array, Indices
from jaxcal.deadline import NEVER, Deadline
from jaxcal.information.blocks import gram, largest_rank
from jaxcal.selection.criteria import Criterion, ScenarioCriterion
from jaxcal.selection.problem import Constraints

TOLERANCE = 1e-10  # of phi of "det"; of the others a share of it
_MEMORY = 64 * 2**20  # bytes of open nodes up to which the best bound goes first
_USEFUL = {"trace": -0.5, "least": 2.0}  # of values near 1: an efficiency of a half
_CUTS, _DEAR, _PRICED = 30, 1.0, 1e-5  # of prices: tries, a high one, near enough
_FREE = 3e6  # node x M q p^2 spent on a proof although ``enough`` is reached: 10 ms


@dataclasses.dataclass(frozen=True)
class BranchResult:
    """The best selections within the counts."""

    counts: Indices  # (found, M), best first
    values: Array  # (found,) phi
    bound: float  # on phi of every selection that is not listed, or of the best
    nodes: int
    proven: bool


class Scenario(NamedTuple):
    """What a choice is judged by, in its own coordinates."""

    blocks: Array  # (M, q, p) whitened
    prior: Array  # (p, p) precision
    criterion: Criterion

    def search(self, upper: Indices, start: Indices, incumbents: Any) -> _KernelSearch:
        root, scale, shift, largest = _near_one(*self, start, upper)
        blocks, prior, criterion = self
        useful = min(largest, _USEFUL.get(criterion.kind, np.inf))
        search = compiled.kernel("jaxcal.selection.exact.branch_kernel").Search(
            criterion.form, blocks, prior, root, start.sum(), largest_rank(blocks),
            useful, incumbents, False, False,
        )  # fmt: skip
        work = blocks.size * blocks.shape[2]
        return _KernelSearch(search, scale, shift, largest, work)


class JointScenarios(NamedTuple):
    """Several scenarios over the same candidates, and how their phi are joined."""

    members: Sequence[Scenario]
    criterion: ScenarioCriterion
    weights: Array  # (S,) of sum 1
    terms: tuple[Array, Array]  # (S,) scale and shift of phi

    def search(self, upper: Indices, start: Indices, incumbents: Any) -> _KernelSearch:
        scenarios, criterion, weights, (scale, shift) = self
        kernel = compiled.kernel("jaxcal.selection.exact.branch_kernel")
        near = [_near_one(*scenario, start, upper) for scenario in scenarios]
        roots, units, origins, tops = zip(*near, strict=True)
        shift, scale = shift + scale * origins, scale * units
        most = scale * tops + shift
        largest = float(most.min() if criterion.least else weights @ most)
        unit = 1.0
        if criterion.kind != "det":  # values near 1
            begun = np.abs((-scale if criterion.kind == "trace" else scale) + shift)
            unit = float(begun.max() if criterion.least else weights @ begun)
            scale, shift, largest = scale / unit, shift / unit, largest / unit
        useful = min(largest, _USEFUL.get(criterion.kind, np.inf))
        k = start.sum()
        # Is there room to keep what every candidate adds to the information?
        count, _, p = scenarios[0].blocks.shape
        packs = len(scenarios) * count * p * (p + 1) * 4 <= _MEMORY
        members = [
            kernel.Search(
                scenario.criterion.form, scenario.blocks, scenario.prior, root, k,
                largest_rank(scenario.blocks), useful, _incumbents(1, len(start)),
                True, packs,
            )
            for scenario, root in zip(scenarios, roots, strict=True)
        ]  # fmt: skip
        first = scenarios[0]
        search = kernel.JointSearch(
            first.criterion.form, first.blocks, first.prior, roots[0], k, 1, useful,
            incumbents, False, False,
        )  # fmt: skip
        search.join(members, weights, scale, shift, criterion.least)
        work = len(scenarios) * first.blocks.size * first.blocks.shape[2]
        return _KernelSearch(search, unit, 0.0, largest, work)


class _KernelSearch(NamedTuple):
    """The kernel's search, in whose units phi is near 1."""

    search: Any
    scale: float  # phi of the caller is scale times the kernel's, plus shift
    shift: float
    largest: float  # the kernel's phi at most
    work: int  # multiplications of one evaluation of all candidates


def branch_and_bound(
    judged_by: Scenario | JointScenarios,
    lower: Indices,
    upper: Indices,
    start: Indices,
    best: int = 1,
    deadline: Deadline = NEVER,
    enough: float | None = None,
    root_only: bool = False,
    rules: Constraints | None = None,
) -> BranchResult:
    """The ``best`` selections by phi of the criterion, with proof.

    Args:
        lower, upper, start: (M,) bounds of counts, and counts of a good selection.
        enough: efficiency at which to stop, once the proof has had a fair try.
        root_only: stop at the bound of the relaxation.
    """
    best_counts, best_values, order = incumbents = _incumbents(best, len(start))
    started = judged_by.search(upper, start, incumbents)
    search, scale, shift, largest, work = started
    begun = np.array([lower, upper, start], dtype=np.float64)
    begin = begun[2]
    if rules is not None:
        begin = _price(search, rules, begun, deadline.part(0.2))
    good = (0.0, np.inf if root_only else -np.inf)  # slope and shift of what is enough
    if enough is not None:
        slope, more = judged_by.criterion.enough(enough)
        good = slope, more / scale
    search.offer(begun, deadline.remaining_s)
    nodes, bounds = np.empty((64, *begun.shape)), np.full(64, np.inf)
    nodes[0] = *begun[:2], begin
    widest = max(256, _MEMORY // nodes[0].nbytes)
    tries = 1 if root_only else int(_FREE / work)
    size, done, going = 1, 0, True
    while size and going:
        if size + 2 > len(bounds):
            nodes = np.concatenate([nodes, np.empty_like(nodes)])
            bounds = np.concatenate([bounds, np.full(len(bounds), np.inf)])
        size, newly, going = search.run(
            nodes, bounds, size, TOLERANCE, widest, max(1, tries - done),
            deadline.remaining_s, *good,
        )  # fmt: skip
        done += newly
    bound = min(bounds[:size].max(initial=best_values[0]), largest)
    bound = bound if size else best_values[0]
    reached = np.isfinite(best_values)
    counts = best_counts[order[reached]].astype(np.int64)
    values = scale * best_values[reached] + shift
    return BranchResult(counts, values, float(scale * bound + shift), done, size == 0)


def _price(search: Any, rules: Constraints, begun: Array, deadline: Deadline) -> Array:
    """(M,) counts where the relaxation ends that keeps the rules, at the prices that
    make its bound least, by cutting planes (Kelley): any from 0 give true bounds."""
    from scipy import optimize

    size = np.abs(rules.costs).max(axis=1, initial=0.0)
    size = np.where(size > 0.0, size, 1.0)
    costs = np.ascontiguousarray(rules.costs / size[:, None])
    most, node = rules.most / size, begun.copy()

    def bound(prices: Array) -> tuple[float, Array]:
        search.limit(costs, most, rules.order, np.maximum(prices, 0.0))
        node[2] = begun[2]  # from elsewhere the climb may end early
        value = search.relaxed(node, deadline.remaining_s)
        return value, most - costs @ node[2]

    prices = cheapest = np.zeros(len(most))
    best, cuts, dearest = np.inf, [], _DEAR
    for _ in range(_CUTS):
        value, slope = bound(prices)
        if value < best:
            best, cheapest = value, prices
        free = not prices.any() and (slope >= 0.0).all()
        if free or not np.isfinite(value) or deadline.passed:
            break
        cuts.append([*slope, -1.0, slope @ prices - value])
        rows = np.array(cuts)
        limits = [(0.0, dearest)] * len(most) + [(None, None)]
        objective = [0.0] * len(most) + [1.0]
        optimum = optimize.linprog(objective, rows[:, :-1], rows[:, -1], bounds=limits)
        if optimum.x is None:
            break
        if (optimum.x[:-1] > 0.99 * dearest).any() and dearest < 1e3 * _DEAR:
            dearest *= 4.0
        elif best - optimum.x[-1] <= _PRICED * max(1.0, abs(best)):
            break
        # Halfway: a cut may be off by what the relaxation was not solved to.
        prices = 0.5 * (optimum.x[:-1] + cheapest)
    bound(cheapest)
    return np.asarray(node[2])


def _incumbents(best: int, num_blocks: int) -> tuple[Array, Array, Indices]:
    """Room for the ``best`` selections: counts, values and their order."""
    order = np.arange(best, dtype=np.intp)
    return np.zeros((best, num_blocks)), np.full(best, -np.inf), order


def _near_one(
    blocks: Array, prior: Array, criterion: Criterion, start: Indices, upper: Indices
) -> tuple[Array, float, float, float]:
    """The kernel's C, with values of phi near 1, and their unit, origin and largest,
    that of everything measured as often as it may be."""
    root, form = criterion.root, criterion.form
    everything = prior + _information(blocks, upper)
    if form == "det":
        of_root, largest = np.linalg.slogdet(np.array([root, everything]))[1].tolist()
        return root, 1.0, -2.0 * of_root, largest
    both = np.array([prior + _information(blocks, start), everything])
    begun, largest = criterion.value(both).tolist()
    if form == "subset":
        lengths = np.linalg.norm(root, axis=1)
        shift = -2.0 * float(np.log(lengths).sum())
        return root / lengths[:, None], 1.0, shift, largest - shift
    scale = abs(begun) if 0.0 < abs(begun) < np.inf else 1.0
    unit = math.sqrt(scale)
    root = root / unit if form == "trace" else root * unit
    return root, scale, 0.0, largest / scale


def _information(blocks: Array, counts: Indices) -> Array:
    """(p, p) of blocks (M, q, p), each as often as ``counts`` (M,) says."""
    rows = np.sqrt(counts)[:, None, None] * blocks
    return gram(rows.reshape(-1, blocks.shape[2]))
