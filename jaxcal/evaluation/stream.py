"""Evaluation of any number of episodes: constant memory, resumable, shared.

An endless dataset has a random stream for every block of episodes. What ``PART``
episodes add to every count and sum is a file of its own, written when they are done. So
a run that was stopped resumes, more episodes start from what is there, and several
processes share a folder; none of that changes a digit, because the same parts are added
up in the same order. Medians cannot be added: they are read off a histogram.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
import json
import math
import os
import pathlib
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.methods import (
    BASELINES,
    DEFAULT_METHODS,
    DEFAULT_RANDOM_DRAWS,
    POLICIES,
    evaluate,
    label_of,
    rows_of,
)
from jaxcal.evaluation.results import HIT_TOLERANCE, Row, Summary, versions
from jaxcal.files import write_text

__all__ = ["PART", "Plan", "evaluate_stream", "open_folder", "summary", "tally_of"]

Array = NDArray[np.float64]
Cut = tuple[int, int]  # first episode, one after the last
Tally = collections.Counter[str]
"""Counts: episodes, selections (episodes times draws), hits (proven optima), singular
(det S = 0; in no sum of logs), "bin i" of log det S. Sums: det, log_det, their squares,
ratio (det S / det S*), efficiency (its p-th root), seconds. ``update`` adds another."""

BLOCK = 1_000  # episodes that share a random stream
PART = 5_000  # episodes whose sums are one file
BINS_PER_UNIT = 64  # of log det S: a median is within 1/64, 1.6 % of det S
_POLL_SECONDS = 1.0  # between looks for the parts of other processes
_ONE_THREAD = [f"{name}_NUM_THREADS" for name in ("OPENBLAS", "OMP", "MKL", "NUMBA")]


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is evaluated: parts of equal plans add up."""

    dataset: str
    draw: Callable[[str, int, int, int], Dataset]
    """(dataset, seed, begin, end) -> episodes; ``begin`` is a multiple of ``BLOCK``."""
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
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        del values["draw"]
        weights = {}
        if any(method in POLICIES for method in self.methods):
            from jaxcal.learning.training.checkpoint import fingerprint

            weights = {c or "default": fingerprint(c) for c in self.checkpoints}
        known = {"format": "jaxcal-evaluation-stream", "version": 3, "part": PART}
        return known | values | {"weights": weights, "versions": versions()}


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
        process: (i, n), this is the i-th of n; each takes every n-th part.
        progress: called as parts are completed.

    Raises:
        ValueError: a part is damaged, or a policy returned what it must not.
        OSError: the folder cannot be read or written, or a worker died.
    """
    cuts = [(begin, min(begin + PART, episodes)) for begin in range(0, episodes, PART)]
    own = cuts[process[0] :: process[1]]
    own = [cut for cut in own if not _path(folder, cut).exists()]
    todo, done = sum(end - begin for begin, end in own), 0
    progress("episodes", 0, todo)
    cores = len(os.sched_getaffinity(0)) if workers is None else workers
    with _workers(cores) as run:
        written = run(functools.partial(_write_part, plan, folder), own)
        for (begin, end), _ in zip(own, written, strict=True):
            done += end - begin
            progress("episodes", done, todo)
    while not all(_path(folder, cut).exists() for cut in cuts):
        time.sleep(_POLL_SECONDS)

    proven, totals = 0, collections.defaultdict[str, Tally](Tally)
    for number, cut in enumerate(cuts):
        progress("parts added up", number, len(cuts))
        count, rows = _read_part(_path(folder, cut), cut)
        proven += count
        for name, row in rows.items():
            totals[name].update(row)
    shown = [
        Row(
            method,
            checkpoint,
            {"label": label_of(method, plan.num)}
            | summary(totals[_key(method, checkpoint)], totals["random"]),
        )
        for method, checkpoint in rows_of(plan.methods, plan.checkpoints)
    ]
    facts = plan.draw(plan.dataset, plan.seed, 0, 1).facts() | {"episodes": episodes}
    note = (
        "means and hit rates are of sums over all episodes; medians are read off a "
        f"histogram of log det S with bins of 1/{BINS_PER_UNIT}"
    )
    return Summary(facts, plan.k, plan.seed, proven, tuple(shown), notes=(note,))


def _write_part(plan: Plan, folder: pathlib.Path, cut: Cut) -> None:
    proven, totals = 0, collections.defaultdict[str, Tally](Tally)
    for begin in range(*cut, BLOCK):
        count, rows = _solve_block(plan, begin, min(begin + BLOCK, cut[1]))
        proven += count
        for name, row in rows.items():
            totals[name].update(row)
    part = {"episodes": cut, "proven": proven, "methods": totals}
    write_text(_path(folder, cut), json.dumps(part, separators=(",", ":")) + "\n")


def _solve_block(plan: Plan, begin: int, end: int) -> tuple[int, dict[str, Tally]]:
    """Proven optima among the episodes of one stream, and what every row adds."""
    dataset = plan.draw(plan.dataset, plan.seed, begin, end)
    found = evaluate(
        dataset,
        plan.k,
        list(dict.fromkeys(["random", *plan.methods])),
        plan.checkpoints,
        num=plan.num,
        random_draws=plan.draws,
        seed=plan.seed + begin,
    )
    m, n = dataset.num_outputs, dataset.num_inputs
    return int(found.proven.sum()), {
        _key(result.method, result.checkpoint): tally_of(
            result.log_det,
            found.reference,
            found.proven,
            m,
            m * (n + 1),
            result.seconds * dataset.num_episodes,
        )
        for result in found.results
    }


def _key(method: str, checkpoint: str | None) -> str:
    return method if checkpoint is None else f"{method} {checkpoint}"


def _path(folder: pathlib.Path, cut: Cut) -> pathlib.Path:
    return folder / f"part-{cut[0]:012d}-{cut[1]:012d}.json"


def _read_part(path: pathlib.Path, cut: Cut) -> tuple[int, dict[str, Tally]]:
    try:
        part = json.loads(path.read_text(encoding="utf-8"))
        if part["episodes"] != list(cut):
            raise ValueError(f"it says episodes {part['episodes']}")
        rows = {name: Tally(row) for name, row in part["methods"].items()}
        return int(part["proven"]), rows
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} is damaged ({error}); delete it, and it is computed again"
        ) from None


def tally_of(
    log_det: Array,
    reference: Array,
    proven: NDArray[np.bool_],
    num_outputs: int,
    num_parameters: int,
    seconds: float,
) -> Tally:
    """What some selections add.

    Args:
        log_det: (E, R) natural log det S of what was chosen.
        reference: (E,) that of the optimum, or a bound on it.
        proven: (E,) which of them are proven.
        num_outputs: m.
        num_parameters: p.
        seconds: spent choosing.
    """
    behind = log_det - reference[:, None]
    hits = proven[:, None] & (behind >= -HIT_TOLERANCE * num_outputs)
    behind = np.minimum(behind, 0.0)
    finite = log_det[np.isfinite(log_det)]
    det = np.exp(log_det)
    sums = {
        "det": det,
        "det_squared": det * det,
        "log_det": finite,
        "log_det_squared": finite * finite,
        "ratio": np.exp(behind),
        "efficiency": np.exp(behind / num_parameters),
    }
    bins, counts = np.unique(np.floor(finite * BINS_PER_UNIT), return_counts=True)
    numbers = {
        "episodes": len(log_det),
        "selections": log_det.size,
        "hits": int(hits.sum()),
        "singular": log_det.size - finite.size,
        "seconds": seconds,
        **{name: math.fsum(values.ravel()) for name, values in sums.items()},
        **{f"bin {int(b)}": int(n) for b, n in zip(bins, counts, strict=True)},
    }
    return Tally(numbers)


def summary(tally: Tally, random: Tally) -> dict[str, Any]:
    """The numbers of one method against the baseline, see docs/evaluation.md."""
    count, episodes = tally["selections"], tally["episodes"]
    log_det: dict[str, float | None] = {"mean": None, "std": None}
    if not tally["singular"]:
        log_det = _moments(tally, "log_det")
    middle = _median_log_det(tally)
    mean, baseline = tally["det"] / count, random["det"] / random["selections"]
    return {
        "det_s": _moments(tally, "det") | {"median": math.exp(middle)},
        "log_det_s": log_det | {"median": middle if middle > -math.inf else None},
        "ratio_to_exact": tally["ratio"] / count,
        "hit_rate": tally["hits"] / count,
        "d_efficiency": tally["efficiency"] / count,
        "ratio_to_random": mean / baseline if baseline else None,
        "seconds_per_selection": tally["seconds"] / episodes,
        "draws_per_episode": count // episodes,
    }


def _moments(tally: Tally, name: str) -> dict[str, float | None]:
    mean = tally[name] / tally["selections"]
    variance = tally[f"{name}_squared"] / tally["selections"] - mean * mean
    return {"mean": mean, "std": math.sqrt(max(variance, 0.0))}  # 0: of equal values


def _median_log_det(tally: Tally) -> float:
    """Median of log det S, from the histogram; ``-inf`` where most are singular."""
    half, below = tally["selections"] / 2, tally["singular"]
    if below > half:
        return -math.inf
    bins = {int(n[4:]): v for n, v in tally.items() if n.startswith("bin ")}
    for number, count in sorted(bins.items()):
        if below + count >= half:
            return (number + (half - below) / count) / BINS_PER_UNIT
        below += count
    raise ValueError("a tally of nothing has no median")


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
