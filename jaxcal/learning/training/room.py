"""Whether an update fits the memory of a device, and what would."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import pathlib
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from jaxcal.learning.training.run import Recipe, updates

_SMALL = 2**20  # candidates of an update's episodes; fewer fit into any memory


def memory() -> float:
    """Bytes that a program may use on the first device."""
    device = jax.local_devices()[0]
    stats = device.memory_stats() if device.platform != "cpu" else None
    if stats:
        return float(stats["bytes_limit"] - stats["bytes_in_use"])
    with contextlib.suppress(OSError):
        for line in pathlib.Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return 1024.0 * float(line.split()[1])
    return math.inf  # unknown on other systems than Linux


def require_room(recipe: Recipe, mesh: Mesh | None) -> None:
    """Refuse a run of postures whose update does not fit.

    XLA says what an update needs once it is compiled; one of few candidates is not
    asked for.

    Raises:
        ValueError: naming the flag, what is needed, what there is, and what fits.
    """
    config = recipe.config
    ppo, seeds = config.ppo, len(recipe.runs) if len(recipe.runs) > 1 else 0
    sizes = [task.environment.num_candidates for task in config.tasks]
    m = max(sizes)
    if m * ppo.episodes_per_update < _SMALL:
        return
    learner = recipe.learners[sizes.index(m)]
    at_most = 16 if len(recipe.learners) == 1 else 1  # as ``run`` calls it
    state = jax.eval_shape(lambda: _one(recipe))
    update: Any = updates(ppo, learner, mesh, at_most, seeds)
    needs = update.lower(state, np.int32(1)).compile().memory_analysis()
    if needs is None:  # a backend that does not say
        return
    whole, room = needs.temp_size_in_bytes + needs.argument_size_in_bytes, memory()
    if whole <= room:
        return
    step = ppo.episodes_per_set * ppo.num_minibatches
    fits = max(int(ppo.episodes_per_update * room / whole) // step * step, step)
    raise ValueError(
        f"--episodes-per-update {ppo.episodes_per_update} of {m} candidates needs "
        f"{whole / 1000000000.0:.2g} GB of memory; {room / 1000000000.0:.2g} GB are "
        f"free: try --episodes-per-update {fits}"
    )


def _one(recipe: Recipe) -> Any:
    """The state as one call has it: with what goes on of one learner."""
    state = recipe.init()
    return dataclasses.replace(state, rollout_state=state.rollout_state[0])
