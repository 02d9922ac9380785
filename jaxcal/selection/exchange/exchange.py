"""Greedy selection, and Fedorov exchange with restarts: no proof, in milliseconds.

Each chosen candidate in turn is swapped for the one that raises the criterion most,
until no swap helps. The first starts are greedy selections, the others random ones; E,
the smallest eigenvalue, is climbed from local optima of A. Source: Fedorov, Theory of
Optimal Experiments, 1972; Cook and Nachtsheim 1980 for one candidate at a time.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxcal import compiled
from jaxcal.checks import Array, Indices
from jaxcal.deadline import NEVER, Deadline
from jaxcal.selection.criteria import Criterion
from jaxcal.selection.problem import Constraints, Problem, ScenarioProblem, Solution

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

# Of more candidates than this, starts climb among some, chosen anew in each round.
_MANY, _SOME, _ROUNDS = 20_000, 4_000, 8

_CLIMBS = 2.5e5  # k p^3 of the climbs of E in one call, from each kind of start


def solve(
    problem: Problem,
    *,
    seed: int,
    restarts: int | None,
    time_limit: float | None = None,
) -> Solution:
    """The solver "exchange"."""
    restarts = restarts or default_restarts(problem)
    deadline = NEVER if time_limit is None else Deadline(time_limit)
    indices = exchange_indices(problem, restarts, seed, deadline)
    return Solution(indices, seed=seed, restarts=restarts)


def solve_greedy(problem: Problem) -> Solution:
    """The solver "greedy"."""
    return Solution(greedy_indices(problem))


def greedy_indices(problem: Problem) -> Indices:
    """(k,) candidates in the order picked, the required ones first.

    Gains count a share of what the candidates not chosen yet will give: the best of
    several shares, the last a small ridge, and of D's textbook, a small ridge in
    numbers near 1. Swaps mend a singular selection. For E the gain is that of A: an
    incomplete selection has no least eigenvalue to raise.
    """
    climbs, best, phi = Climbs(problem, 0), problem.required, -np.inf
    for share in (climbs.share, *_FURTHER, _RANK_FIRST):
        chosen, value = climbs.climbed(problem.required, share, 0)
        if not phi > -np.inf or value > phi + 1e-9 * max(1.0, abs(phi)):
            best, phi = chosen, value
    if problem.criterion.name == "D" and not problem.root.size:
        for blocks in _coordinates(problem):
            chosen, value = climbs.climbed(_textbook(problem, blocks), 0.0, 0)
            if value > phi:
                best, phi = chosen, value
    if phi > -np.inf:
        return best
    chosen, phi = climbs.climbed(problem.required, climbs.share)
    return chosen if phi > -np.inf else climbs.best_of(1 + _MENDING)[0]


def _coordinates(problem: Problem) -> list[Array]:
    """Blocks (M, q, p) near 1 whatever the unit: rows [u, 1] with u in [-1, 1] and in
    [0, 1], others over their largest entries."""
    raw = problem.raw
    used = raw[problem.available]
    low, spread = used.min(axis=0)[0], np.ptp(used, axis=0)[0]
    if raw.shape[1] > 1 or spread[-1] or not low[-1] or not spread[:-1].all():
        return [raw / np.abs(raw).max(axis=(0, 1)).clip(1e-300)]
    share = (raw[..., :-1] - low[:-1]) / spread[:-1]
    ones = np.ones((len(raw), 1, 1))
    return [np.append(u, ones, axis=-1) for u in (2.0 * share - 1.0, share)]


def _textbook(problem: Problem, raw: Array) -> Indices:
    """The required candidates, and the largest gains from a small ridge on, until
    there are as many readings as parameters."""
    upper, (_, q, p) = problem.upper.copy(), raw.shape
    ridge, chosen = _RANK_FIRST * np.mean(raw**2), [*problem.required]
    np.subtract.at(upper, problem.required, 1)
    while len(chosen) < min(problem.k, -(-p // q)):
        rows = raw[chosen].reshape(-1, p)
        inverse = np.linalg.inv(np.eye(p) * ridge + rows.T @ rows)
        gains = np.linalg.slogdet(np.eye(q) + raw @ inverse @ raw.transpose(0, 2, 1))[1]
        chosen.append(int(np.where(upper > 0, gains, -np.inf).argmax()))
        upper[chosen[-1]] -= 1
    return np.array(chosen, dtype=np.int64)


def default_restarts(problem: Problem) -> int:
    """Starts that found the proven optimum of nearly all small problems tried: 200
    missed none of 12,000 selections (4, 8 or 12 of 50, three inputs). Large problems of
    blocks get fewer: 10 to 15 ms."""
    most = 200 if np.max(problem.max_replicates) == 1 else 600
    if problem.rank_one:
        return most
    if problem.criterion.kind == "least":
        most = 100
    count, q, p = problem.blocks.shape
    name, least = problem.criterion.each.name, 1.0
    if problem.joint is not None:
        count *= len(problem.members)
        least = 3.0  # a start from each share of the greedy ones
        if name == "E":  # a swap takes eigenvalues in every scenario
            least, most = 1.0, 2
    work = _WORK.get(name, _WORK["other"])
    return int(min(max(work / ((problem.k + 8) * count * q * q * p), least), most))


class Climbs:
    """A problem as the compiled kernel takes it; E is grown and climbed as A."""

    def __init__(self, problem: Problem, seed: int, deadline: Deadline = NEVER) -> None:
        self._problem, self._deadline = problem, deadline
        _, q, p = problem.blocks.shape
        self.share = _SHARE * min(1.0, problem.k * q / p) ** 6
        self._terms: tuple[tuple[Array, Array], ...] = ()  # of the swaps that raise E
        if (joint := problem.joint) is not None:
            self._climber = self._joint(joint, seed)
        else:
            self._climber = _climber(problem, seed)
        self.random_start = self._climber.random_start  # (k,), the required first

    def _joint(self, problem: ScenarioProblem, seed: int) -> Any:
        """The climbers of the scenarios, joined."""
        kernel = compiled.kernel("jaxcal.selection.exchange.exchange_kernel")
        members = [_climber(member, seed) for member in problem.members]
        joint = kernel.JointClimber(members, problem.weights, problem.criterion.least)
        scale, shift = problem.terms()
        if problem.criterion.kind == "det":
            lengths = [_lengths(member.criterion) for member in problem.members]
            shift = shift - 2.0 * scale * [np.log(row).sum() for row in lengths]
        else:  # values near 1
            whole = [member.criterion.root for member in problem.members]
            size = np.array([(root * root).sum() for root in whole])
            share = problem.available.sum() / problem.k
            if problem.criterion.kind == "least":
                of_traces = 1.0 / scale
                of_traces = of_traces / (problem.weights @ (of_traces * size) * share)
                scale = scale / (problem.weights @ scale / share)
                self._terms = (of_traces, shift), (scale, shift)
            else:
                scale = scale / (problem.weights @ (scale * size) * share)
        joint.weigh(scale, shift)
        return joint

    def climbed(
        self, start: Indices, share: float = 0.0, swaps: int = 1
    ) -> tuple[Indices, float]:
        """``start`` completed and climbed, required first, and its phi; 2 climbs E."""
        if self._terms:
            self._climber.weigh(*self._terms[swaps == 2])
        remaining_s = self._deadline.remaining_s
        chosen, phi = self._climber.climb(start, share, swaps, remaining_s)
        return chosen, (phi if self._problem.allows(chosen) else -np.inf)

    def best_of(self, restarts: int) -> tuple[Indices, float]:
        """The best local optimum from greedy selections and then random starts."""
        best, phi = self._problem.required, -np.inf
        shares = (self.share, *_FURTHER)[:restarts]
        for share in shares:
            chosen, value = self.climbed(self._problem.required, share)
            if not phi > -np.inf or value > phi + 1e-10 * max(1.0, abs(phi)):
                best, phi = chosen, value
            if self._deadline.passed and phi > -np.inf:
                break
        more = max(restarts - len(shares), 0 if phi > -np.inf else _MENDING)
        if more:
            best, phi = self._climber.random_climbs(
                more, best, phi, self._deadline.remaining_s
            )
        if not phi > -np.inf and (rules := self._problem.constraints) is not None:
            one = self._problem  # rules that a choice one by one runs against
            counts = rules.selection(one.k, one.lower, one.upper)
            assert counts is not None  # or there were no problem
            rest = np.repeat(np.arange(len(counts)), counts - one.lower)
            return self.climbed(np.concatenate([one.required, rest]))
        return best, phi

    def best_least(self, problem: Problem, restarts: int) -> tuple[Indices, float]:
        """The best local optimum of E, and E: from local optima of A, the best first,
        and from random selections as often."""
        many = (restarts + 1) // 2
        work = problem.k * problem.num_regressors**3
        most = int(min(max(_CLIMBS / work, 1), many))
        near = [self.best_of(1)]
        near += [self.climbed(self.random_start()) for _ in range(many - 1)]
        kept = {tuple(np.sort(start)): start for start, phi in near if phi > -np.inf}
        if not kept:
            return near[0]
        starts = np.array(list(kept.values()))
        order = np.argsort(-problem.values(starts)[0])[:most]
        more = [self.random_start() for _ in range(min(most, restarts - many))]
        climbed = [self.climbed(start, swaps=2) for start in (*starts[order], *more)]
        return max(climbed, key=lambda one: one[1])


def _lengths(criterion: Criterion) -> Array:
    subset = criterion.form == "subset"
    return np.linalg.norm(criterion.root, axis=1) if subset else np.ones(1)


def rules_of(rules: Constraints | None, count: int) -> tuple[Array, Array, Any]:
    """Costs (r, M), most (r,) and order (r, M) as a kernel takes them."""
    if rules is None:
        none = np.zeros((0, count))
        return none, np.zeros(0), none.astype(np.intp)
    return rules.costs, rules.most, rules.order


def _climber(problem: Problem, seed: int) -> Any:
    """The kernel's of one scenario; E is climbed as A."""
    kernel = compiled.kernel("jaxcal.selection.exchange.exchange_kernel")
    criterion = problem.criterion
    root = criterion.root / _lengths(criterion)[:, None]
    return kernel.Climber(
        "trace" if criterion.form == "least" else criterion.form,
        *map(np.ascontiguousarray, (problem.blocks, problem.prior, root)),
        problem.upper.astype(np.intp), problem.required, problem.k, seed,
        *rules_of(problem.constraints, len(problem.available)),
    )  # fmt: skip


