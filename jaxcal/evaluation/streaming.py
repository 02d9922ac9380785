"""Evaluation of any number of episodes: constant memory, resumable, exact sums.

The drawn datasets go on for ever, a random stream for every block of episodes. They are
evaluated in parts; what a part adds to every mean is a file of its own
(``jaxcal.evaluation.tally``), written when the part is complete. So a run that was stopped
goes on, several processes share a folder, and the totals are the same to the last digit
however the parts were made.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import pathlib
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation import methods as evaluation
from jaxcal.evaluation.results import StreamedData, StreamedEvaluation, StreamedResult
from jaxcal.evaluation.tally import RunningTally, Tally, tally_of
from jaxcal.files import write_text
from jaxcal.paper.datasets import datasets

__all__ = ["PART", "Plan", "evaluate_stream", "num_cores", "open_folder"]

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

PART = 5_000  # episodes whose sums are one file
FORMAT = "jaxcal-evaluation-stream"
VERSION = 1
_NUM_AXES = 3  # commands and outputs of every drawn dataset
_POLL_SECONDS = 1.0  # between looks for the parts of other processes


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is evaluated: parts of equal plans add up."""

    dataset: str = "dataset2"
    seed: int = 0
    k: int = 4
    methods: tuple[str, ...] = evaluation.BASELINES
    checkpoints: tuple[str | None, ...] = (None,)
    num: int = 16  # tries of policy:samples and policy:first
    draws: int = evaluation.DEFAULT_RANDOM_DRAWS

    def __post_init__(self) -> None:
        if self.dataset not in datasets.DRAWN:
            raise ValueError(
                f"a streamed dataset must be one of {', '.join(datasets.DRAWN)}, which "
                f"are drawn from a seed without end, got {self.dataset!r}"
            )
        for method in self.methods:
            if method not in evaluation.DEFAULT_METHODS:
                raise ValueError(
                    "a streamed method must be one of "
                    f"{', '.join(evaluation.DEFAULT_METHODS)}, got {method!r}"
                )
        if not _NUM_AXES + 1 <= self.k < datasets.NUM_CANDIDATES:
            raise ValueError(
                f"k must be in [{_NUM_AXES + 1}, {datasets.NUM_CANDIDATES}), "
                f"got {self.k}"
            )

    @property
    def policies(self) -> list[tuple[str, str | None]]:
        """(method, checkpoint) of every policy row."""
        return [
            (method, checkpoint)
            for method in self.methods
            if method in evaluation.POLICIES
            for checkpoint in self.checkpoints
        ]

    @property
    def rows(self) -> list[tuple[str, str | None]]:
        """(method, checkpoint) of every row, in the order asked for."""
        return [
            row
            for method in self.methods
            for row in (
                [(method, checkpoint) for checkpoint in self.checkpoints]
                if method in evaluation.POLICIES
                else [(method, None)]
            )
        ]


