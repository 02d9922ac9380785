"""The training run: updates in a loop, and everything a person or a crash needs.

A run folder holds ``metrics.csv`` (a row an update), ``last_rewards.npy`` (the rewards
of the last 1,000 episodes), TensorBoard event files and ``checkpoint/``. The loop is on
the host, over jitted updates, so that progress is printed while it runs and a signal
stops it between two updates.
"""

from __future__ import annotations

import csv
import dataclasses
import functools
import os
import pathlib
import sys
import time
from collections.abc import Callable
from dataclasses import field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxcal.files import atomic_write
from jaxcal.learning.environments import selection as environment
from jaxcal.learning.environments import travel
from jaxcal.learning.policies import decoding, networks
from jaxcal.learning.policies.networks import Network, NetworkConfig
from jaxcal.learning.runtime import devices
from jaxcal.learning.runtime.processes import losing_a_process
from jaxcal.learning.training import checkpoint, imitation, ppo
from jaxcal.learning.training.ppo import PPOConfig, Task

__all__ = ["COLUMNS", "Report", "TrainConfig", "Validation", "train"]

COLUMNS = (
    "update",
    "episodes",
    "seconds",
    "reward_mean",
    "reward_std",
    "log_det_mean",
    "ratio_to_exact",
    "hit_rate",
    "entropy",
    "policy_loss",
    "value_loss",
    "kl",
    "learning_rate",
)
_LAST = 1000  # episodes whose rewards are kept


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """A whole run: what, with what, and how often to look."""

    preset: str = "compact"
    network: NetworkConfig = field(default_factory=NetworkConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    tasks: tuple[Task, ...] = field(default=(Task(),))  # update u: tasks[u % len]
    validate_every: float = 15.0  # seconds between looks at the validation set
    save_every: float = 60.0  # seconds between checkpoints

    def task_of(self, update: int) -> Task:
        """What update number ``update``, from 0, trains on."""
        return self.tasks[update % len(self.tasks)]

    def as_meta(self) -> dict[str, Any]:
        """Plain JSON values; ``from_meta`` reads them back."""
        return {
            "preset": self.preset,
            "network": dataclasses.asdict(self.network),
            "ppo": dataclasses.asdict(self.ppo),
            "tasks": [dataclasses.asdict(task) for task in self.tasks],
        }

    @staticmethod
    def from_meta(meta: dict[str, Any]) -> TrainConfig:
        """The configuration a checkpoint was trained with."""
        timed = meta["network"]["kind"] == "travel"
        rules = travel.TravelConfig if timed else environment.SelectionConfig
        tasks = tuple(
            Task(
                environment=rules(**task["environment"]),
                shapes=tuple(task["shapes"]),
                masked=task["masked"],
                random_starts=task["random_starts"],
            )
            for task in meta["tasks"]
        )
        return TrainConfig(
            preset=meta["preset"],
            network=NetworkConfig(**meta["network"]),
            ppo=PPOConfig(**meta["ppo"]),
            tasks=tasks,
        )


@dataclasses.dataclass(frozen=True)
class Validation:
    """Fixed candidate sets with their proven optimum."""

    candidates: np.ndarray  # (B, M, n)
    best: np.ndarray  # (B,) log det(Z.T Z) of the optimum
    num_outputs: int

    def measure(self, network: Network, params: Any, k: int) -> tuple[float, float]:
        """Mean det S / det S* and the share of optima hit, by greedy decoding."""
        batch, m, _ = self.candidates.shape
        indices = decoding.choose(
            network,
            params,
            jnp.asarray(self.candidates, jnp.float32),
            jnp.ones((batch, m), bool),
            jnp.zeros((batch, 0), jnp.int32),
            jax.random.key(0),
            k=k,
        )
        picked = jnp.asarray(self.candidates, jnp.float32)
        value = np.asarray(decoding.log_det_of(picked, indices))
        gap = value - self.best
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
) -> Any:
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
        The ``TrainState`` after the last update.

    Raises:
        CheckpointError: nothing to resume from, or damaged.
        ValueError: the devices cannot share a minibatch evenly, or no teacher is given
            where one is imitated.
        OSError: the folder cannot be written.
        LostProcessError: another process of the job is gone.
    """
    if teacher is None and config.ppo.num_imitated:
        raise ValueError(
            f"teacher must be given for the {config.ppo.num_imitated} updates that "
            "imitate, got None"
        )
    root = pathlib.Path(folder)
    mesh = devices.make_mesh(num_devices)
    devices.require_divisible(config.ppo.sets_per_minibatch, mesh)
    first = devices.is_first()
    network = networks.build(config.network)
    state, before, recent = devices.on_first(
        lambda: _begin(root, config, network, resume)
    )
    state = devices.replicate(state, mesh)
    done = int(state.num_updates)
    table = _Table(root, done) if first else None
    last = config.ppo.num_updates if num_updates is None else num_updates
    begun = time.perf_counter()
    looked = saved = begun
    mark_time, mark_update = begun, done
    k = config.tasks[0].environment.num_selected
    imitated = min(config.ppo.num_imitated, last)
    lessons = imitation.Lessons(
        functools.partial(_lesson, config, network, teacher), imitated
    )
    try:
        while done < last and not devices.any_process(should_stop()):
            task = config.task_of(done)
            with losing_a_process():
                if done < imitated:
                    lesson = devices.replicate(lessons.at(done), mesh)
                    state, metrics = imitation.update(
                        state, lesson, config.ppo, task, network, mesh
                    )
                    rewards = np.zeros(0, np.float32)
                else:
                    state, metrics = ppo.update(state, config.ppo, task, network, mesh)
                    rewards = np.asarray(metrics.pop("rewards"))
                row = {name: float(value) for name, value in metrics.items()}
            done += 1
            if table is None:
                continue
            if task == config.tasks[0]:
                recent = np.concatenate([recent, rewards])[-_LAST:]
            now = time.perf_counter()
            row |= {
                "update": done,
                "episodes": done * config.ppo.episodes_per_update,
                "seconds": before + now - begun,
                "learning_rate": ppo.learning_rate(config.ppo, done),
            }
            look = done in (1, last) or now - looked > config.validate_every
            if look and validation is not None:
                average = devices.local(state.average)
                ratio, hits = validation.measure(network, average, k)
                row |= {"ratio_to_exact": ratio, "hit_rate": hits}
            table.add(row)
            if look:
                looked = now = time.perf_counter()
                rate = (done - mark_update) / max(now - mark_time, 1e-9)
                report(
                    Report(
                        update=done,
                        num_updates=last,
                        episodes=done * config.ppo.episodes_per_update,
                        seconds=before + now - begun,
                        episodes_per_second=rate * config.ppo.episodes_per_update,
                        eta=(last - done) / rate,
                        metrics=row,
                    )
                )
                mark_time, mark_update = now, done
            if now - saved > config.save_every:
                saved = now
                _save(root, config, state, done, before + now - begun, recent)
    finally:
        lessons.close()
        if table is not None:
            table.close()
    if first:
        _save(root, config, state, done, before + time.perf_counter() - begun, recent)
    return state


def _lesson(
    config: TrainConfig, network: Network, teacher: Any, index: int
) -> imitation.Lesson:
    return imitation.draw(config.ppo, config.task_of(index), network, teacher, index)


def _begin(
    root: pathlib.Path, config: TrainConfig, network: Network, resume: bool
) -> tuple[Any, float, np.ndarray]:
    """The state to start from, seconds already trained, the last rewards."""
    root.mkdir(parents=True, exist_ok=True)
    state = ppo.init(config.ppo, config.tasks[0], network)
    recent = np.zeros(0, np.float32)
    if not resume:
        return state, 0.0, recent
    state, meta = checkpoint.restore(root, state)
    if (root / "last_rewards.npy").exists():
        recent = np.load(root / "last_rewards.npy")
    return state, float(meta["progress"]["seconds"]), recent


def _save(
    root: pathlib.Path,
    config: TrainConfig,
    state: Any,
    done: int,
    seconds: float,
    recent: np.ndarray,
) -> None:
    with atomic_write(root / "last_rewards.npy") as file:
        np.save(file, recent)
    progress = {
        "updates": done,
        "episodes": done * config.ppo.episodes_per_update,
        "seconds": seconds,
        "device": jax.devices()[0].device_kind,
    }
    meta = config.as_meta() | {"seed": config.ppo.seed, "progress": progress}
    state = devices.local(state)
    checkpoint.save(root / "checkpoint", done, state.average, meta, state)


def _summary_writer() -> Any:
    """tensorboardX's writer, without PyTorch.

    It loads PyTorch where that is installed, more than a second that scalars do not
    need.
    """
    unloaded = "torch" not in sys.modules
    if unloaded:
        sys.modules["torch"] = None  # type: ignore[assignment]  # reads as not installed
    try:
        from tensorboardX import SummaryWriter
    finally:
        if unloaded:
            del sys.modules["torch"]
    return SummaryWriter


class _Table:
    """metrics.csv and TensorBoard events, a row an update, flushed as they come."""

    def __init__(self, root: pathlib.Path, done: int) -> None:
        path = root / "metrics.csv"
        kept = _rows_until(path, done) if done else []
        with atomic_write(path) as file:
            lines = [",".join(COLUMNS), *kept]
            file.write(("\n".join(lines) + "\n").encode())
        self._file = path.open("a", newline="")
        self._writer = csv.DictWriter(self._file, COLUMNS, extrasaction="ignore")
        self._events = _summary_writer()(str(root), flush_secs=30)

    def add(self, row: dict[str, float]) -> None:
        self._writer.writerow(row)
        self._file.flush()
        for name, value in row.items():
            if name not in ("update", "episodes"):
                self._events.add_scalar(name, value, row["update"])

    def close(self) -> None:
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()
        self._events.close()


def _rows_until(path: pathlib.Path, done: int) -> list[str]:
    """Rows of a metrics file up to an update; later ones were never saved."""
    if not path.exists():
        return []
    lines = path.read_text().splitlines()[1:]
    kept = []
    for line in lines:
        first = line.split(",", 1)[0]
        if (
            first.isdigit()
            and int(first) <= done
            and line.count(",") + 1 == len(COLUMNS)
        ):
            kept.append(line)
    return kept
