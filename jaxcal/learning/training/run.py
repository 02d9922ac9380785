"""The run that trains a policy of postures: what its updates and validation are."""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.learning.policies import decoding
from jaxcal.learning.policies.build import build
from jaxcal.learning.policies.networks import Network
from jaxcal.learning.runtime import devices
from jaxcal.learning.training import imitation, loop, optimiser, ppo
from jaxcal.learning.training.config import TrainConfig
from jaxcal.learning.training.loop import Recipe, Report
from jaxcal.learning.training.optimiser import Metrics, TrainState

__all__ = ["Report", "Validation", "train"]


@dataclasses.dataclass(frozen=True)
class Validation:
    """Fixed candidate sets with their proven optimum."""

    candidates: np.ndarray  # (B, M, n)
    best: np.ndarray  # (B,) log det(Z.T Z) of the optimum
    num_outputs: int
    available: np.ndarray | None = None  # (B, M) bool; all when None

    def measure(self, network: Network, params: Any, k: int) -> tuple[float, float]:
        """Mean det S / det S* and the share of optima hit, by greedy decoding."""
        candidates = jnp.asarray(self.candidates, jnp.float32)
        free = jnp.ones(candidates.shape[:2], bool)
        if self.available is not None:
            free = jnp.asarray(self.available)
        nothing, unused = jnp.zeros((len(free), 0), jnp.int32), jax.random.key(0)
        indices = decoding.choose(
            network, params, candidates, free, nothing, unused, k=k
        )
        gap = np.asarray(decoding.log_det_of(candidates, indices)) - self.best
        # float32 values against a float64 optimum: equal to a few units in the last
        # place counts as hit; evaluate.py compares in float64.
        return (
            float(np.exp(self.num_outputs * np.minimum(gap, 0.0)).mean()),
            float((gap > -2e-5).mean()),
        )


def train(
    config: TrainConfig,
    folder: str | pathlib.Path,
    *,
    resume: bool = False,
    validation: Validation | None = None,
    report: Callable[[Report], None] = lambda report: None,
    should_stop: Callable[[], bool] = lambda: False,
    num_updates: int | None = None,
    num_devices: int | None = None,
    teacher: imitation.Teacher | None = None,
) -> TrainState:
    """Train until the budget is spent or ``should_stop`` says so, and save.

    All devices take part. In a job of several processes each calls this with the same
    configuration; the first alone touches ``folder``, validates and reports.

    Args:
        config: the run.
        folder: of the run; made where missing.
        resume: go on from the newest checkpoint in ``folder``.
        validation: fixed sets to measure the averaged weights on.
        report: called after every look at the validation set.
        should_stop: asked between updates.
        num_updates: stop after this update instead of at the end of the budget.
        num_devices: use so many of each process; all when None.
        teacher: whom the first ``config.ppo.num_imitated`` updates imitate.

    Raises:
        CheckpointError: nothing to resume from, or damaged.
        ValueError: the devices cannot share a minibatch evenly, or no teacher is given
            where one is imitated.
        OSError: the folder cannot be written.
        LostProcessError: another process of the job is gone.
    """
    mesh = devices.make_mesh(num_devices)
    devices.require_divisible(config.ppo.sets_per_minibatch, mesh)
    network = build(config.network)
    last = config.ppo.num_updates if num_updates is None else num_updates
    imitated = min(config.ppo.num_imitated, last)
    if teacher is None and imitated:
        raise ValueError(
            f"teacher must be given for the {imitated} updates that imitate, got None"
        )

    def lesson(index: int) -> imitation.Lesson:
        assert teacher is not None  # checked above
        return imitation.draw(
            config.ppo, config.task_of(index), network, teacher, index
        )

    def update(done: int, state: TrainState) -> tuple[TrainState, Metrics]:
        what = config.ppo, config.task_of(done), network, mesh
        if done < imitated:
            shown = devices.replicate(lessons.at(done), mesh)
            return imitation.updater(*what)(state, shown)
        return ppo.updater(*what)(state)

    def validate(average: Any) -> dict[str, float]:
        assert validation is not None  # else it is not called
        found = validation.measure(network, average, config.tasks[0].num_decisions)
        return dict(zip(("ratio_to_exact", "hit_rate"), found, strict=True))

    recipe = Recipe(
        ppo=config.ppo,
        meta=config.as_meta(),
        init=lambda: optimiser.init(config.ppo, config.tasks[0], network),
        update=update,
        validate=None if validation is None else validate,
        keeps_rewards=lambda done: config.task_of(done) == config.tasks[0],
        validate_every=config.validate_every,
        save_every=config.save_every,
    )
    with contextlib.closing(imitation.Lessons(lesson, imitated)) as lessons:
        return loop.run(
            recipe,
            folder,
            mesh=mesh,
            resume=resume,
            report=report,
            should_stop=should_stop,
            num_updates=last,
        )
