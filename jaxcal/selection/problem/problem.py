"""A selection problem, checked once, in coordinates no unit or axis can distort.

Solvers read whitened information blocks: candidate i adds ``B_i.T @ B_i`` to the
prior's precision, and with everything available measured at once the sum is the
identity: they pick the same candidates in pulses, degrees or [0, 1]. Postures of the
affine model are blocks [u, 1] that count once per output.

Each of several scenarios is a problem of its own, in its own coordinates. Sums and
minima of concave functions are concave, so what proves a selection of one problem
proves that of several.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Array, Indices, Mask, array_of
from jaxcal.information.blocks import WhiteBlocks, rank_of_blocks
from jaxcal.information.singular import significant
from jaxcal.models.model import Model
from jaxcal.selection.criteria import ScenarioCriterion

_EPS = float(np.finfo(np.float64).eps)
_IN_PLANE = 1e-7  # of whitened rows of height one above the origin
_SLACK = 1e-9  # of the largest sum: rounding breaks no constraint


@dataclasses.dataclass(frozen=True, eq=False)
class Constraints:
    """``costs @ counts <= most``: r rules for M candidates."""

    costs: Array  # (r, M)
    most: Array  # (r,) with what rounding may add

    def broken(self, counts: Indices) -> str:
        """The first rule that counts (M,) break, in words; "" where none is."""
        total = self.costs @ counts
        for r in np.flatnonzero(total > self.most):
            return f"row {r} of A w is {total[r]:.6g}, more than {self.most[r]:.6g}"
        return ""

    def of(self, rows: Indices) -> Constraints:
        """Constraints on the candidates ``rows`` alone."""
        return Constraints(np.ascontiguousarray(self.costs[:, rows]), self.most)

    @functools.cached_property
    def order(self) -> NDArray[np.intp]:
        """(r, M) candidates, the cheapest first."""
        return np.argsort(self.costs, axis=1, kind="stable").astype(np.intp)

    def selection(self, k: int, lower: Indices, upper: Indices) -> Indices | None:
        """Counts (M,) of sum k within bounds that keep all rules; None: there are none.
        A ValueError where the search for them did not end."""
        from scipy import optimize

        size = np.abs(self.costs).max(axis=1, keepdims=True, initial=1e-300)
        cheapest, counts = (self.costs / size).sum(axis=0).argsort(), lower.copy()
        room = (upper - lower)[cheapest]
        before = np.cumsum(room) - room  # the cheapest together are often allowed
        counts[cheapest] += (k - lower.sum() - before).clip(0, room)
        if counts.sum() == k and not self.broken(counts):
            return counts
        within = optimize.LinearConstraint(
            np.vstack([self.costs, np.ones(len(lower))]),
            np.append(np.full(len(self.most), -np.inf), k),
            np.append(self.most, k),
        )
        answer = optimize.milp(
            np.zeros(len(lower)), integrality=np.ones(len(lower)),
            bounds=optimize.Bounds(lower, upper), constraints=within,
            options={"time_limit": 60.0},
        )  # fmt: skip
        if answer.status not in (0, 2):
            raise ValueError(
                f"constraints could not be checked for a selection: {answer.message}"
            )
        return None if answer.x is None else np.rint(answer.x).astype(np.int64)


def checked_constraints(given: Any, count: int) -> Constraints | None:
    """``(A, b)`` as given, A (r, M) or (M,) and b (r,) or a number."""
    if given is None:
        return None
    if not isinstance(given, tuple | list) or len(given) != 2:
        raise ValueError("constraints must be a pair (A, b) with A w <= b")
    rule = ", a column for each candidate"
    costs = array_of("A of constraints", np.atleast_2d(given[0]), "r", count, rule=rule)
    most = array_of("b of constraints", np.atleast_1d(given[1]), len(costs))
    size = np.abs(most) + np.abs(costs).max(axis=1, initial=0.0)
    return Constraints(costs, most + _SLACK * size)


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """Choose ``k`` of M candidates; all arrays are its own and cannot be written to."""

    white: WhiteBlocks  # blocks and prior in coordinates where all of them are I
    k: int  # candidates to choose
    available: Mask  # (M,) True where a candidate may be chosen
    required: Indices  # (r,) candidates that must be chosen, r <= k
    max_replicates: int | Indices  # how often one candidate may be chosen, or (M,)
    criterion: Any  # Criterion or ScenarioCriterion, in the same coordinates
    multiplicity: int  # how often log det of the blocks counts
    raw: Array  # (M, q, p) blocks in the caller's numbers, at most p readings each
    readings: Array  # (M, Q, p) these with every reading, as ``raw`` where q is Q
    root: Array  # (r, p) root of the caller's prior precision, with what was measured
    candidates: Array | None = None  # (M, n) in the caller's unit, where there are any
    model: Model | None = None  # what made blocks of the candidates
    constraints: Constraints | None = None  # on how often each is chosen

    @property
    def members(self) -> tuple[Problem, ...]:
        """The problem of each scenario, itself where there is one."""
        return (self,)

    @property
    def joint(self) -> ScenarioProblem | None:
        """Itself, where there are several scenarios."""
        return None

    @functools.cached_property
    def blocks(self) -> Array:
        """(M, q, p) whitened information blocks, zero where not available."""
        return self.white.blocks

    @functools.cached_property
    def prior(self) -> Array:
        """(p, p) precision known beforehand, in the same coordinates."""
        return self.white.prior

    @property
    def rows(self) -> Array:
        """(M, p) the blocks of a problem with one reading per candidate."""
        return self.blocks[:, 0]

    @property
    def rank_one(self) -> bool:
        """One reading per candidate, criterion D: these have kernels of their own."""
        return self.blocks.shape[1] == 1 and self.criterion.name == "D"

    @property
    def num_regressors(self) -> int:
        """p, n + 1 for the affine model."""
        return self.blocks.shape[2]

    @property
    def subject(self) -> str:
        """The argument that errors are about."""
        return "blocks" if self.model is None else "candidates"

    @property
    def lower(self) -> Indices:
        """(M,) how often each candidate must be chosen."""
        lower = np.zeros(len(self.blocks), dtype=np.int64)
        lower[self.required] = 1
        return lower

    @property
    def upper(self) -> Indices:
        """(M,) how often each candidate may be chosen."""
        return self.available * np.minimum(np.int64(self.max_replicates), self.k)

    def allows(self, indices: Indices) -> bool:
        """Whether a selection (k,) keeps the constraints."""
        if self.constraints is None:
            return True
        counts = np.bincount(indices, minlength=len(self.available))
        return not self.constraints.broken(counts)

    @property
    def simplex(self) -> bool:
        """The k = p chosen span a simplex, and det is its squared volume: one reading
        each, nothing known, D, all rows in a plane off the origin as those of [u, 1].
        The optimum then uses vertices of the convex hull only."""
        more = len(self.root) or self.constraints is not None
        if not self.rank_one or self.k != self.num_regressors or more:
            return False
        height = self.rows @ self.rows.sum(axis=0)
        return bool((np.abs(height - 1.0) <= _IN_PLANE)[self.available].all())

    @property
    def held_rank(self) -> int:
        """Rank of what is known with the required candidates."""
        rows = self.blocks[self.required].reshape(-1, self.num_regressors)
        rows = np.concatenate([rows, self.white.of(self.root)])
        return int(significant(np.linalg.svd(rows, compute_uv=False)).sum())

    def uncertainty(self, indices: Indices) -> float:
        """By how much rounding may change phi of a selection (k,), as a share; of "det"
        every eigenvalue.

        With E the errors of the chosen blocks B, one below the other, and M = L L.T, M
        changes by ``E.T B + B.T E``, of itself by 2 |B L^-T| |E L^-T|, the first at
        most 1, the second |E| / sqrt(least eigenvalue of M); beside rounded sums.
        """
        p = self.num_regressors
        rows = self.blocks[indices].reshape(-1, p)
        information = rows.T @ rows + self.prior
        unit = np.sqrt(np.diagonal(information))  # a selection's own scale
        if not unit.all():
            return np.inf
        shares = np.linalg.eigvalsh(information / (unit[:, None] * unit))
        least, largest = float(shares[0]), float(shares[-1])
        if not least > 0.0:
            return np.inf
        size = np.abs(rows @ self.white.triangle)
        if self.white.size is not None:
            size += self.white.size
        error = (size @ np.abs(self.white.inverse) / unit).ravel()
        of_blocks = 2.0 * p * math.sqrt(float(error @ error) / least)
        return _EPS * (of_blocks + len(rows) * largest / least)

    def of_size(self, k: int) -> Self:
        """This problem with k candidates to choose."""
        return dataclasses.replace(self, k=k)

    def among(self, rows: Indices) -> Self:
        """This problem with the candidates ``rows`` (N,) alone, ascending, the required
        ones among them."""
        times, rules, commands = self.max_replicates, self.constraints, self.candidates
        return dataclasses.replace(
            self,
            white=self.white._replace(blocks=self.blocks[rows]),
            available=self.available[rows],
            required=np.searchsorted(rows, self.required),
            max_replicates=times[rows] if isinstance(times, np.ndarray) else times,
            raw=self.raw[rows],
            readings=self.readings[rows],
            candidates=None if commands is None else commands[rows],
            constraints=None if rules is None else rules.of(rows),
        )

    def values(self, indices: Indices) -> tuple[Array, Array]:
        """(R,) reported value of the criterion, and log det S, of subsets (R, k)."""
        raw = self.raw[indices]
        log_det = rank_of_blocks(raw, self.root, self.white.size)[1]
        log_det *= self.multiplicity
        if self.criterion.name == "D":
            return log_det, log_det
        rows = self.blocks[indices].reshape(len(indices), -1, self.num_regressors)
        phi = self.criterion.value(np.matrix_transpose(rows) @ rows + self.prior)
        phi = np.where(np.isneginf(log_det), -np.inf, phi)
        return np.asarray(self.criterion.reported(phi)), log_det

    def log_det(self, indices: Indices) -> float:
        """log det S of a subset, natural, in the caller's units; -inf if singular."""
        return float(log_dets([self], np.asarray(indices)[None])[0])


