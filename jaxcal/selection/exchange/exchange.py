"""Greedy selection, and Fedorov exchange with restarts: no proof, in milliseconds.

Each chosen candidate in turn is swapped for the one that raises the criterion most,
until no swap helps. The first starts are greedy selections, the others random ones that
are rarely singular. Source: Fedorov, Theory of Optimal Experiments, 1972; Cook and
Nachtsheim 1980 for one candidate at a time.

E, the smallest eigenvalue, is climbed from local optima of A: the sum of the variances
is at most p times the largest, and climbs from where the smallest eigenvalue stands
still because two are equal.
"""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal import compiled
from jaxcal.information.blocks import largest_rank
from jaxcal.selection.problem import Problem, values
from jaxcal.selection.solver import Found, in_threads

__all__ = [
    "Climbs",
    "default_restarts",
    "exchange_from",
    "exchange_indices",
    "greedy_indices",
    "solve",
    "solve_greedy",
]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# (k + 8) M q^2 p of the default starts of one call, about 10 ms; swaps for a trace or a
# subset of the parameters cost twice those for D. E, whose local optima differ more,
# gets more.
_WORK = {"D": 24e6, "E": 48e6, "other": 12e6}

# While a selection grows, a share of the information that k mean candidates give stands
# in for those that are not chosen yet: this one, less where k candidates have fewer
# readings than there are parameters, and in further starts of the exchange others.
_SHARE = 0.2
_FURTHER = (1.0, 0.03)
_RANK_FIRST = 1e-7  # every direction that nothing is known of outweighs the rest
_MENDING = 10  # random starts where all greedy ones are singular

_CLIMBS = 2.5e5  # k p^3 of the climbs of E in one call, from each kind of start


def solve(problem: Problem, *, seed: int, restarts: int | None) -> Found:
    """The solver "exchange"."""
    restarts = restarts or default_restarts(problem)
    indices = exchange_indices(problem, restarts, seed)
    return Found(indices, seed=seed, restarts=restarts)


def solve_many(
    problems: list[Problem], *, seed: int, restarts: int | None
) -> list[Found]:
    """One by one, the same seed for each."""
    return in_threads(problems, lambda p: solve(p, seed=seed, restarts=restarts))


def solve_greedy(problem: Problem) -> Found:
    """The solver "greedy"."""
    return Found(greedy_indices(problem))


def greedy_indices(problem: Problem) -> Indices:
    """(k,) candidates in the order picked, the required ones first.

    Gains count a share of what the candidates not chosen yet will give, and swaps mend
    a singular selection. For E the gain is that in the sum of the variances, which is
    at most p times and at least once the largest: an incomplete selection has no least
    eigenvalue to raise.
    """
    return Climbs(problem, 0, None).greedy()


def default_restarts(problem: Problem) -> int:
    """Starts that found the proven optimum of nearly all small problems tried.

    None of 12,000 distinct selections was missed (4, 8 or 12 of 50, three inputs) by
    200; replicates leave more local optima, and 1 in 1,000 selections of 12 was by 400.
    Large problems of blocks get fewer, so that they take 10 to 15 ms.
    """
    most = 200 if problem.max_replicates == 1 else 400
    if problem.rank_one:
        return most
    if problem.criterion.kind == "least":
        most = 80
    count, q, p = problem.blocks.shape
    work = _WORK.get(problem.criterion.name, _WORK["other"])
    return int(min(max(work / ((problem.k + 8) * count * q * q * p), 1.0), most))


