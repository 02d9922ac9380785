"""The training run: updates in a loop, and everything a person or a crash needs.

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
import jax.numpy as jnp
import numpy as np

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


@dataclasses.dataclass(frozen=True)
class Report:
    """What a line of progress says."""

    update: int
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
    root = pathlib.Path(folder)
    state, before, recent = devices.on_first(
        lambda: _begin(root, config, network, resume)
    )
    state = devices.replicate(state, mesh)
    done = int(state.num_updates)

    def lesson(index: int) -> imitation.Lesson:
        assert teacher is not None  # checked above
        return imitation.draw(
            config.ppo, config.task_of(index), network, teacher, index
        )

    with contextlib.ExitStack() as stack:
        lessons = stack.enter_context(
            contextlib.closing(imitation.Lessons(lesson, imitated))
        )
        diary = None
        if devices.is_first():
            looks = validation, report
            diary = _Diary(root, config, network, *looks, last, before, done, recent)
            stack.enter_context(contextlib.closing(diary))
        while done < last and not devices.any_process(should_stop()):
            what = config.ppo, config.task_of(done), network, mesh
            with losing_a_process():
                if done < imitated:
                    shown = devices.replicate(lessons.at(done), mesh)
                    state, metrics = imitation.updater(*what)(state, shown)
                else:
                    state, metrics = ppo.updater(*what)(state)
                rewards = np.asarray(metrics.pop("rewards", ()), np.float32)
                row = {name: float(value) for name, value in metrics.items()}
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
    config: TrainConfig
    network: Network
    validation: Validation | None
    report: Callable[[Report], None]
    last: int  # update at which the run ends
    before: float  # seconds of earlier sittings
    reported: int  # update of the last report; at first the updates made before
    recent: np.ndarray  # the last rewards of the first task

    def __post_init__(self) -> None:
        self._table = MetricsTable(self.root, self.reported)
        self._begun = self._looked = self._saved = time.perf_counter()

    def note(
        self, state: TrainState, done: int, row: dict[str, float], rewards: np.ndarray
    ) -> None:
        """Keep the metrics of update ``done``; look and save where it is time to."""
        config = self.config
        if config.task_of(done - 1) == config.tasks[0]:
            self.recent = np.concatenate([self.recent, rewards])[-_LAST:]
        now = time.perf_counter()
        row |= {
            "update": done,
            "episodes": done * config.ppo.episodes_per_update,
            "seconds": self._seconds(now),
            "learning_rate": optimiser.learning_rate(config.ppo, done),
        }
        look = done in (1, self.last) or now - self._looked > config.validate_every
        if look and self.validation is not None:
            average, k = devices.local(state.average), config.tasks[0].num_decisions
            ratio, hits = self.validation.measure(self.network, average, k)
            row |= {"ratio_to_exact": ratio, "hit_rate": hits}
        self._table.add(row)
        if look:
            self._say(done, row)
        if now - self._saved > config.save_every:
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
                episodes_per_second=rate * self.config.ppo.episodes_per_update,
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
        ppo = self.config.ppo
        progress = {
            "updates": done,
            "episodes": done * ppo.episodes_per_update,
            "seconds": self._seconds(time.perf_counter()),
            "device": jax.devices()[0].device_kind,
        }
        meta = self.config.as_meta() | {"seed": ppo.seed, "progress": progress}
        state = devices.local(state)
        checkpoint.save(self.root / "checkpoint", done, state.average, meta, state)

    def close(self) -> None:
        """Bring the metrics to the disk."""
        self._table.close()


def _begin(
    root: pathlib.Path, config: TrainConfig, network: Network, resume: bool
) -> tuple[TrainState, float, np.ndarray]:
    """The state to start from, seconds already trained, the last rewards."""
    root.mkdir(parents=True, exist_ok=True)
    state = optimiser.init(config.ppo, config.tasks[0], network)
    if not resume:
        return state, 0.0, np.zeros(0, np.float32)
    state, meta = checkpoint.restore(root, state)
    rewards = root / "last_rewards.npy"
    recent = np.load(rewards) if rewards.exists() else np.zeros(0, np.float32)
    return state, float(meta["progress"]["seconds"]), recent
