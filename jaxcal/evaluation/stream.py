"""Evaluation of any number of episodes: constant memory, resumable, shared.

An endless dataset has a random stream for every block of episodes. It is evaluated in
parts of whole blocks; what a part adds to every mean is a file of its own, written when
the part is complete (``jaxcal.evaluation.tally``). So a run that was stopped resumes,
several processes share a folder, and the totals are the same to the last digit however
the parts were cut.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import json
import pathlib
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from jaxcal.evaluation import tally
from jaxcal.evaluation.catalogue import Catalogue
from jaxcal.evaluation.methods import (
    BASELINES,
    DEFAULT_METHODS,
    DEFAULT_RANDOM_DRAWS,
    POLICIES,
    evaluate,
    label_of,
    rows_of,
)
from jaxcal.evaluation.results import Row, Summary, versions
from jaxcal.evaluation.tally import BINS_PER_UNIT, Tally
from jaxcal.evaluation.workers import num_cores, worker_pool
from jaxcal.files import write_text

__all__ = ["PART", "Plan", "evaluate_stream", "open_folder"]

Progress = Callable[[str, int, int], None]
Cut = tuple[int, int]  # first episode, one after the last

PART = 5_000  # episodes whose sums are one file
FORMAT = "jaxcal-evaluation-stream"
VERSION = 2
_POLL_SECONDS = 1.0  # between looks for the parts of other processes


@dataclasses.dataclass(frozen=True)
class Plan:
    """What is evaluated: parts of equal plans add up."""

    source: Catalogue
    dataset: str
    seed: int = 0
    k: int = 4
    methods: tuple[str, ...] = BASELINES
    checkpoints: tuple[str | None, ...] = (None,)
    num: int = 16  # tries of policy:samples and policy:first
    draws: int = DEFAULT_RANDOM_DRAWS

    def __post_init__(self) -> None:
        if self.dataset not in self.source.endless:
            raise ValueError(
                f"a streamed dataset must be one of {', '.join(self.source.endless)}, "
                f"which are drawn from a seed without end, got {self.dataset!r}"
            )
        for method in set(self.methods) - set(DEFAULT_METHODS):
            known = ", ".join(DEFAULT_METHODS)
            raise ValueError(
                f"a streamed method must be one of {known}, got {method!r}"
            )
        first = self.source.draw(self.dataset, self.seed, 0, 1)
        if not first.num_inputs < self.k < first.num_candidates:
            raise ValueError(
                f"k must be in [{first.num_inputs + 1}, {first.num_candidates}), "
                f"got {self.k}"
            )

    def description(self) -> dict[str, Any]:
        """What ``stream.json`` says: equal for folders whose parts add up."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        del values["source"]
        weights = {}
        if any(method in POLICIES for method in self.methods):
            from jaxcal.learning.training.checkpoint import fingerprint

            weights = {c or "default": fingerprint(c) for c in self.checkpoints}
        known = {"format": FORMAT, "version": VERSION, **values}
        return known | {"weights": weights, "versions": versions()}


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
        return
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        differing = [name for name in wanted if held.get(name) != wanted[name]]
    except (ValueError, AttributeError):
        raise ValueError(f"{path} is damaged: it is not a JSON object") from None
    if held.get("format") == FORMAT and held.get("version") != VERSION:
        raise ValueError(
            f"{folder} was written by another version of jaxcal (stream format "
            f"{held.get('version')}, this one uses {VERSION}): name another folder"
        )
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
) -> Summary:
    """Evaluate the first episodes of a plan, resuming from the parts in a folder.

    Args:
        plan: what is evaluated.
        episodes: how many.
        folder: made ready by ``open_folder``; all processes see it.
        workers: processes on this machine that solve; its cores when None, none beside
            this one where 1.
        process: (i, n), this is the i-th of n; each takes every n-th part.
        part: episodes of a file, a multiple of the block that shares a stream.
        progress: called as parts are completed.

    Raises:
        ValueError: a part is damaged, or a policy returned what it must not.
        OSError: the folder cannot be read or written, or a worker died.
    """
    size = plan.source.block
    if part < 1 or part % size:
        raise ValueError(f"part must be a multiple of {size} episodes, got {part}")
    report = progress or (lambda *_: None)
    workers = num_cores() if workers is None else workers
    cuts = [(begin, min(begin + part, episodes)) for begin in range(0, episodes, part)]
    own = cuts[process[0] :: process[1]]
    own = [cut for cut in own if not _path(folder, cut).exists()]
    todo, done = sum(end - begin for begin, end in own), 0
    report("episodes", 0, todo)
    with worker_pool(workers) as executor:
        begun = (
            executor.submit(_solve_block, plan, begin, min(begin + size, end))
            for first, end in own
            for begin in range(first, end, size)
        )
        blocks = _ahead(begun, part // size + 2 * workers)
        for cut in own:
            parts = itertools.islice(blocks, len(range(*cut, size)))
            added = {"episodes": list(cut)} | _as_json(*_added(parts))
            text = json.dumps(added, separators=(",", ":"))
            write_text(_path(folder, cut), text + "\n")
            done += cut[1] - cut[0]
            report("episodes", done, todo)
    while not all(_path(folder, cut).exists() for cut in cuts):
        time.sleep(_POLL_SECONDS)
    return _total(plan, episodes, folder, cuts, report)


Block = tuple[int, dict[str, Tally]]  # proven optima, and the tally of every row


def _solve_block(plan: Plan, begin: int, end: int) -> Block:
    """What the episodes of one stream add."""
    dataset = plan.source.draw(plan.dataset, plan.seed, begin, end)
    found = evaluate(
        dataset,
        plan.k,
        list(dict.fromkeys(["random", *plan.methods])),
        plan.checkpoints,
        num=plan.num,
        random_draws=plan.draws,
        seed=plan.seed + begin,
    )
    m = dataset.num_outputs
    tallies = {
        _key(result.method, result.checkpoint): tally.tally_of(
            result.log_det,
            found.reference,
            found.proven,
            m,
            m * (dataset.num_inputs + 1),
            result.seconds * dataset.num_episodes,
        )
        for result in found.results
    }
    return int(found.proven.sum()), tallies


def _ahead(begun: Iterator[Future[Block]], most: int) -> Iterator[Block]:
    """The results in their order, at most so many begun before they are taken."""
    try:
        waiting = collections.deque(itertools.islice(begun, most))
        while waiting:
            yield waiting.popleft().result()
            waiting.extend(itertools.islice(begun, 1))
    except BrokenProcessPool:
        raise OSError(
            "a worker process died, perhaps because memory ran out: use fewer "
            "(--workers)"
        ) from None


def _added(parts: Iterable[Block]) -> Block:
    """All of them added up."""
    proven, totals = 0, collections.defaultdict[str, Tally](dict)
    for count, tallies in parts:
        proven += count
        for name, row in tallies.items():
            tally.add(totals[name], row)
    return proven, totals


def _as_json(proven: int, tallies: dict[str, Tally]) -> dict[str, Any]:
    rows = {name: tally.as_json(row) for name, row in tallies.items()}
    return {"proven": proven, "methods": rows}


def _key(method: str, checkpoint: str | None) -> str:
    return method if checkpoint is None else f"{method} {checkpoint}"


def _path(folder: pathlib.Path, cut: Cut) -> pathlib.Path:
    return folder / f"part-{cut[0]:012d}-{cut[1]:012d}.json"


def _read_part(path: pathlib.Path, cut: Cut) -> Block:
    try:
        part = json.loads(path.read_text(encoding="utf-8"))
        if part["episodes"] != list(cut):
            raise ValueError(f"it says episodes {part['episodes']}")
        rows = part["methods"].items()
        return int(part["proven"]), {name: tally.from_json(row) for name, row in rows}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{path} is damaged ({error}); delete it, and it is computed again"
        ) from None


def _total(
    plan: Plan,
    episodes: int,
    folder: pathlib.Path,
    cuts: list[Cut],
    report: Progress,
) -> Summary:
    """All parts of a folder added up."""

    def read(number: int) -> Block:
        report("parts added up", number, len(cuts))
        return _read_part(_path(folder, cuts[number]), cuts[number])

    proven, totals = _added(map(read, range(len(cuts))))
    facts = plan.source.draw(plan.dataset, plan.seed, 0, 1).facts()
    rows = []
    for method, checkpoint in rows_of(plan.methods, plan.checkpoints):
        own = totals[_key(method, checkpoint)]
        numbers = {"label": label_of(method, plan.num)}
        numbers |= tally.summary(own, totals["random"])
        rows.append(Row(method, checkpoint, numbers))
    note = (
        "means and hit rates are of exact sums over all episodes; medians are read off "
        f"a histogram of log det S with bins of 1/{BINS_PER_UNIT}"
    )
    facts |= {"episodes": episodes}
    return Summary(facts, plan.k, plan.seed, proven, tuple(rows), notes=(note,))
