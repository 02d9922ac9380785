"""Fast runs by the policy that knows what time is worth, or by its look-ahead alone.

One compiled call chooses for 32 weights of time at once, each from its likeliest first
postures. A weight reaches only the convex hull of time against efficiency; so for a
wanted efficiency the last two postures of every run are chosen again: of all pairs that
meet it, the one that is reached soonest. JAX is loaded by the first call.
"""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.fastest.travel import fastest_tour, improved_tour
from jaxcal.selection.problem import Problem

__all__ = ["METHODS", "WEIGHTS", "completed", "runs"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

METHODS = ("policy", "lookahead")

# Of log det(Z.T Z) a mean move: none, and from where it hardly matters to where the
# device stays as near as it can. The range of the training.
WEIGHTS = np.concatenate([[0.0], np.geomspace(0.02, 6.0, 31)])

_CELLS = 4_000_000  # pairs of candidates scored at once: bounds memory, not the result
_KEPT = 30  # completions of a run that are put in their best order,
_KEPT_IN_ALL = 100  # and of all runs together
_EXACT_INSIDE = 7  # postures up to which that is exact for each
_RIDGE = 1e-8  # of the whitened Gram matrix of fewer postures than parameters


def _network(method: str, checkpoint: str | pathlib.Path | None) -> tuple[Any, Any]:
    """The network and its parameters; none for the look-ahead."""
    from jaxcal.learning.policies import networks
    from jaxcal.learning.runtime.checkpoint_folder import default_folder
    from jaxcal.learning.training import checkpoint as checkpoints

    if method == "lookahead":
        return networks.build(networks.NetworkConfig(kind="travel")), None
    folder = default_folder("travel") if checkpoint is None else checkpoint
    policy = checkpoints.load(folder)
    kind = policy.network.config.kind
    if kind != "travel":
        raise ValueError(
            f"checkpoint must hold a travel policy, got a {kind} one in {folder}"
        )
    return policy.network, policy.params


def runs(
    problem: Problem,
    times: Array,
    start: Array,
    method: str,
    num: int,
    checkpoint: str | pathlib.Path | None = None,
    weights: Array = WEIGHTS,
) -> Indices:
    """Runs for every weight, in the order of choice.

    Args:
        problem: candidates, what may and what must be chosen, k.
        times: (M, M) seconds between candidates; anything where one is not usable.
        start: (M,) seconds from the start.
        method: "policy" or "lookahead".
        num: first postures tried for each weight.
        checkpoint: folder of the policy; the one that ships when None.
        weights: (W,) of log det(Z.T Z) a mean move.

    Returns:
        (R, k) distinct runs, required postures first.
    """
    from jaxcal.learning.policies import travel_decoding

    network, params = _network(method, checkpoint)
    usable = problem.available.copy()
    usable[problem.required] = True
    m, k = len(usable), problem.k
    points = np.where(usable[:, None], problem.rows[:, :-1], 0.0).astype(np.float32)
    pairs = usable[:, None] & usable
    mean = times[pairs].mean()
    priced = np.where(pairs, times, 0.0) / (mean if mean > 0 else 1.0)
    begun = np.where(usable, start, 0.0) / (mean if mean > 0 else 1.0)
    size = int(np.clip(_CELLS // (m * m * num), 1, len(weights)))
    found = []
    for i in range(0, len(weights), size):
        some = weights[i : i + size]
        some = np.concatenate([some, np.zeros(size - len(some))])
        picks = travel_decoding.runs(
            network,
            params,
            np.broadcast_to(points, (size, *points.shape)),
            np.broadcast_to(problem.available, (size, m)),
            np.broadcast_to(problem.required, (size, len(problem.required))),
            (some[:, None, None] * priced).astype(np.float32),
            (some[:, None] * begun).astype(np.float32),
            k=k,
            num=num,
        )
        found.append(np.asarray(picks).reshape(-1, k))
    return np.unique(np.concatenate(found), axis=0).astype(np.int64)


def completed(
    runs: Indices,
    rows: Array,
    times: Array,
    start: Array,
    wanted: float,
    num_required: int,
) -> tuple[Indices | None, float]:
    """The fastest subset that the runs reach with a determinant of at least ``wanted``.

    Args:
        runs: (R, k) in the order of choice, required first.
        rows: (M, p) whitened regressors.
        times: (M, M) seconds.
        start: (M,) seconds.
        wanted: least log det(X_s.T X_s).
        num_required: postures at the front of every run that stay.

    Returns:
        (k,) subset, and the seconds of travel of its best order found; None where no
        run gets there.
    """
    k = runs.shape[1]
    front = max(k - 2, num_required)
    found: dict[tuple[int, ...], float] = {}
    for before in np.unique(runs[:, :front], axis=0):
        for seconds, last in _endings(before, k, rows, times, start, wanted):
            subset = tuple(sorted([*before.tolist(), *last]))
            found[subset] = min(seconds, found.get(subset, np.inf))
    best: Indices | None = None
    least = np.inf
    for subset in sorted(found, key=lambda s: found[s])[:_KEPT_IN_ALL]:
        chosen = np.array(subset)
        x = rows[chosen]
        sign, value = np.linalg.slogdet(x.T @ x)
        if sign <= 0 or value < wanted:
            continue
        between, begin = times[np.ix_(chosen, chosen)], start[chosen]
        if k <= _EXACT_INSIDE:
            _, seconds = fastest_tour(between, begin)
        else:
            order = improved_tour(np.arange(k), between, begin)
            seconds = float(begin[order[0]] + between[order[:-1], order[1:]].sum())
        if seconds < least:
            best, least = chosen, seconds
    return best, least


def _endings(
    before: Indices, k: int, rows: Array, times: Array, start: Array, wanted: float
) -> list[tuple[float, list[int]]]:
    """The soonest ways to end a run with a determinant of about ``wanted`` or more."""
    m, p = rows.shape
    way = times[before[:-1], before[1:]].sum() + (
        start[before[0]] if len(before) else 0
    )
    if len(before) == k:
        return [(float(way), [])]
    x = rows[before]
    lower = np.linalg.cholesky(x.T @ x + _RIDGE * np.eye(p))
    y = np.linalg.solve(lower, rows.T).T
    gain = 1.0 + (y * y).sum(axis=1)
    after = times[before[-1]] if len(before) else start
    free = np.ones(m, bool)
    free[before] = False
    if k - len(before) == 1:
        grown, seconds = gain, way + after
    else:
        grown = np.outer(gain, gain) - (y @ y.T) ** 2
        seconds = way + after[:, None] + times
        free = free[:, None] & free & ~np.eye(m, dtype=bool)
    value = np.log(np.maximum(grown, 1e-300)) + 2.0 * np.log(np.diag(lower)).sum()
    # A hair less than wanted: the ridge is in ``value``; the caller checks without it.
    seconds = np.where(free & (value >= wanted - 1e-6), seconds, np.inf).ravel()
    some = np.argsort(seconds, kind="stable")[:_KEPT]
    some = some[np.isfinite(seconds[some])]
    if k - len(before) == 1:
        return [(float(seconds[i]), [int(i)]) for i in some]
    return [(float(seconds[i]), [int(i) // m, int(i) % m]) for i in some]