class Climbs:
    """The available candidates of a problem as the compiled kernel takes them.

    E is treated as A: an incomplete selection has no least eigenvalue to raise.
    """

    def __init__(self, problem: Problem, seed: int, deadline: float | None) -> None:
        kernel = compiled.kernel("jaxcal.selection.exchange.kernel")
        self._usable = np.flatnonzero(problem.available)
        blocks, self._required = problem.blocks, problem.required
        if len(self._usable) < len(blocks):
            blocks = blocks[self._usable]
            self._required = np.searchsorted(self._usable, problem.required)
        self._blocks, self._full, self._deadline = blocks, 0, deadline
        criterion, q, p = problem.criterion, blocks.shape[1], blocks.shape[2]
        kind, root = kernel.TRACE, criterion.root
        if criterion.name == "D":
            kind = kernel.DET
        elif criterion.kind == "det":  # variances near 1
            kind = kernel.SUBSET
            root = root / np.linalg.norm(root, axis=1, keepdims=True)
        span = problem.known if len(problem.root) else problem.root
        self._share = _SHARE * min(1.0, problem.k * q / p) ** 6
        self._climber = kernel.Climber(
            kind, np.ascontiguousarray(blocks), np.ascontiguousarray(problem.prior),
            np.ascontiguousarray(root), min(problem.max_replicates, problem.k),
            self._required, np.ascontiguousarray(span), problem.k, seed,
        )  # fmt: skip

    def seconds(self) -> float:
        """Left until the deadline."""
        if self._deadline is None:
            return np.inf
        return max(self._deadline - time.perf_counter(), 0.0)

    def greedy(self) -> Indices:
        """(k,) the required, then one at a time by the largest gain.

        A selection that is singular is mended by swaps, as in the exchange.
        """
        for share, climbs in ((self._share, 0), (_RANK_FIRST, 0), (self._share, 1)):
            chosen, phi = self._climber.climb_from(
                self._required, share, climbs, self.seconds()
            )
            if phi > -np.inf:
                return self._usable[chosen]
        return self.best_of(1 + _MENDING)[0]

    def climbed_least(self, start: Indices) -> tuple[Indices, float]:
        """The local optimum of E that ``start`` (k,) climbs to, required first; E."""
        chosen, value = self._climber.climb_least(
            np.searchsorted(self._usable, start), self.seconds()
        )
        return self._usable[chosen], value

    def climbed(self, start: Indices) -> tuple[Indices, float]:
        """The local optimum that ``start`` (k,) climbs to, required first; its phi."""
        chosen, phi = self._climber.climb_from(
            np.searchsorted(self._usable, start), 0.0, True, self.seconds()
        )
        return self._usable[chosen], phi

    def _rank(self) -> int:
        """That a block can have, found where an exchange starts at random."""
        self._full = self._full or largest_rank(self._blocks)
        return self._full

    def random_start(self) -> Indices:
        """(k,) another random selection, rarely singular."""
        return self._usable[self._climber.random_start(self._rank())]

    def random_climb(self) -> tuple[Indices, float]:
        """The local optimum of another random start, and its phi."""
        return self.climbed(self.random_start())

    def best_of(self, restarts: int) -> tuple[Indices, float]:
        """The best local optimum from greedy selections and then random starts."""
        best, phi = self._required, -np.inf
        shares = (self._share, *_FURTHER)[:restarts]
        for share in shares:
            chosen, found = self._climber.climb_from(
                self._required, share, True, self.seconds()
            )
            if not phi > -np.inf or found > phi + 1e-10 * max(1.0, abs(phi)):
                best, phi = chosen, found
            if not self.seconds() and phi > -np.inf:
                break
        more = max(restarts - len(shares), 0 if phi > -np.inf else _MENDING)
        if more:
            best, phi = self._climber.random_climbs(
                more, best, phi, self.seconds(), self._rank()
            )
        return self._usable[best], phi


def exchange_indices(
    problem: Problem,
    restarts: int | None = None,
    seed: int = 0,
    deadline: float | None = None,
) -> Indices:
    """(k,) the best local optimum, required candidates first.

    ``deadline`` is a ``time.perf_counter()`` after which no more swaps are made.
    """
    if restarts is None:
        restarts = default_restarts(problem)
    climbs = Climbs(problem, seed, deadline)
    if problem.criterion.kind == "least":
        chosen, phi = _best_eigenvalue(problem, climbs, restarts)
    else:
        chosen, phi = climbs.best_of(restarts)
    if not np.isfinite(phi):
        raise ValueError(
            f"{problem.subject} must allow an invertible selection, "
            "but every start was singular"
        )
    return chosen


def exchange_from(problem: Problem, indices: ArrayLike) -> Indices:
    """The local optimum that a given selection climbs to; never worse than it was.

    Args:
        problem: what may be chosen; its required candidates stay.
        indices: (k,) where to start, not singular.

    Returns:
        (k,) the required candidates first.
    """
    given = np.asarray(indices, dtype=np.int64)
    for i in problem.required.tolist():
        if i not in given:
            raise ValueError(f"indices must hold every required candidate, got no {i}")
    if np.isneginf(problem.log_det(given)):
        raise ValueError(
            "indices must give an invertible information matrix, but that of "
            f"{given.tolist()} is singular"
        )
    start, climbs = _required_first(problem, given), Climbs(problem, 0, None)
    if problem.criterion.kind == "least":
        return climbs.climbed_least(start)[0]
    return climbs.climbed(start)[0]


def _required_first(problem: Problem, chosen: Indices) -> Indices:
    rest = chosen.tolist()
    for i in problem.required:
        rest.remove(i)
    return np.array([*problem.required, *rest], dtype=np.int64)


def _best_eigenvalue(
    problem: Problem, climbs: Climbs, restarts: int
) -> tuple[Indices, float]:
    """The best local optimum of E and its value.

    From local optima of A, the best first, and from random selections as often: the
    former come closer where there are many parameters, the latter where there are few.
    """
    many = (restarts + 1) // 2
    work = problem.k * problem.num_regressors**3
    many_climbs = int(min(max(_CLIMBS / work, 1), many))
    near = [climbs.best_of(1), *(climbs.random_climb() for _ in range(many - 1))]
    starts = np.unique([np.sort(start) for start, phi in near if phi > -np.inf], axis=0)
    if not len(starts):
        return near[0]
    order = np.argsort(-values(problem, starts)[0])[:many_climbs]
    found = [climbs.climbed_least(_required_first(problem, starts[i])) for i in order]
    for _ in range(min(many_climbs, restarts - many)):
        found.append(climbs.climbed_least(climbs.random_start()))
    return max(found, key=lambda each: each[1])
