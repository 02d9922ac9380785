"""Evaluation of any number of episodes: constant memory, resumable, shared.

An endless dataset is evaluated in parts; the rows of a part are a file of its own,
written when it is done. So a run that was stopped resumes, more episodes start from
what is there, and several processes share a folder; none of that changes a digit,
because the same parts are averaged in the same order.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import math
import operator
import os
import pathlib
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from typing import Any

from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.methods import (
    BASELINES,
    DEFAULT_METHODS,
    DEFAULT_RANDOM_DRAWS,
    POLICIES,
    evaluate,
    rows_of,
)
from jaxcal.evaluation.results import Row, Summary, versions
from jaxcal.files import write_text

__all__ = ["PART", "Plan", "evaluate_stream", "open_folder", "total"]

Cut = tuple[int, int]  # first episode, one after the last
Numbers = dict[str, Any]  # of a row, see docs/evaluation.md

PART = 5_000  # episodes whose rows are one file; the draws' blocks of 1,000 divide it
_AVERAGES = ("ratio_to_exact", "hit_rate", "d_efficiency", "seconds_per_selection")
_MOMENTS = ("det_s", "log_det_s")
_ONE_THREAD = [f"{name}_NUM_THREADS" for name in ("OPENBLAS", "OMP", "MKL")]


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is evaluated: parts of equal plans add up."""

    dataset: str
    draw: Callable[[str, int, int, int], Dataset]
    """(dataset, seed, begin, end) -> episodes; ``begin`` is a multiple of 1,000."""
    seed: int = 0
    k: int = 4
    methods: tuple[str, ...] = BASELINES
    checkpoints: tuple[str | None, ...] = (None,)
    num: int = 16  # tries of policy:samples and policy:first
    draws: int = DEFAULT_RANDOM_DRAWS

    def __post_init__(self) -> None:
        for method in set(self.methods) - set(DEFAULT_METHODS):
            raise ValueError(
                f"a streamed method must be one of {', '.join(DEFAULT_METHODS)}, "
                f"got {method!r}"
            )
        first = self.draw(self.dataset, self.seed, 0, 1)
        if not first.num_inputs < self.k < first.num_candidates:
            raise ValueError(
                f"k must be in [{first.num_inputs + 1}, {first.num_candidates}), "
                f"got {self.k}"
            )

    def description(self) -> dict[str, Any]:
        """What ``stream.json`` says: equal for folders whose parts add up."""
        weights = {}
        if any(method in POLICIES for method in self.methods):
            from jaxcal.learning.training.checkpoint import fingerprint

            weights = {c or "default": fingerprint(c) for c in self.checkpoints}
        return {
            **{"format": "jaxcal-evaluation-stream", "version": 3, "part": PART},
            **{name: value for name, value in vars(self).items() if name != "draw"},
            **{"weights": weights, "versions": versions()},
        }


