"""The training run: updates in a loop, and everything a person or a crash needs.

A run folder holds ``metrics.csv`` (a row for each update), ``last_rewards.npy`` (the
rewards of the last 1,000 episodes), TensorBoard event files and ``checkpoint/``. The
loop is on the host, over jitted updates, so that progress is printed while it runs and
a signal stops it between two updates.
"""

from __future__ import annotations

import dataclasses
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxcal.files import atomic_write
from jaxcal.learning.policies import decoding
from jaxcal.learning.policies.build import build
from jaxcal.learning.policies.networks import Network
from jaxcal.learning.runtime import devices
from jaxcal.learning.runtime.processes import losing_a_process
from jaxcal.learning.training import checkpoint, imitation, optimiser, ppo
from jaxcal.learning.training.config import TrainConfig
from jaxcal.learning.training.metrics import MetricsTable
from jaxcal.learning.training.optimiser import TrainState

__all__ = ["Report", "Validation", "train"]

_LAST = 1000  # episodes whose rewards are kept


@dataclasses.dataclass(frozen=True)
class Validation:
    """Fixed candidate sets with their proven optimum."""

    candidates: np.ndarray  # (B, M, n)
    best: np.ndarray  # (B,) log det(Z.T Z) of the optimum
    num_outputs: int
    available: np.ndarray | None = None  # (B, M) bool; all when None

    def measure(self, network: Network, params: Any, k: int) -> tuple[float, float]:
        """Mean det S / det S* and the share of optima hit, by greedy decoding."""
        batch, m, _ = self.candidates.shape
        free = np.ones((batch, m), bool) if self.available is None else self.available
        candidates = jnp.asarray(self.candidates, jnp.float32)
        indices = decoding.choose(
            network,
            params,
            candidates,
            jnp.asarray(free),
            jnp.zeros((batch, 0), jnp.int32),
            jax.random.key(0),
            k=k,
        )
        gap = np.asarray(decoding.log_det_of(candidates, indices)) - self.best
        # float32 values against a float64 optimum: equal to a few units in the last
        # place counts as hit; evaluate.py compares in float64.
        return (
            float(np.exp(self.num_outputs * np.minimum(gap, 0.0)).mean()),
            float((gap > -2e-5).mean()),
        )


@dataclasses.dataclass(frozen=True)
class Report:
    """What a line of progress says."""

    update: int
    num_updates: int
    episodes: int
    seconds: float  # of training so far, earlier sittings included
    episodes_per_second: float
    eta: float  # seconds left
    metrics: dict[str, float]  # of the last update, validation included


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

    Returns:
        The state after the last update.

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
    updates = _Updates(config, network, mesh, teacher, last)
    root = pathlib.Path(folder)
    state, before, recent = devices.on_first(
        lambda: _begin(root, config, network, resume)
    )
    state = devices.replicate(state, mesh)
    done = int(state.num_updates)
    diary = None
    if devices.is_first():
        diary = _Diary(root, config, network, validation, report, last, done, before)
        diary.recent = recent
    try:
        while done < last and not devices.any_process(should_stop()):
            with losing_a_process():
                state, metrics = updates.run(state, done)
                rewards = np.asarray(metrics.pop("rewards", ()), np.float32)
                row = {name: float(value) for name, value in metrics.items()}
            done += 1
            if diary is not None:
                diary.note(state, done, row, rewards)
    finally:
        updates.close()
        if diary is not None:
            diary.close()
    if diary is not None:
        diary.save(state, done)
    return state


class _Updates:
    """The jitted update of every number: imitation first, then PPO."""

    def __init__(
        self,
        config: TrainConfig,
        network: Network,
        mesh: Mesh | None,
        teacher: imitation.Teacher | None,
        last: int,
    ) -> None:
        if teacher is None and config.ppo.num_imitated:
            raise ValueError(
                f"teacher must be given for the {config.ppo.num_imitated} updates that "
                "imitate, got None"
            )
        self._config, self._network, self._mesh = config, network, mesh
        self._imitated = min(config.ppo.num_imitated, last)

        def prepare(index: int) -> imitation.Lesson:
            task = config.task_of(index)
            return imitation.draw(config.ppo, task, network, teacher, index)  # type: ignore[arg-type]  # a teacher is there where a lesson is asked for

        self._lessons = imitation.Lessons(prepare, self._imitated)

    def run(self, state: TrainState, done: int) -> tuple[TrainState, dict[str, Any]]:
        """Update number ``done``, from 0; the state is given up."""
        args = self._config.ppo, self._config.task_of(done), self._network, self._mesh
        if done >= self._imitated:
            return ppo.updater(*args)(state)
        lesson = devices.replicate(self._lessons.at(done), self._mesh)
        return imitation.updater(*args)(state, lesson)

    def close(self) -> None:
        """Stop preparing lessons."""
        self._lessons.close()


