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
from numpy.typing import NDArray

from jaxcal import compiled
from jaxcal.deadline import NEVER, Deadline
from jaxcal.information.blocks import gram, largest_rank
from jaxcal.selection.criteria import Criterion, Joined

__all__ = ["Scenario", "branch_and_bound", "joint_branch_and_bound"]

TOLERANCE = 1e-10  # of phi of "det"; of the others a share of it
_MEMORY = 64 * 2**20  # bytes of open nodes up to which the best bound goes first
_USEFUL = {"trace": -0.5, "least": 2.0}  # of values near 1: an efficiency of a half
_FREE = 3e6  # node x M q p^2 spent on a proof although ``enough`` is reached: 10 ms

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclasses.dataclass(frozen=True)
class BranchResult:
    """The best selections within the counts, and how far they can be from optimal."""

    counts: Indices  # (found, M), best first
    values: Array  # (found,) phi
    bound: float  # on phi of every selection that is not listed, or of the best
    nodes: int
    proven: bool


def branch_and_bound(
    blocks: Array,
    prior: Array,
    criterion: Criterion,
    lower: Indices,
    upper: Indices,
    start: Indices,
    best: int = 1,
    deadline: Deadline = NEVER,
    enough: float | None = None,
    root_only: bool = False,
) -> BranchResult:
    """The ``best`` selections by phi of the criterion, with proof.

    Args:
        blocks: (M, q, p) whitened.
        prior: (p, p) precision in the same coordinates.
        criterion: in the same coordinates.
        lower: (M,) least counts.
        upper: (M,) largest counts.
        start: (M,) counts of a good selection, sum k.
        best: how many selections.
        deadline: when to stop with what there is.
        enough: share of the best possible (its efficiency) at which to stop, once the
            proof has had a fair try.
        root_only: stop at the bound of the relaxation.
    """
    root, scale, shift, trivial = _near_one(blocks, prior, criterion, start, upper)
    useful = min(trivial, _USEFUL.get(criterion.kind, np.inf))
    incumbents = _incumbents(best, len(blocks))
    search = compiled.kernel("jaxcal.selection.exact.branch_kernel").Search(
        criterion.form, blocks, prior, root, start.sum(), largest_rank(blocks), useful,
        *incumbents,
    )  # fmt: skip
    counts = np.array([lower, upper, start], dtype=np.float64)
    good = criterion.enough(enough) if enough is not None else None
    units, work = (scale, shift, trivial), blocks.size * blocks.shape[2]
    return _searched(search, incumbents, counts, units, work, deadline, good, root_only)


class Scenario(NamedTuple):
    """One of several in which a choice is judged, in its own coordinates."""

    blocks: Array  # (M, q, p)
    prior: Array  # (p, p)
    criterion: Criterion


def joint_branch_and_bound(
    scenarios: Sequence[Scenario],
    criterion: Joined,
    weights: Array,
    terms: tuple[Array, Array],
    lower: Indices,
    upper: Indices,
    start: Indices,
    best: int = 1,
    deadline: Deadline = NEVER,
    enough: float | None = None,
    root_only: bool = False,
) -> BranchResult:
    """The ``best`` selections by what ``criterion`` joins, with proof.

    Args:
        scenarios: over the same candidates.
        criterion: how phi of the scenarios is joined.
        weights: (S,) of sum 1.
        terms: (S,) scale and shift of phi, see ``Joined.terms``.
        lower, upper, start, best, deadline, enough, root_only: as of
            ``branch_and_bound``.
    """
    kernel = compiled.kernel("jaxcal.selection.exact.branch_kernel")
    near = [_near_one(*scenario, start, upper) for scenario in scenarios]
    scale, shift = terms
    shift = shift + scale * [one[2] for one in near]
    scale = scale * [one[1] for one in near]
    most = scale * [one[3] for one in near] + shift
    trivial = float(most.min() if criterion.least else weights @ most)
    unit = 1.0
    if criterion.kind != "det":  # values near 1
        begun = [-1.0 if criterion.kind == "trace" else 1.0] * scale + shift
        unit = float(
            np.abs(begun).max() if criterion.least else weights @ np.abs(begun)
        )
        scale, shift, trivial = scale / unit, shift / unit, trivial / unit
    useful = min(trivial, _USEFUL.get(criterion.kind, np.inf))
    incumbents, k = _incumbents(best, len(start)), start.sum()
    packs = _packs(len(scenarios), scenarios[0].blocks)
    members = [
        kernel.Search(
            scenario.criterion.form, scenario.blocks, scenario.prior, one[0], k,
            largest_rank(scenario.blocks), useful, *_incumbents(1, len(start)), True,
            packs,
        )
        for scenario, one in zip(scenarios, near, strict=True)
    ]  # fmt: skip
    first = scenarios[0]
    search = kernel.JointSearch(
        first.criterion.form, first.blocks, first.prior, near[0][0], k, 1, useful,
        *incumbents,
    )  # fmt: skip
    search.join(members, weights, scale, shift, criterion.least)
    counts = np.array([lower, upper, start], dtype=np.float64)
    good = criterion.enough(enough) if enough is not None else None
    if good is not None:
        good = good[0], good[1] / unit
    work = len(scenarios) * first.blocks.size * first.blocks.shape[2]
    return _searched(
        search, incumbents, counts, (unit, 0.0, trivial), work, deadline, good,
        root_only,
    )  # fmt: skip


