"""The loop of a training run: files, resume, validation, progress, devices.

A run folder holds ``metrics.csv`` (a row per update; means over seeds),
``last_rewards.npy`` (the last 1,000 rewards of the first task) and ``checkpoint/``. The
loop is on the host, an update at a time, so that a signal stops it between.
"""

from __future__ import annotations

import contextlib
import csv
import dataclasses
import functools
import os
import pathlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxcal.files import atomic_write, write_text
from jaxcal.jsonlines import flock
from jaxcal.learning.config import PPOConfig
from jaxcal.learning.core import ppo
from jaxcal.learning.core.ppo import Learner, TrainState
from jaxcal.learning.runtime import devices
from jaxcal.learning.runtime.processes import collective
from jaxcal.learning.training import checkpoint

_LOSSES = (
    "entropy", "policy_loss", "value_loss", "kl", "kl_after", "clip_fraction",
    "explained_variance", "grad_norm", "learning_rate",
)  # fmt: skip
_SKIPS = 5  # updates in a row, not finite, that end a run
_LAST = 1000  # episodes whose rewards are kept


class DivergedError(ArithmeticError):
    """Losses or gradients stay not finite; the last finite weights are saved."""


@dataclasses.dataclass(frozen=True)
class Recipe:
    """What one kind of run trains, and how."""

    config: Any  # a ``TrainConfig`` or a ``PolicyConfig``
    given: tuple[Any, ...]  # arguments of every update
    schema: str  # of the checkpoints
    columns: tuple[str, ...]  # further ones of metrics.csv, in every update
    measured: tuple[str, ...]  # columns of validations; the first ranks the seeds
    validate: Callable[[Any], tuple[float, ...]] | None  # averaged weights -> measured
    # The first updates imitate: their number; update -> its learner and argument.
    num_imitated: int = 0
    imitate: Callable[[int], tuple[Learner, Any]] | None = None

    @functools.cached_property
    def learners(self) -> tuple[Learner, ...]:
        return tuple(self.config.learners)

    @property
    def seeds(self) -> list[int]:
        first = self.config.seed
        return list(range(first, first + self.config.num_seeds))

    def init(self) -> TrainState:
        """The state before the first update, from the seeds alone."""

        def begin(key: jax.Array) -> TrainState:
            return _begun(self.config.ppo, self.learners[0], key, *self.given)

        keys = jnp.stack([jax.random.key(seed) for seed in self.seeds])
        return begin(keys[0]) if len(keys) == 1 else jax.vmap(begin)(keys)


# One program for every seed; eager, it would compile two hundred small ones.
_begun = jax.jit(ppo.begin, static_argnums=(0, 1))


@dataclasses.dataclass(frozen=True)
class Report:
    update: int
    played: int  # episodes or decisions
    seconds: float  # of training so far, before a resume included
    per_second: float  # episodes or decisions
    eta: float  # seconds left
    metrics: dict[str, float]  # of the last update, validation included; means of seeds
    spread: dict[str, float]  # of validation: standard deviation over seeds, 0 for one
    skipped: int  # updates so far that were not finite in some run


@functools.lru_cache(maxsize=32)
def compiled_update(
    config: PPOConfig, learner: Learner, mesh: Mesh | None = None, seeds: int = 0
) -> Callable[..., tuple[TrainState, ppo.Metrics]]:
    """One update, (state, *given) -> the next state and metrics; ``state`` is donated.
    Nothing is compiled for another seed.

    On a mesh with axis ``sets`` the devices share every update, with axis ``seeds``
    each trains some of the seeds by itself. Of several ``seeds`` each leaf of the state
    and the metrics has a leading axis of so many; 0 for one without that axis.
    """
    spread = mesh is not None and mesh.axis_names == ("seeds",)
    one = ppo.make_update(config, learner, None if spread else mesh)

    def all_seeds(state: TrainState, given: tuple[Any, ...]) -> Any:
        if not seeds:
            return one(state, *given)
        # On a CPU one after another: several at once do not fit a core's cache.
        at_once = None if jax.default_backend() == "cpu" else seeds
        return jax.lax.map(lambda state: one(state, *given), state, batch_size=at_once)

    def call(state: TrainState, *given: Any) -> Any:
        if not spread:
            return ppo.placed(all_seeds(state, given), mesh)
        by_seed = PartitionSpec("seeds")
        on_each = jax.shard_map(
            all_seeds,
            mesh=mesh,
            in_specs=(by_seed, PartitionSpec()),
            out_specs=by_seed,
            check_vma=False,
        )
        return ppo.placed(on_each(state, given), mesh)

    return jax.jit(call, donate_argnums=0, compiler_options=_compiler_options())


def _compiler_options() -> dict[str, Any]:
    """LLVM's level 2 on a CPU, unless ``XLA_FLAGS`` has a level: an update compiles in
    four fifths of the time of level 3 and runs 2 % slower."""
    level = "xla_backend_optimization_level"
    if jax.default_backend() != "cpu" or level in os.environ.get("XLA_FLAGS", ""):
        return {}
    return {level: 2}