def num_cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def open_folder(plan: Plan, folder: pathlib.Path) -> None:
    """Make a folder for a plan, or make sure that it holds parts of the same one.

    Raises:
        ValueError: it holds parts of another plan, or of other package versions.
        OSError: it cannot be read or written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted = json.loads(json.dumps(_description(plan)))
    path = folder / "stream.json"
    if not path.exists():
        write_text(path, json.dumps(wanted, indent=1) + "\n")
        return
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        differing = [name for name in wanted if held.get(name) != wanted[name]]
    except (ValueError, AttributeError):
        raise ValueError(f"{path} is damaged: it is not a JSON object") from None
    if differing:
        name = differing[0]
        raise ValueError(
            f"{folder} holds parts of another evaluation: its {name} is "
            f"{held.get(name)!r}, not {wanted[name]!r}; name another folder"
        )


def evaluate_stream(
    plan: Plan,
    episodes: int,
    folder: pathlib.Path,
    *,
    workers: int | None = None,
    process: tuple[int, int] = (0, 1),
    part: int = PART,
    progress: Progress | None = None,
) -> StreamedEvaluation:
    """Evaluate the first episodes of a plan, going on from the parts in a folder.

    Args:
        plan: what is evaluated.
        episodes: how many.
        folder: made ready by ``open_folder``; all processes see it.
        workers: processes on this machine that solve the baselines; its cores when
            None, and none beside this one where 1.
        process: (i, n), this is the i-th of n; each takes every n-th part.
        part: episodes of a file, a multiple of the block that shares a stream.
        progress: called as parts are completed.

    Raises:
        ValueError: a part is damaged, or a policy returned what it must not.
        OSError: the folder cannot be read or written, or a worker died.
    """
    if part < 1 or part % datasets.BLOCK:
        raise ValueError(
            f"part must be a multiple of {datasets.BLOCK} episodes, got {part}"
        )
    report = progress or (lambda *_: None)
    cuts = [(begin, min(begin + part, episodes)) for begin in range(0, episodes, part)]
    own = [
        cut for cut in cuts[process[0] :: process[1]] if not _path(folder, cut).exists()
    ]
    todo = sum(end - begin for begin, end in own)
    done = 0
    report("episodes", 0, todo)
    with _pool(num_cores() if workers is None else workers) as executor:
        for cut, blocks in _ahead(plan, own, executor):
            _write(folder, cut, _part_tallies(plan, cut, blocks))
            done += cut[1] - cut[0]
            report("episodes", done, todo)
    while not all(_path(folder, cut).exists() for cut in cuts):
        time.sleep(_POLL_SECONDS)
    return _total(plan, episodes, folder, cuts, report)


def _description(plan: Plan) -> dict[str, Any]:
    from jaxcal.evaluation.report import versions

    own = {"format": FORMAT, "version": VERSION} | dataclasses.asdict(plan)
    weights = {}
    if plan.policies:
        from jaxcal.learning.training.checkpoint import fingerprint

        weights = {
            checkpoint or "default": fingerprint(checkpoint)
            for checkpoint in plan.checkpoints
        }
    return own | {"weights": weights, "versions": versions()}


# -- one part --------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Block:
    """The baselines on the episodes of one stream."""

    reference: Array  # (E,) log det S*, or a bound on it
    proven: NDArray[np.bool_]  # (E,)
    tallies: dict[str, Tally]  # "random", and every baseline asked for


def _solve_block(plan: Plan, begin: int, end: int) -> _Block:
    """Runs in a worker, which loads no JAX."""
    dataset = datasets.drawn(plan.dataset, plan.seed, begin, end)
    methods = [name for name in plan.methods if name not in evaluation.POLICIES]
    found = evaluation.evaluate(
        dataset,
        plan.k,
        list(dict.fromkeys(["random", *methods])),
        random_draws=plan.draws,
        seed=plan.seed + begin,
    )
    tallies = {
        result.method: tally_of(
            result.log_det,
            found.reference,
            found.proven,
            found.dataset.num_outputs,
            found.num_parameters,
            result.seconds * dataset.num_episodes,
        )
        for result in found.results
    }
    return _Block(found.reference, found.proven, tallies)


def _part_tallies(
    plan: Plan, cut: tuple[int, int], blocks: list[Future[_Block]]
) -> dict[str, Any]:
    """What a part adds: the policies are run here, beside the workers."""
    found = {}
    if plan.policies:
        dataset = datasets.drawn(plan.dataset, plan.seed, *cut)
        found = evaluation.evaluate_policies(
            dataset,
            plan.k,
            plan.policies,
            num=plan.num,
            seed=plan.seed + cut[0],
        )
    try:
        solved = [block.result() for block in blocks]
    except BrokenProcessPool:
        raise OSError(
            "a worker process died, perhaps for want of memory: use fewer (--workers)"
        ) from None
    reference = np.concatenate([block.reference for block in solved])
    proven = np.concatenate([block.proven for block in solved])
    tallies = {
        _key(method, checkpoint): tally_of(
            result.log_det,
            reference,
            proven,
            _NUM_AXES,
            _NUM_AXES * (_NUM_AXES + 1),
            result.seconds * (cut[1] - cut[0]),
        )
        for (method, checkpoint), result in found.items()
    }
    for name in solved[0].tallies:
        parts = [block.tallies[name] for block in solved]
        tallies[_key(name, None)] = functools.reduce(Tally.__add__, parts)
    return {
        "episodes": list(cut),
        "proven": int(proven.sum()),
        "methods": {name: tally.as_json() for name, tally in tallies.items()},
    }


def _key(method: str, checkpoint: str | None) -> str:
    return method if checkpoint is None else f"{method} {checkpoint}"


# -- many parts ------------------------------------------------------------------------


class _Here(Executor):
    """Solves when asked, in this process."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


