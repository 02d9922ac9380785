"""``select_fastest``: the subset and the order of least time at a wanted efficiency."""

from __future__ import annotations

import dataclasses
import importlib
import time

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import numbers, one_of, share, whole_number
from jaxcal.information.criteria import d_efficiency
from jaxcal.models.model import Model
from jaxcal.models.uncertainty import Noise, Prior
from jaxcal.selection.fastest.motion import Motion
from jaxcal.selection.fastest.task import Search, Task, make_task
from jaxcal.selection.solvers import checked_seed

__all__ = ["METHODS", "FastSelection", "answer", "make_search", "select_fastest"]

# The option of each method; the module of the same name has ``search(task, option)``.
METHODS = {"exact": "seed", "heuristic": "seed", "lookahead": "num"}

_LEAST_EFFICIENCY = 0.95  # where neither one nor a weight is given
_MOST_EXACT = 12  # postures that the exact search accepts
_EXACT_BY_DEFAULT = 8


@dataclasses.dataclass(frozen=True, eq=False)
class FastSelection:
    """The postures in the order to visit, what the run takes, and what is proven."""

    indices: NDArray[np.int64]  # (k,) in the order to visit
    seconds: float  # of travel and settling
    travel_seconds: float
    log_det: float  # natural log det S, in the candidates' unit
    efficiency: float  # D-efficiency against ``bound``
    least_efficiency: float  # that was asked for; 0 where a weight was
    proven: bool  # no subset and order with that efficiency takes less time
    method: str  # as asked for; "exact" where only the D-optimum was efficient enough
    bound: float  # log det S of the D-optimum, an upper bound on it where not proven
    bound_proven: bool  # ``bound`` is the optimum
    nodes: int  # of the exact search
    search_seconds: float  # that finding it took


def select_fastest(
    candidates: ArrayLike,
    k: int | None = None,
    *,
    motion: Motion,
    least_efficiency: float | None = None,
    weight: float | None = None,
    start: ArrayLike | None = None,
    model: Model | None = None,
    blocks: ArrayLike | None = None,
    prior: Prior | ArrayLike | None = None,
    noise: Noise | None = None,
    measured: ArrayLike | None = None,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    num_outputs: int | None = None,
    method: str | None = None,
    time_limit: float = 60.0,
    num: int | None = None,
    seed: int | np.random.Generator | None = None,
) -> FastSelection:
    """Subset and order of least time with a D-efficiency of ``least_efficiency``.

    Args:
        candidates: (M, n) commands that could be measured, in any unit.
        k: postures to choose, distinct; the fewest that identify when not given.
        motion: speeds and accelerations in the candidates' unit, settle time.
        least_efficiency: in (0, 1], against the proven D-optimum; 0.95 when neither
            this nor a weight is given.
        weight: instead of it, what a second is worth: the run with the largest
            ``log(efficiency) - weight * seconds`` among those found ("lookahead" only).
        start: (n,) where the device stands; it begins at any posture when not given.
        model, blocks, prior, noise, measured: as in :func:`select`. Several readings
            per candidate, a prior or measurements: "exact" and "heuristic" only.
        available: (M,) bool, True where a candidate may be chosen.
        required: (r,) candidates that must be among the chosen.
        num_outputs: m; changes log det S, not the answer.
        method: "exact" (k up to 12, with a proof unless the time runs out),
            "heuristic" (local search) or "lookahead" (greedy with a price on time);
            when not given, exact up to k = 8 and the heuristic above, and the
            look-ahead where a weight is given.
        time_limit: seconds of the exact search and of the D-optimum behind all three.
        num: of the look-ahead: first postures tried at each of 32 prices of time; 8
            when not given.
        seed: of the heuristic's starts, from which exact starts too; an int, 0 when
            not given, or a numpy Generator.

    Returns:
        The selection; among runs of equal time the one with the largest determinant.

    Raises:
        ValueError: naming the argument, the rule and the value.
    """
    if weight is not None:
        if least_efficiency is not None:
            raise ValueError(
                "weight and least_efficiency must not both be given, got "
                f"{weight!r} and {least_efficiency!r}"
            )
        worth = numbers("weight", weight)
        if worth.ndim or worth < 0.0:
            raise ValueError(f"weight must be a number of at least 0, got {weight!r}")
        method = method or "lookahead"
        if method != "lookahead":
            raise ValueError(f"method must be lookahead with a weight, got {method!r}")
    given = _LEAST_EFFICIENCY if least_efficiency is None else least_efficiency
    least = share("least_efficiency", given)
    task = make_task(
        candidates, k, motion, start=start, time_limit=time_limit, model=model,
        blocks=blocks, prior=prior, noise=noise, measured=measured,
        available=available, required=required, num_outputs=num_outputs,
    )  # fmt: skip
    search = make_search(task, method, num, seed, weight)
    found = answer(task, search, 0.0 if weight is not None else least)
    if found is None:
        raise ValueError(
            f"least_efficiency must be reachable, got {least:g}; the optimum is only "
            "bounded within the time limit: give more time, or ask for less"
        )
    return found


def make_search(
    task: Task,
    method: str | None,
    num: int | None,
    seed: int | np.random.Generator | None,
    weight: float | None = None,
) -> Search:
    """The search of ``method``, or of the one that suits k; its option is checked."""
    if method is None:
        method = "exact" if task.k <= _EXACT_BY_DEFAULT else "heuristic"
    one_of("method", method, tuple(METHODS))
    if method == "exact" and task.k > _MOST_EXACT:
        raise ValueError(f"k must be at most {_MOST_EXACT} with exact, got {task.k}")
    for name, value in (("num", num), ("seed", seed)):
        if value is not None and name != METHODS[method]:
            others = [other for other in METHODS if METHODS[other] == name]
            raise ValueError(
                f'{name} is not an option of method "{method}" '
                f"(it is of {', '.join(others)})"
            )
    if method == "lookahead":
        option = 8 if num is None else whole_number("num", num, 1)
    else:
        option = 0 if seed is None else checked_seed(seed)
    module = importlib.import_module(f"jaxcal.selection.fastest.{method}")
    search: Search = module.search(task, option, *([] if weight is None else [weight]))
    return search


def answer(
    task: Task, search: Search, least: float, above: float | None = None
) -> FastSelection | None:
    """The fastest run with efficiency ``least``, and log det S over ``above``.

    None where the search finds no subset with that determinant.
    """
    begun = time.perf_counter()
    found = search(task.wanted(least, above) if least else -np.inf)
    if found is None:
        return None
    problem = task.problem
    tour, travel = task.tour(found.indices)
    indices = task.pool[tour]
    log_det = problem.log_det(indices)
    bound = max(task.exact.bound, log_det)
    return FastSelection(
        indices=indices,
        seconds=travel + task.settle,
        travel_seconds=travel,
        log_det=log_det,
        efficiency=d_efficiency(log_det, bound, problem.num_parameters),
        least_efficiency=least,
        proven=found.proven and task.exact.proven,
        method=str(found.method),
        bound=bound,
        bound_proven=task.exact.proven,
        nodes=found.nodes or 0,
        search_seconds=time.perf_counter() - begun,
    )
