"""The best design of one size for a region, and what no design of that size beats.

The best: exchange on the criterion itself, which proves nothing. It starts from the
selection that exchange finds for D, the greedy one, the design of one measurement less
plus its best addition, and random ones.

The bound: with weights w over the region and W = sum of w z z.T, the largest variance
is at least the weighted mean trace(W M^-1), and that at least what the relaxation of
branch and bound proves. For G the weights are those of the D-optimal measure of the
region, which make the bound p / K where the region is the candidates and replicates are
free (Kiefer and Wolfowitz 1960). Source: Pukelsheim, Optimal Design of Experiments.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from jaxcal.checks import Array, Indices
from jaxcal.information.singular import significant
from jaxcal.selection.criteria import I
from jaxcal.selection.exact.exact import relaxed
from jaxcal.selection.exchange.exchange import exchange_indices, greedy_indices
from jaxcal.selection.problem import Problem

# Over the region, of the variances of an output; of several the worst counts.
_MEANS: dict[str, Callable[..., Any]] = {"G": np.max, "I": np.mean}

_RANDOM_STARTS = 4  # where a candidate gives one reading: swaps of more take longer
_D_RESTARTS = 50  # of the exchange that looks for the D-optimal selection
_ITERATIONS = 300  # of the weights of G: any count gives a true bound


class Case(NamedTuple):
    """One scenario of the problem, or all there is."""

    problem: Problem  # whitened blocks and prior
    points: Array  # (R, s, p) whitened rows of the region


def variances_of(cases: Sequence[Case], indices: Indices, how: str) -> Array:
    """(s,) the criterion of each output in the scenario where it is worst.

    Args:
        cases: the scenarios.
        indices: (k,) the design; inf where it is singular.
        how: "G" or "I".
    """
    return np.asarray(np.max([_variances(*case, indices, how) for case in cases], 0))


def _variances(problem: Problem, points: Array, indices: Indices, how: str) -> Array:
    rows = problem.blocks[indices].reshape(-1, points.shape[-1])
    if problem.prior.any():
        size, vectors = np.linalg.eigh(problem.prior)
        rows = np.vstack([rows, np.sqrt(np.maximum(size, 0.0))[:, None] * vectors.T])
    singular, right = np.linalg.svd(rows)[1:]
    if significant(singular).sum() < rows.shape[1]:
        return np.full(points.shape[1], np.inf)
    return np.asarray(_MEANS[how](((points @ (right.T / singular)) ** 2).sum(2), 0))


def best_design(
    problem: Problem,
    cases: Sequence[Case],
    how: str,
    previous: Indices | None,
    seed: int,
) -> Indices:
    """(k,) the best design of ``problem.k`` found, sorted.

    Args:
        problem: candidates, limits and k.
        cases: its scenarios.
        how: the criterion, "G" or "I".
        previous: (k - 1,) the design of one measurement less.
        seed: of exchange and of the random starts.
    """
    best = exchange_indices(problem, _D_RESTARTS, seed)
    value = float(variances_of(cases, best, how).max())
    starts = [best, greedy_indices(problem)]
    if previous is not None:
        more = _room(problem, previous)
        values = _worst_after(cases, previous, [None], more, how)[0]
        starts.append(np.append(previous, more[int(values.argmin())]))
    if problem.blocks.shape[1] == 1:
        starts += _random_starts(problem, seed)
    for start in starts:
        indices, reached = _exchange(problem, start, cases, how)
        if reached < value * (1.0 - 1e-12):
            best, value = indices, reached
    return np.sort(best)


def _random_starts(problem: Problem, seed: int) -> list[Indices]:
    """Each (k,): the required candidates with others at random."""
    rng = np.random.default_rng([seed, problem.k])
    room = np.repeat(np.arange(len(problem.blocks)), problem.upper - problem.lower)
    more = problem.k - len(problem.required)
    return [
        np.concatenate([problem.required, rng.permutation(room)[:more]])
        for _ in range(_RANDOM_STARTS)
    ]


def _exchange(
    problem: Problem, start: Indices, cases: Sequence[Case], how: str
) -> tuple[Indices, float]:
    """Swap one posture at a time, the best swap first, until none lowers the criterion.

    The required candidates stay, one measurement of each. A singular start stays too.
    """
    chosen = np.array(start)
    value = variances_of(cases, chosen, how).max()
    while np.isfinite(value):
        fixed = [int(np.flatnonzero(chosen == i)[0]) for i in problem.required]
        free = np.setdiff1d(np.arange(len(chosen)), fixed)
        free = free[np.unique(chosen[free], return_index=True)[1]]
        more = _room(problem, chosen)
        if not len(free) or not len(more):
            break
        values = _worst_after(cases, chosen, list(chosen[free]), more, how)
        i, j = divmod(int(values.argmin()), len(more))
        tried = chosen.copy()
        tried[free[i]] = more[j]
        reached = variances_of(cases, tried, how).max()
        if not reached < value * (1.0 - 1e-9):
            break
        chosen, value = tried, reached
    return chosen, value


def _worst_after(
    cases: Sequence[Case],
    chosen: Indices,
    out: list[int | None],
    new: Indices,
    how: str,
) -> Array:
    """(out, new) criterion of the worst scenario after a swap, see ``_after``."""
    worst = _after(*cases[0], chosen, out, new, how)
    for case in cases[1:]:
        worst = np.maximum(worst, _after(*case, chosen, out, new, how))
    return worst


def _after(
    problem: Problem,
    points: Array,
    chosen: Indices,
    out: list[int | None],
    new: Indices,
    how: str,
) -> Array:
    """(out, new) criterion after taking one out (None: nothing) and one in.

    By the Woodbury identity: with U the blocks that go and come, V = M^-1 and S = -1
    for a row that goes, 1 for one that comes, the variance at z falls by
    ``a.T (S + U V U.T)^-1 a``, a = U V z, and that matrix is singular where the design
    becomes so.
    """
    blocks, (regions, outputs, p) = problem.blocks, points.shape
    held = blocks[chosen].reshape(-1, p)
    inverse = np.linalg.inv(held.T @ held + problem.prior)
    rows = points.reshape(-1, p)
    before = np.einsum("np,pq,nq->n", rows, inverse, rows)
    values = np.full((len(out), len(new)), np.inf)
    q = blocks.shape[1]
    for row, i in enumerate(out):
        gone = blocks[[] if i is None else [i]].reshape(-1, p)
        u = np.empty((len(new), len(gone) + q, p))
        u[:, : len(gone)], u[:, len(gone) :] = gone, blocks[new]
        scaled = u @ inverse
        sign = np.r_[-np.ones(len(gone)), np.ones(q)]
        inner = np.diag(sign) + scaled @ np.matrix_transpose(u)
        sound = np.abs(np.linalg.det(inner)) > 1e-9
        along = scaled[sound] @ rows.T
        less = (along * np.linalg.solve(inner[sound], along)).sum(axis=1)
        after = (before - less).reshape(-1, regions, outputs)
        values[row, sound] = _MEANS[how](after, 1).max(axis=1)
    return values


def _room(problem: Problem, indices: Indices) -> Indices:
    """Candidates that may be chosen once more."""
    counts = np.bincount(indices, minlength=len(problem.blocks))
    return np.flatnonzero(counts < problem.upper)


def region_root(points: Array, how: str) -> Array:
    """(r, p) root of W, the sum of w z z.T over the region, of weights that sum to 1.

    Args:
        points: (R, s, p) whitened rows of the region.
        how: "I", equal weights, or "G", those of the D-optimal measure of the region by
            Titterington's steps w <- w (z.T W^-1 z) / p.
    """
    rows = points.reshape(-1, points.shape[-1])
    weight = np.full(len(rows), 1.0 / len(rows))
    for _ in range(_ITERATIONS if how == "G" else 0):
        inverse = np.linalg.pinv((rows * weight[:, None]).T @ rows, hermitian=True)
        weight *= np.einsum("ra,ab,rb->r", rows, inverse, rows)
        weight /= weight.sum()
    size, vectors = np.linalg.eigh((rows * weight[:, None]).T @ rows)
    keep = significant(size, squares=True)
    return np.asarray(np.sqrt(size[keep])[:, None] * vectors.T[keep])


def lower_bound(problem: Problem, root: Array, k: int) -> float:
    """No design of k within the counts has a smaller ``trace(root M^-1 root.T)``."""
    one = dataclasses.replace(problem, k=k, criterion=I.of_rows(root))
    return -relaxed(one, greedy_indices(one))