@dataclasses.dataclass(frozen=True, eq=False)
class ScenarioProblem(Problem):
    """Choose k by a joined criterion; attributes of a ``Problem`` are the first
    scenario's."""

    members: tuple[Problem, ...] = ()  # (S,) the scenarios
    weights: Array = dataclasses.field(default_factory=lambda: np.zeros(0))  # (S,)
    optima: Array | None = None  # (S,) reported values, of a worst efficiency
    nominal: Problem | None = None  # at the model's nominal, where there is a model

    @property
    def joint(self) -> Self:
        return self

    def of_size(self, k: int) -> Self:
        members = tuple(member.of_size(k) for member in self.members)
        nominal = None if self.nominal is None else self.nominal.of_size(k)
        return dataclasses.replace(self, k=k, members=members, nominal=nominal)

    def uncertainty(self, indices: Indices) -> float:
        return max(member.uncertainty(indices) for member in self.members)

    def log_det(self, indices: Indices) -> float:
        """Weighted mean of log det S over the scenarios; -inf if one is singular."""
        return float(self.values(np.asarray(indices)[None])[1][0])

    def scenario_values(self, indices: Indices) -> tuple[Array, Array]:
        """(S, R) reported values and log det S of subsets (R, k) in each scenario."""
        both = np.array([member.values(indices) for member in self.members])
        return both[:, 0], both[:, 1]

    def efficiencies(self, values: Array, optima: Array) -> Array:
        """(S, R) of reported values (S, R) against optima (S,); 0 where singular."""
        one, pairs = self.criterion.each, zip(values, optima, strict=True)
        return np.array(
            [
                [one.efficiency(x, best) if np.isfinite(x) else 0.0 for x in row]
                for row, best in pairs
            ]
        )

    def values(self, indices: Indices) -> tuple[Array, Array]:
        """(R,) joined value, as reported, and mean log det S of subsets (R, k)."""
        of_members, log_dets = self.scenario_values(indices)
        regular = np.isfinite(log_dets).all(axis=0)
        joined: ScenarioCriterion = self.criterion
        if joined.of_efficiency:
            assert self.optima is not None
            of_members = self.efficiencies(of_members, self.optima)
        if joined.least:
            value = of_members.min(0) if joined.larger_is_better else of_members.max(0)
        else:
            value = self.weights @ np.where(regular, of_members, 0.0)
        worst = -np.inf if joined.larger_is_better else np.inf
        log_det = self.weights @ np.where(regular, log_dets, 0.0)
        return np.where(regular, value, worst), np.where(regular, log_det, -np.inf)

    def terms(self) -> tuple[Array, Array]:
        criteria = [member.criterion for member in self.members]
        of_criteria: tuple[Array, Array] = self.criterion.terms(criteria, self.optima)
        return of_criteria


