"""The run that trains a policy of postures: its recipe, and what it is measured on."""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.learning.core.network import Network
from jaxcal.learning.core.ppo import Learner, TrainState
from jaxcal.learning.policies import decoding
from jaxcal.learning.runtime import devices
from jaxcal.learning.training import checkpoint, imitation
from jaxcal.learning.training.config import TrainConfig
from jaxcal.learning.training.run import Recipe, Report, run

__all__ = ["COLUMNS", "MEASURED", "Validation", "train"]

COLUMNS = (
    *("update", "episodes", "seconds", "reward_mean", "reward_std", "log_det_mean"),
    *("entropy", "policy_loss", "value_loss", "kl", "learning_rate"),
)
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
        should_stop: asked every few seconds, between updates.
        num_updates: stop after this update instead of at the end of the budget.
        num_devices: use so many of each process; all when None.
        teacher: whom the first ``config.num_imitated`` updates imitate.

    Returns:
        The last state; each leaf has a leading axis of ``config.num_seeds`` where they
        are several.

    Raises:
        CheckpointError: nothing to resume from, or damaged.
        ValueError: the devices cannot share a minibatch evenly, no teacher is given
            where one is imitated, or nothing is left to learn.
        OSError: the folder cannot be written.
    """
    rows = config.ppo.rows_per_minibatch
    mesh = devices.make_mesh(rows, num_devices, config.num_seeds)
    learners = config.learners
    network, k = learners[0].network, config.tasks[0].num_decisions
    last = config.ppo.num_updates if num_updates is None else num_updates
    imitated = min(config.num_imitated, last)
    if teacher is None and imitated:
        raise ValueError(
            f"teacher must be given for the {imitated} updates that imitate, got None"
        )
    for task in config.tasks:
        if task.num_decisions <= network.num_unlearned:
            raise ValueError(
                f"num_selected must be at least {network.num_unlearned + 1}, got "
                f"{task.num_decisions}: the look-ahead makes the last "
                f"{network.num_unlearned} choices, so nothing is left to learn"
            )

    def lesson(index: int) -> imitation.Lesson:
        assert teacher is not None  # checked above
        # The first two are the run's own: weights and updates.
        key = jax.random.split(jax.random.key(config.seed), 3)[2]
        learner = learners[index % len(learners)]
        return imitation.draw(learner, teacher, jax.random.fold_in(key, index))

    def imitate(index: int) -> tuple[Learner, imitation.Lesson]:
        learner = learners[index % len(learners)]
        return imitation.Imitation(learner), lessons.at(index)

    def validate(average: Any) -> dict[str, float]:
        assert validation is not None  # else it is not called
        found = validation.measure(network, average, k)
        return dict(zip(MEASURED, found, strict=True))

    recipe = Recipe(
        ppo=config.ppo,
        learners=learners,
        given=((),),
        seed=config.seed,
        num_seeds=config.num_seeds,
        meta=config.as_meta(),
        schema=checkpoint.SCHEMA,
        unit="episodes",
        per_update=config.ppo.episodes_per_update,
        columns=COLUMNS,
        measured=MEASURED,
        validate=None if validation is None else validate,
        validate_every=config.validate_every,
        save_every=config.save_every,
        num_imitated=imitated,
        imitate=imitate,
    )
    with contextlib.closing(imitation.Lessons(lesson, imitated)) as lessons:
        return run(
            recipe,
            folder,
            mesh=mesh,
            resume=resume,
            report=report,
            should_stop=should_stop,
            num_updates=last,
        )
