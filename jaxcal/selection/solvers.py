"""The table of solvers, and which options each reads. A new solver is one row here.

A solver is a function ``solve(problem, *, option, ...) -> Solution``: its keyword
arguments are the options it reads, checked and complete.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import one_of, require_known, seconds, share, whole_number
from jaxcal.selection.exact import exact
from jaxcal.selection.exchange import exchange
from jaxcal.selection.problem import Problem, Solution, log_dets

_TRIES = 200  # random selections, before the greedy one, where all are singular


def solve_random(problem: Problem, *, seed: int) -> Solution:
    """The baseline of the paper: drawn uniformly, never singular, required first."""
    rng = np.random.default_rng(seed)
    ruled = problem.constraints is not None or np.ndim(problem.max_replicates) > 0
    start = exchange.Climbs(problem, checked_seed(rng)).random_start if ruled else None
    for _ in range(_TRIES):  # none singular in any scenario
        indices = start() if start else random_indices([problem], rng)[0][0]
        if problem.allows(indices) and np.isfinite(problem.log_det(indices)):
            return Solution(indices, seed=seed)
    return exchange.solve_greedy(problem)


def random_indices(
    problems: Sequence[Problem], rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """(B, k) drawn until none is singular, of problems of one shape, and log det S."""
    k, cap = problems[0].k, int(problems[0].upper.max())
    required, count = np.array([p.required for p in problems]), len(problems)
    taken = ~np.array([p.available for p in problems]).repeat(cap, axis=1)
    indices, values = np.empty((count, k), np.int64), np.empty(count)
    forced, singular = required.shape[1], np.arange(count)
    indices[:, :forced] = required
    if forced:
        taken[singular[:, None], required * cap] = True
    for _ in range(_TRIES):
        order = (rng.random((len(singular), taken.shape[1])) + taken[singular]).argsort(
            axis=1
        )
        indices[singular, forced:] = order[:, : k - forced] // cap
        values[singular] = log_dets(
            [problems[b] for b in singular.tolist()], indices[singular]
        )
        singular = singular[np.isneginf(values[singular])]
        if not singular.size:
            return indices, values
    for b in singular.tolist():  # tables that are nearly all duplicates
        indices[b] = exchange.greedy_indices(problems[b])
    return indices, log_dets(problems, indices)


@functools.cache
def _options(solve: Callable[..., Solution]) -> tuple[str, ...]:
    arguments = inspect.signature(solve).parameters.values()
    return tuple(x.name for x in arguments if x.kind == x.KEYWORD_ONLY)


def _policy(
    problem: Problem, *, seed: int, checkpoint: Any, decoding: str, num: int
) -> Solution:
    from jaxcal.selection.policy import choose

    taken = {
        "blocks": problem.candidates is None or problem.model is None,
        "another model": problem.blocks.shape[1] > 1 or problem.raw[0, 0, -1] != 1.0,
        "a prior": len(problem.root) > 0,
        f"criterion {problem.criterion.name}": problem.criterion.name != "D",
        "max_replicates above 1": np.max(problem.upper) > 1,
        "constraints": problem.constraints is not None,
    }
    for argument in filter(taken.get, taken):
        raise ValueError(
            'use method auto, exact or exchange here: "policy" is trained to choose '
            f"different candidates of y = A u + b by D alone, got {argument}"
        )
    indices = choose([problem], decoding, num, seed, checkpoint)[0]
    return Solution(np.asarray(indices, dtype=np.int64), seed=seed)


SOLVERS: dict[str, Callable[..., Solution]] = {
    "random": solve_random,
    "greedy": exchange.solve_greedy,
    "exchange": exchange.solve,
    "exact": exact.solve,
    "policy": _policy,
    "auto": exact.solve_auto,
}
METHODS = tuple(SOLVERS)

# Default and check of every option of a solver, by its name; a value equal to the
# default counts as not given.
OPTIONS: dict[str, tuple[Any, Callable[[Any], Any]]] = {
    "seed": (0, lambda value: checked_seed(value)),
    "restarts": (None, lambda value: whole_number("restarts", value, 1)),
    "time_limit": (None, lambda value: seconds("time_limit", value)),
    "best": (1, lambda value: whole_number("best", value, 1)),
    "checkpoint": (None, lambda value: value),
    "decoding": ("greedy", lambda value: value),
    "num": (16, lambda value: whole_number("num", value, 1)),
    "least_efficiency": (0.999, lambda value: share("least_efficiency", value)),
}


def checked_options(method: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """The options that a method reads, checked; defaults where they are not given. A
    ValueError where one is unknown, has a bad value, or belongs to other methods."""
    one_of("method", method, tuple(SOLVERS))
    reads = _options(SOLVERS[method])
    checked = {name: OPTIONS[name][0] for name in reads if name in OPTIONS}
    for name, value in given.items():
        require_known("option", name, tuple(OPTIONS))
        default, check = OPTIONS[name]
        if value is default or (type(value) is type(default) and value == default):
            continue
        value = check(value)
        if name not in reads:
            others = [other for other in SOLVERS if name in _options(SOLVERS[other])]
            raise ValueError(
                f'{name} is not an option of method "{method}" (only of '
                f"{', '.join(others)})"
            )
        checked[name] = value
    return checked


def checked_seed(value: Any) -> int:
    """``value``, or a number drawn from it where it is a numpy Generator."""
    if isinstance(value, np.random.Generator):
        return int(value.integers(2**63))
    return whole_number("seed", value, 0)
