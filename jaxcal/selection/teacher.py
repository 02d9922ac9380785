"""What the solvers give a training run: validation sets with optima, a teacher."""

from __future__ import annotations

import numpy as np

from jaxcal.learning.training.config import TrainConfig
from jaxcal.learning.training.run import Validation

__all__ = ["fixed_validation", "teacher"]

_SETS = 500


def fixed_validation(config: TrainConfig) -> Validation:
    """500 uniform sets of the first task's size, never trained on, and their optima.

    The sets depend on M and n only, so runs with other seeds or networks are measured
    on the same ones.
    """
    from jaxcal.selection import exact_batch

    env = config.tasks[0].environment
    rng = np.random.default_rng([20261121, env.num_candidates, env.num_inputs])
    sets = rng.uniform(size=(_SETS, env.num_candidates, env.num_inputs))
    best = exact_batch(sets, env.num_selected, num_outputs=1).log_det
    return Validation(sets, np.asarray(best), env.num_outputs)


def teacher(
    candidates: np.ndarray, available: np.ndarray, given: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """The best postures of every set, as ``imitation.Teacher`` wants them.

    The proven optimum where k is the number of regressors. Above it, what Fedorov
    exchange finds from its default restarts: almost always optimal, and in a time that
    does not depend on the shape of the candidates, as that of a proof does.
    """
    from jaxcal.selection import exact_batch, exchange_batch

    required = given if given.shape[1] else None
    solve = exact_batch if k == candidates.shape[2] + 1 else exchange_batch
    found = solve(candidates, k, available=available, required=required, num_outputs=1)
    return found.indices, found.log_det