def exchange_indices(
    problem: Problem,
    restarts: int | None = None,
    seed: int = 0,
    deadline: Deadline = NEVER,
) -> Indices:
    """(k,) the best local optimum, required first; no more swaps after ``deadline``."""
    restarts = restarts or default_restarts(problem)
    narrows = problem.joint is None and problem.criterion.kind != "least"
    if narrows and np.count_nonzero(problem.upper) > _MANY and restarts > 1:
        chosen = _narrowed(problem, restarts, seed, deadline)
        if chosen is not None:
            return chosen
    climbs = Climbs(problem, seed, deadline)
    if problem.criterion.kind == "least":
        chosen, phi = climbs.best_least(problem, restarts)
    else:
        chosen, phi = climbs.best_of(restarts)
    if not np.isfinite(phi):
        raise ValueError(
            f"{problem.subject} allow no invertible selection: every start was singular"
        )
    return chosen


def _narrowed(
    problem: Problem, restarts: int, seed: int, deadline: Deadline
) -> Indices | None:
    """(k,) of many candidates. Each round starts among some, drawn at random and, after
    the first, of the largest leverage at the mean information of the rounds before;
    its best climbs among all. None where some identify nothing, or keep no rule."""
    generator, usable = np.random.default_rng(seed), np.flatnonzero(problem.upper)
    climbs, best, phi = Climbs(problem, seed, deadline), problem.required, -np.inf
    strongest, information = problem.required, problem.prior
    for number in range(1, _ROUNDS + 1):
        few = generator.choice(usable, _SOME, replace=False)
        few = np.unique(np.concatenate([few, strongest, problem.required]))
        try:
            start = exchange_indices(problem.among(few), restarts, seed, deadline)
        except ValueError:
            return None
        chosen, value = climbs.climbed(few[start])
        if value > phi:
            best, phi = chosen, value
        if deadline.passed:
            break
        rows = problem.blocks[chosen].reshape(-1, problem.num_regressors)
        information = (
            information + (rows.T @ rows + problem.prior - information) / number
        )
        slope = problem.criterion.slope(information)
        leverage = np.vecdot(problem.blocks @ slope, problem.blocks).sum(axis=1)
        strongest = usable[np.argpartition(-leverage[usable], _SOME)[:_SOME]]
    return best if phi > -np.inf else None


def fewest_regular(problem: Problem) -> Problem:
    """The problem with the fewest to choose that identify in every scenario."""
    if not isinstance(problem, ScenarioProblem):
        return problem
    most = int(problem.upper.sum())
    for k in range(problem.k, min(most, len(problem.members) * problem.k) + 1):
        trial = problem.of_size(k)
        if Climbs(trial, 0).best_of(1)[1] > -np.inf:
            return trial
    return problem


def exchange_from(problem: Problem, start: Indices) -> Indices:
    """(k,) the local optimum that a regular selection climbs to, required first."""
    rest = start.tolist()
    for i in problem.required.tolist():
        rest.remove(i)
    swaps = 2 if problem.criterion.kind == "least" else 1
    start = np.array([*problem.required, *rest], dtype=np.int64)
    return Climbs(problem, 0).climbed(start, swaps=swaps)[0]
