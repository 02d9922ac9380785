"""Fixed candidate sets with their optimum, to watch a training run by."""

from __future__ import annotations

import numpy as np

from jaxcal.learning.training import TrainConfig, Validation

__all__ = ["fixed_validation"]

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