def run(
    recipe: Recipe,
    folder: str | pathlib.Path,
    *,
    num_devices: int | None = None,
    resume: bool = False,
    report: Callable[[Report], None] = lambda report: None,
    should_stop: Callable[[], bool] = lambda: False,
    num_updates: int | None = None,
) -> TrainState:
    """Train until the budget is spent or ``should_stop`` says so, and save.

    Args:
        recipe: what is trained.
        folder: of the run; made where missing.
        num_devices: of each process, that share an update; all when None.
        resume: go on from the newest checkpoint in ``folder``.
        report: called after the first and last update and every ``validate_every``.
        should_stop: asked between calls.
        num_updates: stop after this update instead of at the end of the budget.

    Raises:
        ValueError: the devices cannot share a minibatch, or the seeds, evenly.
        DivergedError: losses are not finite in five updates in a row, in every run; the
            weights before are saved. Fewer are skipped.
        OSError: the folder cannot be written, or another training writes it.
    """
    config, root = recipe.config, pathlib.Path(folder)
    shared = config.ppo.rows_per_minibatch, num_devices, config.num_seeds
    mesh = devices.make_mesh(*shared)
    everywhere = devices.replicate(recipe.given, mesh)
    last = config.ppo.num_updates if num_updates is None else num_updates
    seeds = len(recipe.seeds) if len(recipe.seeds) > 1 else 0
    broken = ""
    in_row = np.zeros(len(recipe.seeds), int)  # updates skipped
    with contextlib.ExitStack() as held:
        if devices.is_first():
            held.enter_context(locked(root))
        state, before, recent = devices.on_first(lambda: _begin(root, recipe, resume))
        state = devices.replicate(state, mesh)
        done = int(np.max(devices.local(state.num_updates)))
        recorder = None
        if devices.is_first():
            recorder = _Recorder(root, recipe, report, last, before, done, recent)
            held.enter_context(contextlib.closing(recorder))
        while done < last and not broken and not devices.any_process(should_stop()):
            given, learner = everywhere, recipe.learners[done % len(recipe.learners)]
            if done < recipe.num_imitated:
                assert recipe.imitate is not None  # there are updates that imitate
                learner, shown = recipe.imitate(done)
                given = (devices.replicate(shown, mesh, "sets"),)
            update = compiled_update(config.ppo, learner, mesh, seeds)
            with collective():
                state, metrics = update(state, *given)
                # One transfer for all that the update measured.
                row = jax.device_get(devices.local(metrics))
            done += 1
            in_row = np.where(np.ravel(row["skipped"]) == 0.0, 0, in_row + 1)
            if in_row.min() == _SKIPS:
                broken = _broken(row, done)
            if recorder is not None:
                recorder.note(state, done, row, save=not broken)
        if recorder is not None:
            recorder.close()  # rows before the checkpoint that counts them
            recorder.save(state, done)
    if broken:
        raise DivergedError(broken)
    return state


def _broken(metrics: Mapping[str, Any], update: int) -> str:
    names = [n for n in ("policy_loss", "value_loss", *_LOSSES) if n in metrics]
    values = {name: float(np.mean(metrics[name])) for name in names}
    name, value = next((n, v) for n, v in values.items() if not np.isfinite(v))
    return (
        f"diverged: {name} is {value} in {_SKIPS} consecutive updates, the last of "
        f"them {update}. The weights before are saved; start again with a smaller "
        "learning rate"
    )


@contextlib.contextmanager
def locked(root: pathlib.Path) -> Iterator[None]:
    """The run folder of this training alone; made where missing."""
    root.mkdir(parents=True, exist_ok=True)
    with (root / ".lock").open("a") as file:
        if not flock(file.fileno()):
            raise BlockingIOError(
                f"another training is writing to {root}: name another folder"
            )
        yield


