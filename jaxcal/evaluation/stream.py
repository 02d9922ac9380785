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
import json
import pathlib
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
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
        for method in self.methods:
            if method not in DEFAULT_METHODS:
                raise ValueError(
                    "a streamed method must be one of "
                    f"{', '.join(DEFAULT_METHODS)}, got {method!r}"
                )
        first = self.source.draw(self.dataset, self.seed, 0, 1)
        if not first.num_inputs < self.k < first.num_candidates:
            raise ValueError(
                f"k must be in [{first.num_inputs + 1}, {first.num_candidates}), "
                f"got {self.k}"
            )

    def description(self) -> dict[str, Any]:
        """What ``stream.json`` says: equal for folders whose parts add up."""
        names = [field.name for field in dataclasses.fields(self)]
        values = {name: getattr(self, name) for name in names if name != "source"}
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
    block = plan.source.block
    if part < 1 or part % block:
        raise ValueError(f"part must be a multiple of {block} episodes, got {part}")
    report = progress or (lambda *_: None)
    workers = num_cores() if workers is None else workers
    cuts = [(begin, min(begin + part, episodes)) for begin in range(0, episodes, part)]
    own = [
        cut for cut in cuts[process[0] :: process[1]] if not _path(folder, cut).exists()
    ]
    todo = sum(end - begin for begin, end in own)
    ahead = 1 + 2 * workers * block // part  # parts that keep the workers busy
    done = 0
    report("episodes", 0, todo)
    with worker_pool(workers) as executor:
        for cut, blocks in _begun(plan, own, executor, ahead):
            text = json.dumps(_added(cut, blocks), separators=(",", ":"))
            write_text(_path(folder, cut), text + "\n")
            done += cut[1] - cut[0]
            report("episodes", done, todo)
    while not all(_path(folder, cut).exists() for cut in cuts):
        time.sleep(_POLL_SECONDS)
    return _total(plan, episodes, folder, cuts, report)


# -- one part --------------------------------------------------------------------------


def _solve_block(plan: Plan, begin: int, end: int) -> tuple[int, dict[str, Tally]]:
    """Proven optima and the tally of every row, of the episodes of one stream."""
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


Block = Future[tuple[int, dict[str, Tally]]]


def _begun(
    plan: Plan, cuts: list[Cut], executor: Executor, ahead: int
) -> Iterator[tuple[Cut, list[Block]]]:
    """Every part with its blocks, some parts begun ahead of the one in hand."""
    waiting: collections.deque[tuple[Cut, list[Block]]] = collections.deque()
    size = plan.source.block
    for cut in cuts:
        blocks = [
            executor.submit(_solve_block, plan, begin, min(begin + size, cut[1]))
            for begin in range(*cut, size)
        ]
        waiting.append((cut, blocks))
        if len(waiting) > ahead:
            yield waiting.popleft()
    yield from waiting


def _added(cut: Cut, blocks: list[Block]) -> dict[str, Any]:
    """What a part adds to the totals, as its file holds it."""
    proven = 0
    methods: dict[str, Tally] = collections.defaultdict(dict)
    for block in blocks:
        try:
            count, tallies = block.result()
        except BrokenProcessPool:
            raise OSError(
                "a worker process died, perhaps because memory ran out: use fewer "
                "(--workers)"
            ) from None
        proven += count
        for name, row in tallies.items():
            tally.add(methods[name], row)
    rows = {name: tally.as_json(row) for name, row in methods.items()}
    return {"episodes": list(cut), "proven": proven, "methods": rows}


def _key(method: str, checkpoint: str | None) -> str:
    return method if checkpoint is None else f"{method} {checkpoint}"


# -- the folder ------------------------------------------------------------------------


def _path(folder: pathlib.Path, cut: Cut) -> pathlib.Path:
    return folder / f"part-{cut[0]:012d}-{cut[1]:012d}.json"


def _total(
    plan: Plan,
    episodes: int,
    folder: pathlib.Path,
    cuts: list[Cut],
    report: Progress,
) -> Summary:
    """All parts of a folder added up."""
    proven = 0
    totals: dict[str, Tally] = collections.defaultdict(dict)
    for number, cut in enumerate(cuts):
        report("parts added up", number, len(cuts))
        path = _path(folder, cut)
        try:
            part = json.loads(path.read_text(encoding="utf-8"))
            if part["episodes"] != list(cut):
                raise ValueError(f"it says episodes {part['episodes']}")
            proven += int(part["proven"])
            for name, row in part["methods"].items():
                tally.add(totals[name], tally.from_json(row))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(
                f"{path} is damaged ({error}); delete it, and it is computed again"
            ) from None
    facts = plan.source.draw(plan.dataset, plan.seed, 0, 1).facts()
    return Summary(
        dataset=facts | {"episodes": episodes},
        k=plan.k,
        seed=plan.seed,
        num_proven=proven,
        rows=tuple(
            Row(
                method,
                checkpoint,
                {"label": label_of(method, plan.num)}
                | tally.summary(totals[_key(method, checkpoint)], totals["random"]),
            )
            for method, checkpoint in rows_of(plan.methods, plan.checkpoints)
        ),
        notes=(
            "means and hit rates are of exact sums over all episodes; medians are read "
            f"off a histogram of log det S with bins of 1/{BINS_PER_UNIT}",
        ),
    )
