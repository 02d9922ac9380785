"""What ``train`` asks the solvers for: sets to validate on, and what to imitate."""

from __future__ import annotations

import jax
import numpy as np

from jaxcal.learning.training.postures import Validation
from jaxcal.learning.training.presets import TrainConfig
from jaxcal.selection import exact_batch, exchange_batch

_VALIDATED = 500  # sets that a training run is measured on


def fixed_validation(config: TrainConfig) -> Validation:
    """500 sets as the first task has them, and their optima.

    Uniform ones, never trained on, that depend on M and n only, so runs with other
    seeds or networks are measured on the same ones. Where the user gave candidates, 500
    draws of those.
    """
    task = config.tasks[0]
    env = task.environment
    if task.given is not None:
        states = jax.vmap(task.reset)(
            jax.random.split(jax.random.key(20261121), _VALIDATED)
        )
        sets = np.asarray(states.candidates, np.float64)
        free = np.asarray(states.available)
    else:
        rng = np.random.default_rng([20261121, env.num_candidates, env.num_inputs])
        sets = rng.uniform(size=(_VALIDATED, env.num_candidates, env.num_inputs))
        free = np.ones(sets.shape[:2], bool)
    best = exact_batch(sets, env.num_selected, available=free, num_outputs=1).log_det
    return Validation(sets, np.asarray(best), env.num_outputs, free)


def teacher(
    candidates: np.ndarray, available: np.ndarray, given: np.ndarray, k: int
) -> tuple[np.ndarray, np.ndarray]:
    """The best postures of every set, as ``imitation.Teacher`` wants them.

    The proven optimum where k is the number of regressors. Above it, what Fedorov
    exchange finds from its default restarts: almost always optimal, and in a time that
    does not depend on the shape of the candidates, as that of a proof does.
    """
    required = given if given.shape[1] else None
    solve = exact_batch if k == candidates.shape[2] + 1 else exchange_batch
    solved = solve(candidates, k, available=available, required=required, num_outputs=1)
    return solved.indices, solved.log_det
