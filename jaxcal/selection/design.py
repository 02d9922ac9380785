"""``Design``: a design problem and its methods; ``select`` in one call."""

from __future__ import annotations

import dataclasses
import inspect
import math
import time
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import Indices, one_of, require_known, require_none, seconds
from jaxcal.deadline import Deadline
from jaxcal.late import late
from jaxcal.selection.exact.exact import TIME_LIMIT, solve_exact
from jaxcal.selection.exchange.exchange import fewest_regular
from jaxcal.selection.problem import (
    CandidateSet,
    Problem,
    Solution,
    problem_of,
)
from jaxcal.selection.result import Selection, Subset, optima_of
from jaxcal.selection.solvers import OPTIONS, SOLVERS, checked_options

_LARGE_S = 0.1  # to make a problem: of a larger one time_limit takes account
_PROVEN = 1e-9  # a value this near a proven optimum, relative above 1, is that optimum


class Design(CandidateSet):
    """The problem of choosing a few of these candidates, and its methods.

    Args:
        candidates: (M, n) commands that could be measured, in any unit; an array or a
            data frame, whose labels are kept. Rows that are not available may hold NaN.
            None where blocks are given.
        model: of ``jaxcal.models``; ``y = A u + b``, with as many outputs as inputs,
            when not given.
        prior: a ``jaxcal.Prior`` of the model's parameters, else its own default; of
            blocks a (p, p) precision, else nothing.
        noise: a ``jaxcal.Noise``, or its standard deviation; else that of the model (an
            arm), or of unit variance.
        measured: (N, n) commands measured already: answers count the new ones. Of
            blocks (N, q, p), of scenarios (S, N, q, p).
        available: (M,) bool or 0 and 1, True where a candidate may be chosen; all by
            default.
        required: (r,) candidates that must be among the chosen.
        max_replicates: how often a candidate may be chosen, a number or (M,); 1 keeps
            them distinct.
        blocks: (M, q, p) instead of candidates and model; candidate i gives q readings,
            ``y = B_i theta + noise`` with noise of unit variance unless ``noise`` is
            given, and adds ``B_i.T @ B_i`` to the information. Or (S, M, q, p), those
            of S scenarios.
        commands: (M, n) of the blocks, for travel between them and for tables.
        scenarios: if the nominal is uncertain, parameter values to average over: a
            whole number of draws from the prior (seeded), (S, p), or ``(parameters,
            weights)``; of blocks their weights (S,), of sum 1, equal when not given. A
            criterion is then ``jaxcal.Mean("D")``, as letters alone are, or
            ``jaxcal.Worst("D")``.
        constraints: (A, b), A (r, M) or (M,) and b (r,) or a number: a selection must
            have ``A w <= b``, w (M,) how often each candidate is chosen.
        names: (M,) names of the candidates, for the answers.

    Raises:
        ValueError: naming the argument, the rule and the value; here or when a question
            is asked.
    """

    @classmethod
    def from_blocks(
        cls,
        blocks: ArrayLike,
        prior: ArrayLike | None = None,
        *,
        weights: ArrayLike | None = None,
        **rules: Any,
    ) -> Self:
        """``Design(blocks=blocks, prior=prior, scenarios=weights, **rules)``."""
        return cls(blocks=blocks, prior=prior, scenarios=weights, **rules)

    @property
    def candidate_set(self) -> Self:
        """Itself, whose attributes are the arguments, checked."""
        return self

    def __repr__(self) -> str:
        model, usable = self.model, self.available
        what = "blocks" if model is None else type(model).__name__
        return f"Design of {len(usable)} candidates, {usable.sum()} available, {what}"

    def problem(
        self, k: int | None = None, criterion: Any = None, region: Any = None
    ) -> Problem:
        """The problem of choosing k, the fewest that identify if None."""
        return problem_of(self, k, criterion, region)

    def select(
        self,
        k: int | None = None,
        criterion: Any = None,
        method: str = "auto",
        *,
        region: ArrayLike | None = None,
        **options: Any,
    ) -> Selection:
        """Choose the k candidates whose measurements are most informative.

        Args:
            k: candidates to choose; the fewest that identify (n + 1) when not given.
            criterion: "D" (joint uncertainty of the parameters), "A" (sum of their
                variances), "I" (mean variance of the predictions), "G" (the largest of
                them), "E" (the worst-known combination), or one with data:
                ``jaxcal.I(region)``, ``jaxcal.Ds([...])``, ``jaxcal.As([...])``. D for
                the affine model and for blocks, I for other models.
            method: "auto" (the cheapest way to an answer proven to have
                ``least_efficiency``), "exact" (proven), "exchange" (near-optimal),
                "greedy", "random" or "policy" (the trained network; affine model, D).
            region: where predictions are wanted, of I and G by their letters.
            options: those that the method reads:

                - seed: whole number, 0, or numpy Generator; of all but greedy.
                - restarts: starts of exchange; 30 where it starts exact and auto.
                - time_limit: seconds after which exact and auto return the best found
                  with a true ``bound``, and exchange what it has; 10, of exchange none,
                  and 2 for auto with blocks, a prior or another criterion than D.
                - best: of exact, how many best subsets to prove, in ``alternatives``.
                - least_efficiency: of auto, what suffices, 0.999.
                - checkpoint, decoding, num: of policy, a folder, else what ships; how
                  it chooses and how many it tries.

        Raises:
            ValueError: also where every selection is singular.
        """
        checked = checked_options(method, options)
        start = time.perf_counter()
        problem = self.problem(k, criterion, region)
        problem = _with_optima(fewest_regular(problem) if k is None else problem)
        spent = time.perf_counter() - start
        if spent > _LARGE_S and (limit := checked.get("time_limit")):
            checked["time_limit"] = float(f"{max(limit - spent, 0.1 * limit):.3g}")
        solution = SOLVERS[method](problem, **checked)
        return self._judged(problem, solution, method, start)

    def score(
        self,
        indices: ArrayLike,
        criterion: Any = None,
        *,
        reference: str = "bound",
        time_limit: float | None = None,
    ) -> Selection:
        """Score a subset made elsewhere as if a solver had returned it.

        Args:
            indices: (k,) the subset; repeated entries are replicates.
            criterion: as in ``select``.
            reference: of ``bound`` and ``efficiency``: "bound" (the cheapest bound,
                computed when read) or "exact" (the optimum).
            time_limit: seconds for the optimum, 10 when not given.

        Raises:
            ValueError: also where the subset is singular.
        """
        one_of("reference", reference, ("bound", "exact"))
        limit = TIME_LIMIT if time_limit is None else seconds("time_limit", time_limit)
        start = time.perf_counter()
        subset = np.asarray(indices)
        if subset.ndim != 1 or subset.dtype.kind not in "iu" or not len(subset):
            rule = "indices must be a (k,) array of whole numbers, at least one"
            got = f"shape {subset.shape} and dtype {subset.dtype}"
            raise ValueError(f"{rule}, got {got}")
        subset = subset.astype(np.int64)
        problem = _with_optima(self._problem_with(subset, criterion))
        if reference == "bound":
            return self._judged(problem, Solution(subset), "score", start)
        optimum = solve_exact(problem, deadline=Deadline(limit))
        value = float(problem.values(subset[None])[0][0])
        assert optimum.bound is not None
        near = abs(value - optimum.bound) <= _PROVEN * max(1.0, abs(optimum.bound))
        proven = optimum.proven and near
        solution = Solution(subset, bound=optimum.bound, proven=proven)
        return self._judged(problem, solution, "score", start)

    def _problem_with(self, subset: Indices, criterion: Any) -> Problem:
        """The problem of which a subset (k,) may be the answer; refuses any other."""
        count = len(self.available)
        outside = (subset < 0) | (subset >= count)
        require_none(outside, subset, f"indices must lie in [0, {count})")
        masked = ~self.available[subset]
        require_none(masked, subset, "indices must be available", ", which is masked")
        problem = self.problem(len(subset), criterion)
        times = np.bincount(subset, minlength=count)
        missing = problem.required[times[problem.required] == 0]
        if len(missing):
            raise ValueError(f"indices lack the required candidate {missing[0]}")
        if (over := np.flatnonzero(times > problem.upper)).size:
            raise ValueError(
                "indices may repeat a candidate at most max_replicates = "
                f"{problem.upper[over[0]]} times, got {times[over[0]]}"
            )
        if problem.constraints is not None:
            if broken := problem.constraints.broken(times):
                raise ValueError(f"indices violate the constraints: {broken}")
        return problem

    plan = late("jaxcal.selection.plan:plan")
    fastest = late("jaxcal.designs.travel:fastest")
    pareto = late("jaxcal.designs.travel:pareto")
    refine = late("jaxcal.designs.continuous:refine")

    def _judged(
        self, problem: Problem, solution: Solution, method: str, start: float
    ) -> Selection:
        """What a solver found, judged by the caller's numbers."""
        indices, value = np.asarray(solution.indices), solution.value
        _require_allowed(problem, indices, method)
        log_det = solution.log_det
        if value is None or log_det is None:
            value, log_det = (float(pair[0]) for pair in problem.values(indices[None]))
        if log_det == -math.inf:
            name = "indices" if method == "score" else "method"
            whose = "" if method == "score" else f", which {method!r} returned"
            raise ValueError(
                f"{name} must give an invertible information matrix, but that of "
                f"{indices.tolist()}{whose} is singular{self._why_singular(indices)}"
            )
        least = problem.criterion.kind == "least"
        if not math.isfinite(value) or (least and not value > 0.0):
            raise ValueError(
                f"criterion {problem.criterion.name} is {value} in double precision; "
                "give the commands in other units"
            )
        best = solution.alternatives or [(indices, value, log_det)]
        return Selection(
            indices, value, log_det, solution.method or method, solution.proven,
            time.perf_counter() - start, problem, solution.reason, solution.seed,
            solution.restarts, solution.nodes, tuple(Subset(*x) for x in best),
            solution.bound, self.names, self.axes,
        )  # fmt: skip

    def _why_singular(self, indices: Indices) -> str:
        """What choosing among these candidates alone would be refused for."""
        usable, k = np.isin(np.arange(len(self.available)), indices), len(indices)
        rules = {"required": None, "max_replicates": k, "constraints": None}
        alone = self.but(available=usable, **rules)
        try:
            problem_of(alone, len(indices))
        except ValueError as error:
            return f": {error}"
        return ""


