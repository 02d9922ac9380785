"""The run that trains a policy of postures: its recipe and its validation."""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
from typing import Any

import jax
import numpy as np

from jaxcal.learning.core.network import Network
from jaxcal.learning.core.ppo import Learner, TrainState
from jaxcal.learning.policies import scorer
from jaxcal.learning.policies.networks import build
from jaxcal.learning.runtime import devices
from jaxcal.learning.training import checkpoint, imitation
from jaxcal.learning.training.presets import TrainConfig
from jaxcal.learning.training.run import Recipe, run

MEASURED = ("ratio_to_exact", "hit_rate")


@dataclasses.dataclass(frozen=True)
class Validation:
    """Fixed candidate sets with their proven optimum."""

    candidates: np.ndarray  # (B, M, n)
    best: np.ndarray  # (B,) log det(Z.T Z) of the optimum
    num_outputs: int
    available: np.ndarray | None = None  # (B, M) bool; all when None

    def measure(self, network: Network, params: Any, k: int) -> tuple[float, float]:
        """Mean det S / det S* and the share of optima hit, by greedy decoding."""
        candidates = np.asarray(self.candidates, np.float32)
        free = self.available
        if free is None:
            free = np.ones(candidates.shape[:2], bool)
        indices = scorer.choose(network, params, candidates, free, k=k)
        gap = np.asarray(scorer.log_det_of(candidates, indices)) - self.best
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
    validation: Validation | None = None,
    teacher: imitation.Teacher | None = None,
    num_updates: int | None = None,
    num_devices: int | None = None,
    **rest: Any,
) -> TrainState:
    """Train until the budget is spent or ``should_stop`` says so, and save.

    All devices take part. In a job of several processes each calls this with the same
    configuration; the first alone touches ``folder``, validates and reports.

    Args:
        config: the run.
        folder: of the run; made where missing.
        validation: fixed sets to measure the averaged weights on.
        teacher: imitated by the first ``config.num_imitated`` updates.
        num_updates: stop after this update instead of at the end of the budget.
        num_devices: devices of each process; all when None.
        rest: ``resume``, ``report`` and ``should_stop`` of ``training.run.run``.

    Returns:
        The last state; with several seeds each leaf has a leading axis of them.
    """
    rows = config.ppo.rows_per_minibatch
    mesh = devices.make_mesh(rows, num_devices, config.num_runs)
    learners = config.learners
    network, k = build(config.network), config.tasks[0].num_decisions
    last = config.ppo.num_updates if num_updates is None else num_updates
    imitated = min(config.num_imitated, last)
    _require_lessons(config, network, teacher, imitated)

    def lesson(index: int) -> imitation.Lesson:
        assert teacher is not None  # checked above
        # The third key; ``ppo.begin`` uses the first two, for weights and updates.
        key = jax.random.split(jax.random.key(config.seed), 3)[2]
        learner = learners[index % len(learners)]
        return imitation.draw(learner, teacher, jax.random.fold_in(key, index))

    def imitate(index: int) -> tuple[Learner, imitation.Lesson]:
        learner = learners[index % len(learners)]
        return imitation.Imitation(learner), lessons.at(index)

    def validate(average: Any) -> dict[str, float]:
        assert validation is not None  # else it is not called
        measured = validation.measure(network, average, k)
        return dict(zip(MEASURED, measured, strict=True))

    recipe = Recipe(
        config=config,
        given=(),
        schema=checkpoint.SCHEMA,
        columns=("reward_std", "log_det_mean"),
        measured=MEASURED,
        validate=None if validation is None else validate,
        num_imitated=imitated,
        imitate=imitate,
    )
    with contextlib.closing(imitation.Lessons(lesson, imitated)) as lessons:
        return run(recipe, folder, mesh=mesh, num_updates=last, **rest)


def _require_lessons(
    config: TrainConfig,
    network: Network,
    teacher: imitation.Teacher | None,
    imitated: int,
) -> None:
    if teacher is None and imitated:
        raise ValueError(f"teacher is missing: {imitated} updates imitate it")
    for task in config.tasks:
        if task.num_decisions <= network.num_unlearned:
            raise ValueError(
                f"num_selected must be at least {network.num_unlearned + 1}, got "
                f"{task.num_decisions}: the look-ahead makes the last "
                f"{network.num_unlearned} choices, so nothing remains to be learned"
            )