@contextlib.contextmanager
def _pool(workers: int) -> Iterator[Executor]:
    if workers < 1:
        raise ValueError(f"workers must be at least 1, got {workers}")
    if workers == 1:
        yield _Here()
        return
    # Each worker is one thread: the linear algebra is too small to share.
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=_begin_worker)
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin_worker() -> None:
    # An interrupt is the parent's to handle.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    """A parent that was killed tells nobody: its workers would wait for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _ahead(
    plan: Plan, cuts: list[tuple[int, int]], executor: Executor
) -> Iterator[tuple[tuple[int, int], list[Future[_Block]]]]:
    """The parts with their blocks begun, a few parts ahead of the one in hand."""
    number = (
        1
        if isinstance(executor, _Here)
        else 2 + 2 * num_cores() * datasets.BLOCK // PART
    )
    begun: list[tuple[tuple[int, int], list[Future[_Block]]]] = []
    left = iter(cuts)
    while True:
        for cut in left:
            blocks = [
                executor.submit(
                    _solve_block, plan, begin, min(begin + datasets.BLOCK, cut[1])
                )
                for begin in range(*cut, datasets.BLOCK)
            ]
            begun.append((cut, blocks))
            if len(begun) >= number:
                break
        if not begun:
            return
        yield begun.pop(0)


# -- the folder ------------------------------------------------------------------------


def _path(folder: pathlib.Path, cut: tuple[int, int]) -> pathlib.Path:
    return folder / f"part-{cut[0]:012d}-{cut[1]:012d}.json"


def _write(folder: pathlib.Path, cut: tuple[int, int], part: dict[str, Any]) -> None:
    write_text(_path(folder, cut), json.dumps(part, separators=(",", ":")) + "\n")


def _total(
    plan: Plan,
    episodes: int,
    folder: pathlib.Path,
    cuts: list[tuple[int, int]],
    report: Progress,
) -> StreamedEvaluation:
    """All parts of a folder added up."""
    proven = 0
    running: dict[str, RunningTally] = {}
    for number, cut in enumerate(cuts):
        report("parts added up", number, len(cuts))
        path = _path(folder, cut)
        try:
            part = json.loads(path.read_text(encoding="utf-8"))
            if part["episodes"] != list(cut):
                raise ValueError(f"it says episodes {part['episodes']}")
            proven += int(part["proven"])
            for name, row in part["methods"].items():
                running.setdefault(name, RunningTally()).add(Tally.from_json(row))
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{path} is damaged ({error}); delete it, and it is computed again"
            ) from None
    totals = {name: tallies.total() for name, tallies in running.items()}
    random = totals["random"]
    return StreamedEvaluation(
        dataset=StreamedData(
            name=plan.dataset,
            num_episodes=episodes,
            num_candidates=datasets.NUM_CANDIDATES,
            num_inputs=_NUM_AXES,
            num_outputs=_NUM_AXES,
            seed=plan.seed,
        ),
        k=plan.k,
        seed=plan.seed,
        results=tuple(
            StreamedResult(
                method=method,
                label=evaluation.label_of(method, plan.num),
                checkpoint=checkpoint,
                numbers=totals[_key(method, checkpoint)].summary(random, episodes),
            )
            for method, checkpoint in plan.rows
        ),
        num_proven=proven,
    )
