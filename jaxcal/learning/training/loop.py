"""The loop on the host of every training run, and all a person or a crash needs.

A run folder holds ``metrics.csv`` (a row for each update), ``last_rewards.npy`` (the
rewards of the last 1,000 episodes), TensorBoard event files and ``checkpoint/``. The
loop is on the host, over jitted updates, so that progress is printed while it runs and
a signal stops it between two updates.
"""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from jaxcal.files import atomic_write
from jaxcal.learning.runtime import devices
from jaxcal.learning.runtime.processes import losing_a_process
from jaxcal.learning.training import checkpoint, metrics, optimiser
from jaxcal.learning.training.config import PPOConfig
from jaxcal.learning.training.optimiser import Metrics, TrainState

__all__ = ["Recipe", "Report", "run"]

_LAST = 1000  # episodes whose rewards are kept


@dataclasses.dataclass(frozen=True)
class Recipe:
    """What one kind of run trains, and how."""

    ppo: PPOConfig
    meta: dict[str, Any]  # JSON values saved with every checkpoint
    init: Callable[[], TrainState]
    update: Callable[[int, TrainState], tuple[TrainState, Metrics]]  # updates made
    validate: Callable[[Any], dict[str, float]] | None  # averaged weights -> columns
    keeps_rewards: Callable[[int], bool] = lambda update: True  # update from 0
    validate_every: float = 15.0  # seconds between validations
    save_every: float = 60.0  # seconds between checkpoints
    columns: tuple[str, ...] = metrics.COLUMNS  # of metrics.csv
    schema: str = checkpoint.SCHEMA


@dataclasses.dataclass(frozen=True)
class Report:
    """What a line of progress says."""

    update: int
    episodes: int
    seconds: float  # of training so far, earlier sittings included
    episodes_per_second: float
    eta: float  # seconds left
    metrics: dict[str, float]  # of the last update, validation included


def run(
    recipe: Recipe,
    folder: str | pathlib.Path,
    *,
    mesh: Mesh | None = None,
    resume: bool = False,
    report: Callable[[Report], None] = lambda report: None,
    should_stop: Callable[[], bool] = lambda: False,
    num_updates: int | None = None,
) -> TrainState:
    """Train until the budget is spent or ``should_stop`` says so, and save.

    Args:
        recipe: what is trained.
        folder: of the run; made where missing.
        mesh: the devices that share an update; None for one.
        resume: go on from the newest checkpoint in ``folder``.
        report: called after every validation.
        should_stop: asked between updates.
        num_updates: stop after this update instead of at the end of the budget.

    Raises:
        CheckpointError: nothing to resume from, or damaged.
        OSError: the folder cannot be written.
        LostProcessError: another process of the job is gone.
    """
    last = recipe.ppo.num_updates if num_updates is None else num_updates
    root = pathlib.Path(folder)
    state, before, recent = devices.on_first(lambda: _begin(root, recipe, resume))
    if mesh is not None:
        state = devices.replicate(state, mesh)
    done = int(state.num_updates)
    with contextlib.ExitStack() as stack:
        diary = None
        if devices.is_first():
            diary = _Diary(root, recipe, report, last, before, done, recent)
            stack.enter_context(contextlib.closing(diary))
        while done < last and not devices.any_process(should_stop()):
            with losing_a_process():
                state, found = recipe.update(done, state)
                rewards = np.asarray(found.pop("rewards", ()), np.float32)
                row = {name: float(value) for name, value in found.items()}
            done += 1
            if diary is not None:
                diary.note(state, done, row, rewards)
    if diary is not None:
        diary.save(state, done)
    return state


@dataclasses.dataclass
class _Diary:
    """What the first process writes and says of a run: rows, reports, checkpoints."""

    root: pathlib.Path
    recipe: Recipe
    report: Callable[[Report], None]
    last: int  # update at which the run ends
    before: float  # seconds of earlier sittings
    reported: int  # update of the last report; at first the updates made before
    recent: np.ndarray  # the last rewards

    def __post_init__(self) -> None:
        self._table = metrics.MetricsTable(
            self.root, self.reported, self.recipe.columns
        )
        self._begun = self._looked = self._saved = time.perf_counter()

    def note(
        self, state: TrainState, done: int, row: dict[str, float], rewards: np.ndarray
    ) -> None:
        """Keep the metrics of update ``done``; look and save where it is time to."""
        recipe = self.recipe
        if recipe.keeps_rewards(done - 1):
            self.recent = np.concatenate([self.recent, rewards])[-_LAST:]
        now = time.perf_counter()
        row |= {
            "update": done,
            "episodes": done * recipe.ppo.episodes_per_update,
            "seconds": self._seconds(now),
            "learning_rate": optimiser.learning_rate(recipe.ppo, done),
        }
        look = done in (1, self.last) or now - self._looked > recipe.validate_every
        if look and recipe.validate is not None:
            row |= recipe.validate(devices.local(state.average))
        self._table.add(row)
        if look:
            self._say(done, row)
        if now - self._saved > recipe.save_every:
            self._saved = now
            self.save(state, done)

    def _say(self, done: int, row: dict[str, float]) -> None:
        now = time.perf_counter()
        rate = (done - self.reported) / max(now - self._looked, 1e-9)
        self.report(
            Report(
                update=done,
                episodes=int(row["episodes"]),
                seconds=self._seconds(now),
                episodes_per_second=rate * self.recipe.ppo.episodes_per_update,
                eta=(self.last - done) / rate,
                metrics=row,
            )
        )
        self._looked, self.reported = now, done

    def _seconds(self, now: float) -> float:
        return self.before + now - self._begun

    def save(self, state: TrainState, done: int) -> None:
        """Write a checkpoint of update ``done``."""
        with atomic_write(self.root / "last_rewards.npy") as file:
            np.save(file, self.recent)
        ppo = self.recipe.ppo
        progress = {
            "updates": done,
            "episodes": done * ppo.episodes_per_update,
            "seconds": self._seconds(time.perf_counter()),
            "device": jax.devices()[0].device_kind,
        }
        own = {"schema": self.recipe.schema, "seed": ppo.seed, "progress": progress}
        meta = self.recipe.meta | own
        state = devices.local(state)
        checkpoint.save(self.root / "checkpoint", done, state.average, meta, state)

    def close(self) -> None:
        """Bring the metrics to the disk."""
        self._table.close()


def _begin(
    root: pathlib.Path, recipe: Recipe, resume: bool
) -> tuple[TrainState, float, np.ndarray]:
    """The state to start from, seconds already trained, the last rewards."""
    root.mkdir(parents=True, exist_ok=True)
    state = recipe.init()
    if not resume:
        return state, 0.0, np.zeros(0, np.float32)
    state, meta = checkpoint.restore(root, state, recipe.schema)
    rewards = root / "last_rewards.npy"
    recent = np.load(rewards) if rewards.exists() else np.zeros(0, np.float32)
    return state, float(meta["progress"]["seconds"]), recent
