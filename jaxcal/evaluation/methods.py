"""Selection methods on the same candidate sets, against the proven optimum.

Every method is judged by what it returned: log det S is computed here, from the
indices. Random is drawn many times an episode; each draw counts as one selection.

``evaluate_stream`` evaluates any number of episodes. The rows of a part are a file of
its own. So a stopped run resumes, more episodes start from what is there, and processes
that see the folder share the work; none of that changes a digit, because the same parts
are averaged in the same order.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import pathlib
import random
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from jaxcal import selection
from jaxcal.checks import Array
from jaxcal.deadline import NEVER, Deadline
from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.postures import (
    PostureEvaluation,
    PostureResult,
    estimate_parameters,
    summary_of,
)
from jaxcal.evaluation.report import MethodNumbers, Summary, finite
from jaxcal.extras import versions
from jaxcal.files import write_text
from jaxcal.information.regression import log_det_gram
from jaxcal.models.affine import Affine
from jaxcal.selection.problem import make_problems

Indices = NDArray[np.int64]
T = TypeVar("T")
Progress = Callable[[str, int, int], None]
"""label, selections done, selections in all"""

METHODS = {  # each with its label in the table
    "policy": "policy",
    "policy:samples": "policy best of {num} samples",
    "policy:first": "policy best of {num} first picks",
    "policy:exchange": "policy + exchange",
    "random": "random",
    "greedy": "greedy",
    "exchange": "exchange",
    "exact": "exact",
    "auto": "auto",
}
POLICIES = tuple(name for name in METHODS if name.startswith("policy"))
BASELINES = ("random", "greedy", "exchange", "exact")
DEFAULT_METHODS = (*POLICIES, *BASELINES)
DEFAULT_RANDOM_DRAWS = 100

_CHUNK = 250  # episodes between two reports of progress
_CHUNK_EXACT = 50  # exact is slow for k above n + 1
PART = 5_000  # episodes whose rows are one file; the draws' blocks of 1,000 divide it
_MEANS = ("ratio_to_exact", "hit_rate", "d_efficiency", "seconds_per_selection")


def check_methods(methods: Sequence[str]) -> tuple[str, ...]:
    """The methods by their one name each, without repeats.

    ``policy:greedy`` is ``policy``; ``policy:all`` is the policy under every decoding.

    Raises:
        ValueError: naming the one that is unknown, or that there is none.
    """
    several = {"policy:all": POLICIES, "policy:greedy": ("policy",)}
    chosen: list[str] = []
    for name in methods:
        if name not in METHODS and name not in several:
            names = ", ".join((*METHODS, "policy:all"))
            raise ValueError(f"method must be one of {names}, got {name!r}")
        chosen += several.get(name, (name,))
    if not chosen:
        raise ValueError("methods must name at least one method, got none")
    return tuple(dict.fromkeys(chosen))


def evaluate(
    dataset: Dataset,
    k: int = 4,
    methods: Sequence[str] = DEFAULT_METHODS,
    checkpoints: Sequence[str | None] = (None,),
    *,
    num: int = 16,
    random_draws: int = DEFAULT_RANDOM_DRAWS,
    seed: int = 0,
    time_limit: float | None = None,
    progress: Progress | None = None,
) -> PostureEvaluation:
    """Run methods on a dataset and judge them against the proven optimum.

    Args:
        dataset: candidate sets.
        k: postures to choose in each episode.
        methods: names from ``METHODS``.
        checkpoints: of the policy; None is the one that ships.
        num: decodings tried by ``policy:samples`` and ``policy:first``.
        random_draws: random selections an episode.
        seed: of everything drawn at random.
        time_limit: seconds for the exact solver over the whole dataset; episodes not
            proven by then are judged against an upper bound.
        progress: called as selections are made.
    """
    methods = check_methods(methods)
    for name, value in (("num", num), ("random_draws", random_draws)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    try:
        make_problems(dataset.candidates, k, available=dataset.available)
    except ValueError as error:
        raise ValueError(f"{dataset.name}: {error}") from None
    run = _Run(dataset, k, num, seed, progress or (lambda *_: None))
    rows = [  # a policy has one for each checkpoint
        (method, checkpoint)
        for method in methods
        for checkpoint in (checkpoints if method in POLICIES else (None,))
    ]
    results = {row: run.policy(*row) for row in rows if row[0] in POLICIES}
    results["random", None] = random = run.random(random_draws)
    results["exact", None], reference, proven = run.exact(time_limit)
    results |= {row: run.solver(row[0]) for row in rows if row not in results}
    return PostureEvaluation(
        dataset=dataset,
        k=k,
        seed=seed,
        results=tuple(results[row] for row in rows),
        reference=reference,
        proven=proven,
        random_log_det=random.log_det,
    )


@dataclasses.dataclass(frozen=True)
class _Run:
    """The methods on one dataset, timed."""

    dataset: Dataset
    k: int
    num: int
    seed: int
    progress: Progress

    def result(
        self,
        method: str,
        indices: Indices,
        seconds: float,
        checkpoint: str | None = None,
        gram: Array | None = None,
    ) -> PostureResult:
        """Judge (E, R, k) indices, unless their (E, R) log det of Z.T Z is known."""
        if gram is None:
            gram = log_det_gram_of(self.dataset.candidates, indices)
        return PostureResult(
            method=method,
            label=METHODS[method].format(num=self.num),
            checkpoint=checkpoint,
            indices=indices,
            values=self.dataset.num_outputs * gram,
            seconds=seconds / self.dataset.num_episodes,
            parameters=estimate_parameters(self.dataset, indices),
        )

    def pieces(self, size: int = _CHUNK) -> list[slice]:
        """All episodes in slices of at most ``size``."""
        total = self.dataset.num_episodes
        return [slice(i, min(i + size, total)) for i in range(0, total, size)]

    def part(self, cut: slice) -> dict[str, Any]:
        """What every solver is given of some episodes."""
        mask = self.dataset.available
        mask = None if mask is None else mask[cut]
        candidates = self.dataset.candidates[cut]
        return {"candidates": candidates, "k": self.k, "available": mask}

    def timed(
        self, label: str, choose: Callable[[slice], T], size: int = _CHUNK
    ) -> tuple[list[T], float]:
        """What ``choose`` returns for every piece, and the seconds that took."""
        total = self.dataset.num_episodes
        self.progress(label, 0, total)
        choices, seconds = [], 0.0
        for cut in self.pieces(size):
            start = time.perf_counter()
            choices.append(choose(cut))
            seconds += time.perf_counter() - start
            self.progress(label, cut.stop, total)
        return choices, seconds

    def policy(self, method: str, checkpoint: str | None) -> PostureResult:
        from jaxcal.selection.policy import select_batch

        label = METHODS[method].format(num=self.num)
        label += "" if checkpoint is None else f" ({checkpoint})"

        def choose(cut: slice) -> Indices:
            return select_batch(
                **self.part(cut),
                decoding=method.partition(":")[2] or "greedy",
                num=self.num,
                seed=self.seed + cut.start,
                checkpoint=checkpoint,
            )

        choose(self.pieces()[0])  # not timed: it may compile
        choices, seconds = self.timed(label, choose)
        indices = np.concatenate(choices)
        self.require_valid(label, indices)
        return self.result(method, indices[:, None], seconds, checkpoint)

    def require_valid(self, label: str, indices: Indices) -> None:
        """A policy is trained, not proven: check what it returned."""
        free = self.dataset.available
        if free is None:
            free = np.ones(self.dataset.candidates.shape[:2], bool)
        kept, within = free.copy(), indices % free.shape[1]
        np.put_along_axis(kept, within, False, axis=1)
        bad = (within != indices).any(axis=1)
        bad |= (free & ~kept).sum(axis=1) != self.k
        for episode in np.flatnonzero(bad)[:1]:
            raise ValueError(
                f"{label} must choose {self.k} different available candidates, got "
                f"{indices[episode].tolist()} in episode {episode}"
            )

    def solver(self, method: str) -> PostureResult:
        """A method without proof and without weights."""

        def choose(cut: slice) -> Indices:
            part = self.part(cut)
            if method == "greedy":
                return selection.greedy_batch(**part).indices
            if method == "exchange":
                return selection.exchange_batch(**part, seed=self.seed).indices
            model = Affine(self.dataset.num_inputs, self.dataset.num_outputs)
            sets, masks = part["candidates"], part["available"]
            masks = [None] * len(sets) if masks is None else masks
            auto = functools.partial(
                selection.select, k=self.k, model=model, seed=self.seed
            )
            selections = [
                auto(u, available=m) for u, m in zip(sets, masks, strict=True)
            ]
            return np.array([selected.indices for selected in selections])

        choose(slice(0, 1))  # not timed: it may compile
        choices, seconds = self.timed(method, choose)
        return self.result(method, np.concatenate(choices)[:, None], seconds)

    def exact(
        self, time_limit: float | None
    ) -> tuple[PostureResult, Array, NDArray[np.bool_]]:
        """The optimum, its (E,) log det S or an upper bound, and (E,) where proven."""

        def choose(cut: slice) -> tuple[NDArray[Any], ...]:
            """(E, k) indices, (E,) proven, (E,) upper bounds."""
            limit_s = None if deadline is NEVER else max(deadline.remaining_s, 1e-3)
            m = self.dataset.num_outputs
            batch = selection.exact_batch(
                **self.part(cut), num_outputs=m, time_limit=limit_s
            )
            return batch.indices, batch.proven, batch.bound

        deadline = NEVER if time_limit is None else Deadline(time_limit)
        choose(slice(0, 1))  # not timed: it may compile
        deadline = NEVER if time_limit is None else Deadline(time_limit)
        batches, seconds = self.timed("exact", choose, _CHUNK_EXACT)
        indices, proven, bound = map(np.concatenate, zip(*batches, strict=True))
        result = self.result("exact", indices[:, None], seconds)
        reached = result.log_det[:, 0]
        return result, np.where(proven, reached, np.maximum(bound, reached)), proven

    def random(self, draws: int) -> PostureResult:
        """``draws`` selections an episode; the time is that of ``random_batch``."""
        batch = selection.random_batch(**self.part(slice(None)), seed=self.seed)
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(0,)))
        found, _ = self.timed(
            "random", lambda cut: draw_random(rng, **self.part(cut), num=draws)
        )
        picks, gram = map(np.concatenate, zip(*found, strict=True))
        return self.result("random", picks, batch.seconds, gram=gram)


def draw_random(
    rng: np.random.Generator,
    candidates: Array,
    available: NDArray[np.bool_] | None,
    k: int,
    num: int,
) -> tuple[Indices, Array]:
    """(E, R, k) selections, R = ``num`` an episode, and their (E, R) log det(Z.T Z).

    Uniform among the invertible ones; the solver draws the singular ones again.
    """
    shape = (len(candidates), num, candidates.shape[1])
    order = rng.random(shape)
    if available is not None:
        order[np.broadcast_to(~available[:, None], shape)] = 2.0
    picks = np.argpartition(order, k - 1, axis=2)[..., :k]
    gram = log_det_gram_of(candidates, picks)
    episode, draw = np.nonzero(np.isneginf(gram))
    if episode.size:
        sets, seed = candidates[episode], int(rng.integers(2**31))
        mask = None if available is None else available[episode]
        again = selection.random_batch(sets, k, available=mask, seed=seed).indices
        picks[episode, draw] = again
        gram[episode, draw] = log_det_gram_of(sets, again[:, None])[:, 0]
    return picks, gram


def log_det_gram_of(candidates: Array, indices: Indices) -> Array:
    """(E, R) log det of Z.T Z for (E, R, k) indices into (E, M, n) candidates."""
    return log_det_gram(
        np.take_along_axis(candidates[:, None], indices[..., None], axis=2)
    )


def evaluate_stream(
    draw: Callable[[int, int], Dataset],
    episodes: int,
    folder: pathlib.Path,
    plan: Mapping[str, Any],
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Summary:
    """Evaluate the first episodes of a dataset, resuming from the parts in a folder.

    Args:
        draw: (begin, end) -> episodes; ``begin`` is a multiple of 1,000.
        episodes: how many.
        folder: made where it is missing.
        plan: JSON values: ``dataset``, and the arguments of ``evaluate``, ``methods``
            and ``seed`` among them. Parts of another plan are refused.
        progress: called as parts are completed.
    """
    options = {name: value for name, value in plan.items() if name != "dataset"}
    options["methods"] = list(dict.fromkeys([*options["methods"], "random"]))

    def solve(begin: int, end: int) -> Summary:
        seed = options["seed"] + begin
        return evaluate(draw(begin, end), **options | {"seed": seed}).summarise()

    facts = solve(0, 1).facts  # what is wrong is said before anything is kept
    _open(folder, plan)
    cuts = [(begin, min(begin + PART, episodes)) for begin in range(0, episodes, PART)]
    files = {folder / f"part-{a:012d}-{b:012d}.json": (a, b) for a, b in cuts}
    todo = [path for path in files if not path.exists()]
    random.shuffle(todo)
    for number, path in enumerate(todo):
        progress("parts", number, len(todo))
        if not path.exists():  # no other process was sooner
            begin, end = files[path]
            part = solve(begin, end)
            kept = [(row.method, row.checkpoint, row.numbers) for row in part.rows]
            proven = round(part.facts["proven"] * (end - begin))
            write_text(path, json.dumps({"proven": proven, "rows": kept}))
    progress("parts", len(todo), len(todo))

    parts = [_read(path) for path in files]
    counts = [end - begin for begin, end in cuts]
    rows = []
    for i, (method, checkpoint, _) in enumerate(parts[0]["rows"]):
        numbers = total(counts, [part["rows"][i][2] for part in parts])
        rows.append(MethodNumbers(method, checkpoint, numbers))
    middle = {row.method: row.numbers["det_s"]["mean"] for row in rows}["random"]
    for row in rows:
        mean = row.numbers["det_s"]["mean"]
        row.numbers["ratio_to_random"] = mean / middle if mean and middle else None
    facts = {
        "dataset": facts["dataset"] | {"episodes": episodes},
        "k": options["k"],
        "seed": options["seed"],
        "criterion": "D",
    }
    asked = tuple(row for row in rows if row.method in plan["methods"])
    return summary_of(facts, asked, sum(part["proven"] for part in parts))


def total(counts: list[int], parts: list[dict[str, Any]]) -> dict[str, Any]:
    """One row of all parts, of ``counts`` episodes each; a number that one of their
    rows lacks is lacking."""

    def mean(values: Any) -> float:
        return float(np.average(np.array(values, float), weights=counts))  # None: NaN

    # Medians and variances of parts do not add up.
    row = {k: v for k, v in parts[0].items() if k != "parameter_variance"}
    for name in _MEANS:
        row[name] = finite(mean([part[name] for part in parts]))
    for name in ("det_s", "log_det_s"):
        held = [[part[name]["mean"], part[name]["std"]] for part in parts]
        middles, stds = np.array(held, float).T
        middle = mean(middles)
        std = math.sqrt(mean(stds**2 + (middles - middle) ** 2))
        row[name] = {"mean": finite(middle), "std": finite(std), "median": None}
    return row


def _open(folder: pathlib.Path, plan: Mapping[str, Any]) -> None:
    """Make sure that the parts in a folder add up with those of this plan."""
    weights = {}
    if set(plan["methods"]) & set(POLICIES):
        from jaxcal.learning.training.checkpoint import load

        for checkpoint in plan["checkpoints"]:
            weights[checkpoint or "default"] = load(checkpoint).weights.fingerprint
    head = {"format": "jaxcal-evaluation-stream", "version": 4, "part": PART}
    whole = {**head, **plan, "weights": weights, "versions": versions()}
    settings, path = json.loads(json.dumps(whole)), folder / "stream.json"
    folder.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        write_text(path, json.dumps(settings, indent=1) + "\n")
    held = _read(path)
    for name in (name for name in settings if held.get(name) != settings[name]):
        raise ValueError(
            f"{folder} holds parts of another evaluation: its {name} is "
            f"{held.get(name)!r}, not {settings[name]!r}; name another folder"
        )


def _read(path: pathlib.Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{path} is damaged ({error}). Delete it; it will be computed again"
        ) from None