def joined_problem(
    members: Sequence[Problem],
    weights: Array,
    criterion: ScenarioCriterion,
    nominal: Problem | None,
) -> Problem:
    """The problem of scenarios (S,) with weights (S,); that of one where all are equal
    and no efficiencies count. ``nominal``: the problem at the model's nominal."""
    first, k = members[0], max(member.k for member in members)
    if not criterion.of_efficiency and all(
        (member.raw == first.raw).all() and np.array_equal(member.root, first.root)
        for member in members[1:]
    ):
        return first
    # The fewest that identify in every scenario, where k was not given.
    members = [one if one.k == k else one.of_size(k) for one in members]
    if nominal is not None and nominal.k != k:
        nominal = nominal.of_size(k)
    return scenario_problem(members, criterion, weights, nominal)


def scenario_problem(
    members: Sequence[Problem],
    criterion: ScenarioCriterion,
    weights: Array,
    nominal: Problem | None = None,
) -> ScenarioProblem:
    """The problem of these scenarios, whose criterion is within that of the first."""
    fields = {f.name: getattr(members[0], f.name) for f in dataclasses.fields(Problem)}
    fields["criterion"] = criterion.within(members[0].criterion)
    weights = np.array(weights)
    weights.flags.writeable = False
    return ScenarioProblem(
        **fields, members=(*members,), weights=weights, nominal=nominal
    )


@dataclasses.dataclass(frozen=True, eq=False)
class Solution:
    """A solver's answer; what it leaves out is judged by the caller."""

    indices: Indices  # (k,) in the order picked
    value: float | None = None  # of the criterion, as reported to the caller
    log_det: float | None = None  # natural log det S, where it was computed
    bound: float | None = None  # no selection allowed has a better value
    proven: bool = False  # no selection is better by more than 1e-9
    nodes: int | None = None  # nodes of branch and bound or of the search
    alternatives: tuple[tuple[Indices, float, float], ...] = ()  # with value, log det
    method: str | None = None  # the solver that answered, where another was asked
    reason: str = ""  # one sentence
    seed: int | None = None  # where it draws at random
    restarts: int | None = None  # random starts of the exchange


def log_dets(problems: Sequence[Problem], indices: Indices) -> Array:
    """(R,) log det S of a subset (R, k) of each, of one model; -inf if singular."""
    raw = np.array([one.raw[i] for one, i in zip(problems, indices, strict=True)])
    first = problems[0]
    return first.multiplicity * rank_of_blocks(raw, first.root, first.white.size)[1]