def _packs(num_scenarios: int, blocks: Array) -> bool:
    """Whether there is room to keep what every candidate adds to the information."""
    count, _, p = blocks.shape
    return num_scenarios * count * p * (p + 1) * 4 <= _MEMORY


def _incumbents(best: int, num_blocks: int) -> tuple[Array, Array, Indices]:
    """Room for the ``best`` selections: counts, values and their order."""
    return (
        np.zeros((best, num_blocks)),
        np.full(best, -np.inf),
        np.arange(best, dtype=np.intp),
    )


def _searched(
    search: Any,
    incumbents: tuple[Array, Array, Indices],
    begun: Array,
    units: tuple[float, float, float],
    work: int,
    deadline: Deadline,
    enough: tuple[float, float] | None,
    root_only: bool,
) -> BranchResult:
    """Branch from the whole problem until it is solved, or as far as is asked for.

    Args:
        search: the kernel's.
        incumbents: its best selections.
        begun: (3, M) lower and upper bounds of the counts, and a good selection.
        units: of phi the unit and the origin, and in these the largest there can be.
        work: multiplications of one evaluation of all candidates.
        deadline, root_only: as of ``branch_and_bound``.
        enough: a bound of at most the first times the best, plus the second.
    """
    best_counts, best_values, order = incumbents
    (low, high, counts), (scale, shift, trivial) = begun, units
    num_blocks = len(low)
    search.offer(low, high, counts, deadline.remaining_s)
    nodes, bounds = np.empty((64, 3, num_blocks)), np.full(64, np.inf)
    nodes[0] = low, high, counts
    good = (0.0, np.inf) if root_only else (0.0, -np.inf)
    if enough is not None:
        good = enough
    tries = 1 if root_only else int(_FREE / work)
    size, done, bound, going = 1, 0, np.inf, True
    while size and going:
        if size + 2 > len(bounds):
            room = np.empty((len(bounds), 3, num_blocks))
            nodes = np.concatenate([nodes, room])
            bounds = np.concatenate([bounds, np.full(len(bounds), np.inf)])
        size, more, going = search.run(
            nodes, bounds, size, TOLERANCE, max(256, _MEMORY // (24 * num_blocks)),
            max(1, tries - done), deadline.remaining_s, *good,
        )  # fmt: skip
        done += more
    if size:
        bound = max(bounds[:size].max(), best_values[0])
        bound = min(bound, trivial)
    reached = np.isfinite(best_values)
    return BranchResult(
        best_counts[order[reached]].astype(np.int64),
        scale * best_values[reached] + shift,
        float(scale * (bound if size else best_values[0]) + shift),
        done,
        size == 0,
    )


def _near_one(
    blocks: Array, prior: Array, criterion: Criterion, start: Indices, upper: Indices
) -> tuple[Array, float, float, float]:
    """The kernel's C, with values of phi near 1, and their unit, origin and largest.

    The largest is that of everything measured as often as it may be.
    """
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