def open_folder(plan: Plan, folder: pathlib.Path) -> None:
    """Make a folder for a plan, or make sure that it holds parts of the same one.

    Raises:
        ValueError: it holds parts of another plan, or of other package versions.
        OSError: it cannot be read or written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted = json.loads(json.dumps(plan.description()))
    path = folder / "stream.json"
    if not path.exists():
        write_text(path, json.dumps(wanted, indent=1) + "\n")
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        differing = [name for name in wanted if held.get(name) != wanted[name]]
    except (ValueError, AttributeError):
        raise ValueError(f"{path} is damaged: it is not a JSON object") from None
    for name in differing:
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
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Summary:
    """Evaluate the first episodes of a plan, resuming from the parts in a folder.

    Args:
        plan: what is evaluated.
        episodes: how many.
        folder: made ready by ``open_folder``; all processes see it.
        workers: processes on this machine that solve; its cores when None, none beside
            this one where 1.
        process: (i, n), this is the i-th of n. Each takes every n-th part, then, last
            ones first, those that the others have not written: none waits for another.
        progress: called as parts are completed.

    Raises:
        ValueError: a part is damaged, or a policy returned what it must not.
        OSError: the folder cannot be read or written, or a worker died.
    """
    cuts = [(begin, min(begin + PART, episodes)) for begin in range(0, episodes, PART)]
    own = cuts[process[0] :: process[1]]
    order = [*own, *(cut for cut in reversed(cuts) if cut not in own)]
    order = [cut for cut in order if not _path(folder, cut).exists()]
    todo, done = sum(end - begin for begin, end in order), 0
    progress("episodes", 0, todo)
    with _workers(_cores() if workers is None else workers) as run:
        written = run(functools.partial(_write_part, plan, folder), order)
        for (begin, end), _ in zip(order, written, strict=True):
            done += end - begin
            progress("episodes", done, todo)

    parts = [_read_part(_path(folder, cut), cut) for cut in cuts]
    counts = [end - begin for begin, end in cuts]
    rows = {
        row: total(counts, [part["rows"][_key(*row)] for part in parts])
        for row in rows_of(_with_random(plan), plan.checkpoints)
    }
    random = rows["random", None]["det_s"]["mean"]
    for numbers in rows.values():
        mean = numbers["det_s"]["mean"]
        numbers["ratio_to_random"] = mean / random if mean and random else None
    return Summary(
        plan.draw(plan.dataset, plan.seed, 0, 1).facts() | {"episodes": episodes},
        plan.k,
        plan.seed,
        sum(part["proven"] for part in parts),
        tuple(Row(*row, rows[row]) for row in rows_of(plan.methods, plan.checkpoints)),
        notes=(f"medians are means of those of parts of {PART:,} episodes",),
    )


def total(counts: list[int], parts: list[Numbers]) -> Numbers:
    """One row of all parts; a number that one of them lacks is lacking.

    Args:
        counts: episodes of each part.
        parts: their rows: averages over their episodes, each with as many draws.
    """

    def mean(values: Iterable[float | None]) -> float | None:
        known = [value for value in values if value is not None]
        if len(known) < len(counts):
            return None
        return math.fsum(map(operator.mul, counts, known)) / sum(counts)

    def moments(held: list[dict[str, Any]]) -> dict[str, float | None]:
        middle, std = mean(one["mean"] for one in held), None
        if middle is not None and all(one["std"] is not None for one in held):
            square = mean(one["std"] ** 2 + (one["mean"] - middle) ** 2 for one in held)
            std = None if square is None else square**0.5
        return {"mean": middle, "std": std, "median": mean(o["median"] for o in held)}

    return {
        **parts[0],  # its label and number of draws are those of all
        **{name: mean(part[name] for part in parts) for name in _AVERAGES},
        **{name: moments([part[name] for part in parts]) for name in _MOMENTS},
    }


def _write_part(plan: Plan, folder: pathlib.Path, cut: Cut) -> None:
    if _path(folder, cut).exists():
        return  # another process was sooner
    part = {"episodes": cut} | _solved(plan, *cut)
    write_text(_path(folder, cut), json.dumps(part, separators=(",", ":")) + "\n")


def _solved(plan: Plan, begin: int, end: int) -> dict[str, Any]:
    """How many optima of some episodes are proven, and the rows."""
    found = evaluate(
        plan.draw(plan.dataset, plan.seed, begin, end),
        plan.k,
        _with_random(plan),
        plan.checkpoints,
        num=plan.num,
        random_draws=plan.draws,
        seed=plan.seed + begin,
    ).summarise()
    rows = {_key(row.method, row.checkpoint): row.numbers for row in found.rows}
    for numbers in rows.values():
        numbers.pop("parameter_variance", None)  # of all episodes at once only
    return {"proven": found.num_proven, "rows": rows}


def _with_random(plan: Plan) -> list[str]:
    return list(dict.fromkeys(["random", *plan.methods]))


def _key(method: str, checkpoint: str | None) -> str:
    return method if checkpoint is None else f"{method} {checkpoint}"


def _path(folder: pathlib.Path, cut: Cut) -> pathlib.Path:
    return folder / f"part-{cut[0]:012d}-{cut[1]:012d}.json"


def _read_part(path: pathlib.Path, cut: Cut) -> dict[str, Any]:
    try:
        part = json.loads(path.read_text(encoding="utf-8"))
        if part["episodes"] != list(cut):
            raise ValueError(f"it says episodes {part['episodes']}")
        return {"proven": int(part["proven"]), "rows": dict(part["rows"])}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} is damaged ({error}); delete it, and it is computed again"
        ) from None


def _cores() -> int:
    """Cores that this process may use; macOS does not say which."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextlib.contextmanager
def _workers(number: int) -> Iterator[Callable[..., Iterable[None]]]:
    """``map`` over so many processes of one thread each; in this one where it is 1.

    What has not begun when the block is left, is cancelled.
    """
    if number < 1:
        raise ValueError(f"workers must be at least 1, got {number}")
    if number == 1:
        yield map
        return
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    # Read when a worker starts, before it imports numpy.
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    pool = ProcessPoolExecutor(number, get_context("spawn"), _begin_worker)
    try:
        yield pool.map
    except BrokenProcessPool:
        raise OSError(
            "a worker process died, perhaps because memory ran out: use fewer "
            "(--workers)"
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            os.environ.pop(name, None)
            os.environ.update({} if value is None else {name: value})


def _begin_worker() -> None:
    """An interrupt is the parent's; where the parent is killed, its workers end too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
