"""Death process: an infection rate, from how many of 50 are infected after a time.

Each of N = 50 is infected at time xi with probability ``1 - exp(-theta xi)``; every
measurement looks at 50 others. Constants of Foster et al. (2021, arXiv:2103.02438):
theta normal with mean 1 and sd 1, above 0; four measurements. One unknown and 51
outcomes: the task is a grid, and all figures of the grid are exact.
"""

from __future__ import annotations

import numpy as np
from scipy import special, stats

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.tasks.registry import FREE, Entry

__all__ = ["ENTRY", "death_process"]


def death_process(
    measurements: int = 4,
    *,
    cells: int = 500,
    times: int = 160,
    latest: float = 60.0,
    people: int = 50,
) -> GridTask:
    """The task.

    Args:
        measurements: of a session.
        cells: values of theta, evenly spaced in their logarithm.
        times: to look at, evenly spaced in their logarithm.
        latest: of them.
        people: looked at in one measurement.
    """
    edges = np.geomspace(0.003, 6.0, cells + 1)
    theta = np.sqrt(edges[1:] * edges[:-1])
    edges[0], edges[-1] = 0.0, np.inf
    prior = np.diff(special.ndtr(edges - 1.0))
    xi = np.geomspace(0.1, latest, times)
    infected = -np.expm1(-xi[:, None] * theta)
    count = np.arange(people + 1)
    likelihood = stats.binom.pmf(count[None, :, None], people, infected[:, None, :])
    return GridTask.make(
        theta,
        xi,
        likelihood,
        prior=prior,
        horizon=measurements,
        theta_names=["rate"],
    )


ENTRY = Entry(
    death_process,
    about="an infection rate, from how many are infected when",
    rules=FREE,
    methods=("random", "gain"),
)