class _Diary:
    """What the first process writes and says of a run: rows, reports, checkpoints."""

    def __init__(
        self,
        root: pathlib.Path,
        config: TrainConfig,
        network: Network,
        validation: Validation | None,
        report: Callable[[Report], None],
        last: int,
        done: int,
        before: float,
    ) -> None:
        self._root, self._config, self._network = root, config, network
        self._validation, self._report, self._last = validation, report, last
        self._before = before  # seconds of earlier sittings
        self._table = MetricsTable(root, done)
        self._begun = self._looked = self._saved = self._mark_time = time.perf_counter()
        self._mark_update = done
        self.recent = np.zeros(0, np.float32)  # the last rewards of the first task

    def note(
        self, state: TrainState, done: int, row: dict[str, float], rewards: np.ndarray
    ) -> None:
        """Keep the metrics of update ``done``; look and save where it is time to."""
        config = self._config
        if config.task_of(done - 1) == config.tasks[0]:
            self.recent = np.concatenate([self.recent, rewards])[-_LAST:]
        now = time.perf_counter()
        row |= {
            "update": done,
            "episodes": done * config.ppo.episodes_per_update,
            "seconds": self._seconds(now),
            "learning_rate": optimiser.learning_rate(config.ppo, done),
        }
        look = done in (1, self._last) or now - self._looked > config.validate_every
        if look and self._validation is not None:
            average, k = devices.local(state.average), config.tasks[0].num_decisions
            ratio, hits = self._validation.measure(self._network, average, k)
            row |= {"ratio_to_exact": ratio, "hit_rate": hits}
        self._table.add(row)
        if look:
            self._looked = self._say(done, row)
        if now - self._saved > config.save_every:
            self._saved = now
            self.save(state, done)

    def _say(self, done: int, row: dict[str, float]) -> float:
        now = time.perf_counter()
        rate = (done - self._mark_update) / max(now - self._mark_time, 1e-9)
        self._report(
            Report(
                update=done,
                num_updates=self._last,
                episodes=int(row["episodes"]),
                seconds=self._seconds(now),
                episodes_per_second=rate * self._config.ppo.episodes_per_update,
                eta=(self._last - done) / rate,
                metrics=row,
            )
        )
        self._mark_time, self._mark_update = now, done
        return now

    def _seconds(self, now: float) -> float:
        return self._before + now - self._begun

    def save(self, state: TrainState, done: int) -> None:
        """Write a checkpoint of update ``done``."""
        with atomic_write(self._root / "last_rewards.npy") as file:
            np.save(file, self.recent)
        progress = {
            "updates": done,
            "episodes": done * self._config.ppo.episodes_per_update,
            "seconds": self._seconds(time.perf_counter()),
            "device": jax.devices()[0].device_kind,
        }
        meta = self._config.as_meta()
        meta |= {"seed": self._config.ppo.seed, "progress": progress}
        state = devices.local(state)
        checkpoint.save(self._root / "checkpoint", done, state.average, meta, state)

    def close(self) -> None:
        """Bring the metrics to the disk."""
        self._table.close()


def _begin(
    root: pathlib.Path, config: TrainConfig, network: Network, resume: bool
) -> tuple[TrainState, float, np.ndarray]:
    """The state to start from, seconds already trained, the last rewards."""
    root.mkdir(parents=True, exist_ok=True)
    state = optimiser.init(config.ppo, config.tasks[0], network)
    recent = np.zeros(0, np.float32)
    if not resume:
        return state, 0.0, recent
    state, meta = checkpoint.restore(root, state)
    if (root / "last_rewards.npy").exists():
        recent = np.load(root / "last_rewards.npy")
    return state, float(meta["progress"]["seconds"]), recent
