"""Exchange for E, the smallest eigenvalue: exact values of the few that may be best.

phi is concave, so with G its gradient at what is left when a candidate goes out, adding
B_j gives at most phi there plus ``trace(B_j G B_j.T)``; candidates are
evaluated in the order of that bound until it falls to the best found. Starts are local
optima of A: the sum of the variances is at most p times the largest, and climbs from
where the smallest eigenvalue stands still because two are equal.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.criterion import Criterion
from jaxcal.selection.exchange.blocks import Blocks
from jaxcal.selection.problem import Problem, values
from jaxcal.selection.random import solve as random_selection

__all__ = ["climb_eigenvalue", "exchange_eigenvalue"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_CHUNK = 32  # candidates evaluated at once
_WORK = 3e5  # k p^3 of the climbs of one call, about half a second
_IMPROVES = 1e-9  # share by which a swap must raise the eigenvalue
_RIDGE = 1e-10  # of the information of all candidates


def exchange_eigenvalue(
    problem: Problem, restarts: int, seed: int
) -> tuple[Indices, float]:
    """The best local optimum of E and its value, from ``restarts`` local optima of A.

    On large problems only those of the best eigenvalues are climbed.
    """
    near = Blocks(problem)
    starts = [near.exchanged(1, seed)]
    for turn in range(1, restarts):
        start = random_selection(problem, seed=seed + turn).indices
        starts.append(near.climbed(start))
    chosen = np.unique(
        [np.sort(start) for start, phi in starts if phi > -np.inf], axis=0
    )
    if not len(chosen):
        return starts[0][0], -np.inf
    order = np.argsort(-values(problem, chosen)[0])
    k, p = problem.k, problem.num_regressors
    few = max(1, int(_WORK / (k * p**3)))
    return max(
        (
            climb_eigenvalue(problem, _required_first(problem, chosen[i]))
            for i in order[:few]
        ),
        key=lambda each: each[1],
    )


def _required_first(problem: Problem, chosen: Indices) -> Indices:
    rest = chosen.tolist()
    for i in problem.required:
        rest.remove(i)
    return np.array([*problem.required, *rest], dtype=np.int64)


def climb_eigenvalue(problem: Problem, start: Indices) -> tuple[Indices, float]:
    """The local optimum that ``start`` (k,) climbs to, and its eigenvalue."""
    blocks, criterion = problem.blocks, problem.criterion
    grams = np.matrix_transpose(blocks) @ blocks
    chosen, fixed = start.copy(), len(problem.required)
    value = float(criterion.value(problem.prior + grams[chosen].sum(axis=0)))
    room = problem.upper - np.bincount(chosen, minlength=len(blocks))
    since, position = 0, fixed
    while since < len(chosen) - fixed:
        out = chosen[position]
        rest = problem.prior + grams[np.delete(chosen, position)].sum(axis=0)
        least = value * (1.0 + _IMPROVES)
        best, found = _best(rest, criterion, blocks, grams, room > 0, least)
        since += 1
        if best >= 0:
            value, since = found, 0
            room[out] += 1
            room[best] -= 1
            chosen[position] = best
        position = position + 1 if position + 1 < len(chosen) else fixed
    return chosen, value


def _best(
    rest: Array,
    criterion: Criterion,
    blocks: Array,
    grams: Array,
    free: NDArray[np.bool_],
    least: float,
) -> tuple[int, float]:
    """The candidate, or -1, that gives the largest eigenvalue above ``least``."""
    # A little more than there is keeps the bounds true where the rest is singular.
    more = rest + _RIDGE * np.eye(len(rest))
    lift = ((blocks @ criterion.gradient(more)) * blocks).sum(axis=(1, 2))
    bound = float(criterion.value(more)) + lift
    bound = np.where(free, bound, -np.inf)
    order = np.argsort(-bound)
    best = -1
    for first in range(0, len(order), _CHUNK):
        some = order[first : first + _CHUNK]
        some = some[bound[some] > least]
        if not some.size:
            break
        values = criterion.value(rest + grams[some])
        if values.max() > least:
            least, best = float(values.max()), int(some[values.argmax()])
    return best, least