@dataclasses.dataclass
class _Recorder:
    """Output of a run, on the first process only: rows, reports, checkpoints."""

    root: pathlib.Path
    recipe: Recipe
    report: Callable[[Report], None]
    last: int  # update at which the run ends
    before: float  # seconds of training before a resume
    reported: int  # update of the last report; at first the updates made before
    recent: np.ndarray  # last rewards of the first task

    def __post_init__(self) -> None:
        recipe = self.recipe
        first = ("update", recipe.config.ppo.unit, "seconds", "reward_mean")
        columns = (*first, *recipe.columns, *_LOSSES, *recipe.measured)
        self._rows = _Table(self.root / "metrics.csv", self.reported, columns)
        self._begun = self._validated = time.perf_counter()
        self._saved = -np.inf  # soon after the beginning too
        self._of_seeds: list[dict[str, float]] = []  # of the last validation
        self._skipped = 0
        self._judging_s: list[float] = []  # of each validation; the first compiles

    def note(
        self, state: TrainState, done: int, metrics: Mapping[str, Any], save: bool
    ) -> None:
        """Record the metrics of an update; validate and save when due."""
        recipe, config, now = self.recipe, self.recipe.config, time.perf_counter()
        if (done - 1) % len(recipe.learners) == 0:
            rewards = np.ravel(metrics.get("rewards", ()))
            self.recent = np.concatenate([self.recent, rewards])[-_LAST:]
        self._skipped += bool(np.any(metrics["skipped"]))
        row = {name: _mean(values) for name, values in metrics.items()}
        row |= {"update": done, "seconds": self._seconds(now)}
        row[config.ppo.unit] = done * config.ppo.played_per_update
        self._validate(state, row)
        self._rows.add(row)
        if save and now - self._saved > config.save_every:
            self._saved = now
            self.save(state, done)

    def _validate(self, state: TrainState, row: dict[str, float]) -> None:
        """Validate and report when due, and at the first and last update."""
        recipe, config = self.recipe, self.recipe.config
        done, now = int(row["update"]), time.perf_counter()
        pause = config.validate_every  # 0: every update
        if pause and self._judging_s[1:]:  # validation has at most a tenth of the time
            pause = max(pause, 9.0 * self._judging_s[-1])
        due = now - self._validated > pause
        if not due and done not in (1, self.last):
            return
        spread: dict[str, float] = {}
        if recipe.validate is not None:
            average = devices.local(state.average)
            policies, number = [average], len(recipe.seeds)
            if number > 1:
                policies = [
                    jax.tree.map(lambda x, i=i: x[i], average) for i in range(number)
                ]
            self._of_seeds = [
                dict(zip(recipe.measured, recipe.validate(policy), strict=True))
                for policy in policies
            ]
            for name in self._of_seeds[0]:
                values = [seed[name] for seed in self._of_seeds]
                row[name] = float(np.mean(values))
                spread[name] = float(np.std(values, ddof=1)) if number > 1 else 0.0
        rate = (done - self.reported) / max(now - self._validated, 1e-9)
        self._validated, self.reported = time.perf_counter(), done
        self._judging_s.append(self._validated - now)
        self.report(
            Report(
                update=done,
                played=done * config.ppo.played_per_update,
                seconds=self._seconds(now),
                per_second=rate * config.ppo.played_per_update,
                eta=(self.last - done) / rate,
                metrics=row,
                spread=spread,
                skipped=self._skipped,
            )
        )

    def _seconds(self, now: float) -> float:
        return self.before + now - self._begun

    def save(self, state: TrainState, done: int) -> None:
        recipe, config = self.recipe, self.recipe.config
        with atomic_write(self.root / "last_rewards.npy") as file:
            np.save(file, self.recent)
        progress: dict[str, Any] = {
            "updates": done,
            config.ppo.unit: done * config.ppo.played_per_update,
            "seconds": self._seconds(time.perf_counter()),
            "device": jax.devices()[0].device_kind,
        }
        if len(recipe.seeds) > 1:
            scores = [seed[recipe.measured[0]] for seed in self._of_seeds]
            progress["best"] = int(np.argmax(scores)) if scores else 0
            progress["seeds"] = self._of_seeds
        meta = config.as_meta() | {"schema": recipe.schema, "progress": progress}
        state = devices.local(state)
        checkpoint.save(self.root / "checkpoint", done, state.average, meta, state)

    def close(self) -> None:
        self._rows.close()


def _begin(
    root: pathlib.Path, recipe: Recipe, resume: bool
) -> tuple[TrainState, float, np.ndarray]:
    """The state to start from, seconds already trained, the last rewards."""
    state = recipe.init()
    if not resume:
        return state, 0.0, np.zeros(0, np.float32)
    state, meta = checkpoint.restore(root, state, recipe.schema)
    rewards = root / "last_rewards.npy"
    recent = np.load(rewards) if rewards.exists() else np.zeros(0, np.float32)
    return state, float(meta["progress"]["seconds"]), recent


def _mean(values: Any) -> float:
    """Mean of those that are finite: a run that diverged is NaN from then on."""
    finite = np.ravel(values)[np.isfinite(np.ravel(values))]
    return float(finite.mean()) if len(finite) else np.nan


class _Table:
    """A CSV file to append to, without its rows of updates after ``done``."""

    def __init__(self, path: pathlib.Path, done: int, columns: Sequence[str]) -> None:
        lines = path.read_text().splitlines()[1:] if path.exists() else []
        commas = len(columns) - 1
        whole = [(x.partition(",")[0], x) for x in lines if x.count(",") == commas]
        kept = [x for first, x in whole if first.isdigit() and int(first) <= done]
        write_text(path, "\n".join([",".join(columns), *kept]) + "\n")
        self._columns, self._file = columns, path.open("a", newline="")

    def add(self, row: Mapping[str, float]) -> None:
        """Write a row and flush it; what is not measured, or NaN, is empty."""
        cells = (row.get(name, np.nan) for name in self._columns)
        writer = csv.writer(self._file, lineterminator="\n")
        writer.writerow("" if np.isnan(cell) else cell for cell in cells)
        self._file.flush()

    def close(self) -> None:
        if not self._file.closed:
            os.fsync(self._file.fileno())
            self._file.close()
