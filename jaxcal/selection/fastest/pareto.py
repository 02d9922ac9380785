"""Time against D-efficiency: the runs of which none is faster and more efficient."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.checks import share, whole_number
from jaxcal.selection.fastest.api import FastSelection, answer, make_search
from jaxcal.selection.fastest.motion import Motion
from jaxcal.selection.fastest.task import SAME_TIME, make_task

__all__ = ["ParetoFront", "pareto_front"]


@dataclasses.dataclass(frozen=True, eq=False)
class ParetoFront:
    """Runs none of which is both faster and more efficient than another."""

    points: tuple[FastSelection, ...]  # ascending in time and in efficiency
    least_efficiency: float  # where the front was cut off
    proven: bool  # every point is, and none is missing


def pareto_front(
    candidates: ArrayLike,
    k: int | None = None,
    *,
    motion: Motion,
    least_efficiency: float = 0.7,
    method: str | None = None,
    max_points: int = 200,
    num: int | None = None,
    seed: int | np.random.Generator | None = None,
    **rules: Any,
) -> ParetoFront:
    """Time against D-efficiency, from ``least_efficiency`` up to the D-optimum.

    Each point is the fastest run more efficient than the point before it.

    Args:
        candidates, k, motion, method, num, seed: as in :func:`select_fastest`.
        least_efficiency: where to cut the front off, in (0, 1].
        max_points: points after which to stop; the front is then not proven.
        rules: ``start``, ``model``, ``blocks``, ``prior``, ``noise``, ``measured``,
            ``available``, ``required``, ``num_outputs``, as there, and ``time_limit``,
            seconds for each point.
    """
    least_efficiency = share("least_efficiency", least_efficiency)
    max_points = whole_number("max_points", max_points, 1)
    task = make_task(candidates, k, motion, **rules)
    search = make_search(task, method, num, seed)
    points: list[FastSelection] = []
    complete = False
    while len(points) < max_points and not complete:
        above = points[-1].log_det if points else None
        point = answer(task, search, least_efficiency, above)
        if point is None:
            complete = True
        else:
            points.append(point)
    kept = tuple(
        p
        for p in points
        if not any(
            q.seconds <= p.seconds + SAME_TIME and q.log_det > p.log_det for q in points
        )
    )
    proven = complete and all(point.proven for point in points)
    return ParetoFront(kept, least_efficiency, proven)