def _with_optima(problem: Problem) -> Problem:
    """With the optimum of each scenario, where the criterion compares by these."""
    if (joint := problem.joint) is None or not joint.criterion.of_efficiency:
        return problem
    return dataclasses.replace(joint, optima=optima_of(joint)[0])


def _require_allowed(problem: Problem, indices: Indices, method: str) -> None:
    """Refuse what is no selection of this problem: the solver is wrong."""
    count = len(problem.available)
    right = indices.shape == (problem.k,) and indices.dtype.kind in "iu"
    if right := right and bool(((0 <= indices) & (indices < count)).all()):
        counts = np.bincount(indices, minlength=count)
        right = bool(((problem.lower <= counts) & (counts <= problem.upper)).all())
    if not right or not problem.allows(indices):
        raise RuntimeError(
            f"method {method!r} must return {problem.k} candidates within the bounds "
            f"lower and upper of its problem, got {indices.tolist()}"
        )


def select(
    candidates: ArrayLike | None = None,
    k: int | None = None,
    method: str = "auto",
    *,
    criterion: Any = None,
    region: ArrayLike | None = None,
    **given: Any,
) -> Selection:
    """Choose the k candidates whose measurements are most informative.

    ``Design(candidates, ...).select(k, criterion, method, ...)`` in one call.

    Args:
        candidates: (M, n) commands that could be measured, or None with blocks.
        k, method, criterion, region: see ``Design.select``.
        given: model, prior, noise, measured, available, required, max_replicates,
            constraints, blocks, commands, scenarios, names: of ``Design``; seed,
            restarts, time_limit, best, least_efficiency, checkpoint, decoding, num:
            those that the method reads, of ``Design.select``.
    """
    options = {name: given.pop(name) for name in OPTIONS if name in given}
    for name in given:
        require_known("argument", name, _ARGUMENTS)
    checked_options(method, options)  # before any work
    design = Design(candidates, **given)
    return design.select(k, criterion, method, region=region, **options)


_ARGUMENTS = (*inspect.signature(Design).parameters, "k", "method", *OPTIONS)
