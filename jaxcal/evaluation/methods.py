"""Selection methods on the same candidate sets, against the proven optimum.

Every method is judged by what it returned: log det S is computed here, from the
indices. Random is drawn many times an episode; each draw counts as one selection.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from jaxcal import selection
from jaxcal.checks import Array, Indices, one_of, whole_number
from jaxcal.deadline import Deadline
from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.report import (
    Column,
    Evaluation,
    MethodResult,
    Summary,
    finite,
    moments,
)
from jaxcal.information.regression import log_det_gram
from jaxcal.models.linear import Affine
from jaxcal.selection.problem import make_problems

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
}
POLICIES = tuple(name for name in METHODS if name.startswith("policy"))
BASELINES = ("random", "greedy", "exchange", "exact")
DEFAULT_METHODS = (*POLICIES, *BASELINES)
DEFAULT_RANDOM_DRAWS = 100

HIT_TOLERANCE = 1e-9  # of log det(Z.T Z): the same determinant to a billionth
_CHUNK = 250  # episodes between two reports of progress
_CHUNK_EXACT = 50  # exact is slow for k above n + 1


def check_methods(methods: Sequence[str]) -> tuple[str, ...]:
    """The methods without repeats; one that is unknown, or none, is refused."""
    if not methods:
        raise ValueError("methods must name at least one method, got none")
    return tuple(dict.fromkeys(one_of("method", name, [*METHODS]) for name in methods))


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
    whole_number("num", num, 1)
    whole_number("random_draws", random_draws, 1)
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
        for begin in range(0, total, size):
            cut = slice(begin, min(begin + size, total))
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

        choose(slice(0, _CHUNK))  # not timed: it may compile
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
        """Greedy or exchange."""

        def choose(cut: slice) -> Indices:
            if method == "greedy":
                return selection.greedy_batch(**self.part(cut)).indices
            return selection.exchange_batch(**self.part(cut), seed=self.seed).indices

        choose(slice(0, 1))  # not timed: it may load a kernel
        choices, seconds = self.timed(method, choose)
        return self.result(method, np.concatenate(choices)[:, None], seconds)

    def exact(
        self, time_limit: float | None
    ) -> tuple[PostureResult, Array, NDArray[np.bool_]]:
        """The optimum, its (E,) log det S or an upper bound, and (E,) where proven."""
        m = self.dataset.num_outputs

        def choose(cut: slice) -> Any:
            limit_s = None if time_limit is None else max(deadline.remaining_s, 1e-3)
            part = self.part(cut)
            return selection.exact_batch(**part, num_outputs=m, time_limit=limit_s)

        deadline = Deadline(time_limit or 0.0)
        choose(slice(0, 1))  # not timed: it may load a kernel
        deadline = Deadline(time_limit or 0.0)
        batches, seconds = self.timed("exact", choose, _CHUNK_EXACT)
        indices, proven, bound = (
            np.concatenate([getattr(batch, name) for batch in batches])
            for name in ("indices", "proven", "bound")
        )
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
    """(E, R, k) selections, R = ``num`` an episode, uniform among the invertible ones,
    and their (E, R) log det(Z.T Z)."""
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


# -- what is shown ---------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PostureResult(MethodResult):
    """What one method chose in every episode of a dataset."""

    indices: Indices  # (E, R, k)
    parameters: Array | None  # (E, R, m (n + 1)) identified from the chosen postures

    @property
    def log_det(self) -> Array:  # (E, R)
        return self.values


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PostureEvaluation(Evaluation):
    """All methods on one dataset, selection by selection; ``reference`` (E,) is log det
    S* where proven, else an upper bound on it."""

    title: ClassVar[str] = "Posture selection compared with the proven optimum"
    about: ClassVar[str] = (
        "det S is in the unit of the dataset's commands. S is the information matrix "
        "AᵀA of the chosen postures, S* that of the best choice. Hit rate: share of "
        "selections whose determinant equals the optimum's within 1e-9. D-eff.: mean "
        "of (det S / det S*)^(1/p), p parameters. x random: mean det S divided by that "
        "of random selection. Time: per selection, averaged over the batch."
    )

    dataset: Dataset
    k: int  # postures chosen
    results: tuple[PostureResult, ...]
    proven: NDArray[np.bool_]  # (E,)
    random_log_det: Array  # (E, R) the baseline behind ratio_to_random

    def summarise(self, *, indices: bool = False) -> Summary:
        """The numbers of every method; with ``indices`` also what each chose in every
        episode (random: its first draw)."""
        rows, data = self.rows(), self.dataset
        if indices:
            for row, result in zip(rows, self.results, strict=True):
                row.numbers["indices"] = result.indices[:, 0].tolist()
        k, m, n = self.k, data.num_outputs, data.num_inputs
        seed = "" if data.seed is None else f", seed {data.seed}"
        heading = (
            f"{data.name}{seed}: {data.num_episodes:,} episodes, {k} of "
            f"{data.num_candidates} postures, {n} inputs, {m} outputs"
        )
        notes = []
        if unproven := int((~self.proven).sum()):
            notes.append(
                f"{unproven} of {data.num_episodes} optima are not proven. There an "
                "upper bound replaces det S*: true ratios and efficiencies are at "
                "least those shown, and no selection counts as a hit"
            )
        if k == n + 1:
            notes.append(
                f"k = {k} fits {k * m} parameters with as many equations: no residual, "
                "so the noise cannot be estimated; use a larger k"
            )
        facts: dict[str, Any] = {"dataset": data.facts(), "k": k, "seed": self.seed}
        facts |= {"criterion": "D"}
        if data.measured is not None:
            facts["parameter_names"] = list(Affine(n, m).names)
        facts |= {"proven": float(self.proven.mean()), "notes": notes}
        return Summary(data.name, heading, _COLUMNS, rows, facts, tuple(notes))

    def summary(self, result: PostureResult) -> dict[str, Any]:
        """The numbers of one method, as documented in docs/evaluation.md."""
        m = self.dataset.num_outputs
        behind = self.less(result)
        hits = self.proven[:, None] & (behind >= -HIT_TOLERANCE * m)
        behind = np.minimum(behind, 0.0)
        efficiency = np.exp(behind / (m * (self.dataset.num_inputs + 1)))
        with np.errstate(over="ignore"):
            det = np.exp(result.log_det)
            times = np.exp(log_mean(result.log_det) - log_mean(self.random_log_det))
        row: dict[str, Any] = {
            "label": result.label,
            "det_s": moments(det),
            "log_det_s": moments(result.log_det),
            "ratio_to_exact": float(np.exp(behind).mean()),
            "hit_rate": float(hits.mean()),
            "d_efficiency": float(efficiency.mean()),
            "ratio_to_random": finite(times),
            "seconds_per_selection": result.seconds,
            "draws_per_episode": result.log_det.shape[1],
        }
        if result.parameters is not None:
            # Of several draws an episode the median: that of random has a heavy tail.
            variance = np.median(result.parameters.var(axis=0), axis=0)
            row["parameter_variance"] = variance.tolist()
        return row


def log_mean(log_values: Array) -> float:
    """Log of the mean of exp, without overflow."""
    return float(logsumexp(log_values) - np.log(log_values.size))


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _share(value: float) -> str:
    """Four decimals, and never 1.0000 for what is below it."""
    text = f"{value:.4f}"
    return "0.9999+" if text == "1.0000" and value < 1.0 - 1e-12 else text


def _time(seconds: float) -> str:
    units = {"s": 1.0, "ms": 1e-3, "µs": 1e-6}
    unit = next((unit for unit, size in units.items() if seconds >= size), "µs")
    return f"{seconds / units[unit]:.3g} {unit}"


_COLUMNS: tuple[Column, ...] = (
    ("method", lambda row: row.numbers["label"]),
    ("mean det S", lambda row: _or_dash(row.numbers["det_s"]["mean"], ".4g")),
    ("median det S", lambda row: _or_dash(row.numbers["det_s"]["median"], ".4g")),
    ("det S/det S*", lambda row: _share(row.numbers["ratio_to_exact"])),
    ("hit rate", lambda row: _share(row.numbers["hit_rate"])),
    ("D-eff.", lambda row: _share(row.numbers["d_efficiency"])),
    ("x random", lambda row: _or_dash(row.numbers["ratio_to_random"], ",.0f")),
    ("time each", lambda row: _time(row.numbers["seconds_per_selection"])),
)


def estimate_parameters(dataset: Dataset, indices: Indices) -> Array | None:
    """(E, R, m (n + 1)) least-squares parameters of selections (E, R, k), A row by row,
    then b, in the unit of ``dataset.ranges`` where it has one, else of the candidates;
    None where nothing was measured."""
    if dataset.measured is None:
        return None
    commands = dataset.candidates
    if dataset.ranges is not None:
        commands = dataset.ranges.denormalise(commands)
    gather = indices[..., None]
    u = np.take_along_axis(commands[:, None], gather, axis=2)
    y = np.take_along_axis(dataset.measured[:, None], gather, axis=2)
    return least_squares(u, y)


def least_squares(commands: Array, measured: Array) -> Array:
    """(..., m (n + 1)) A row by row, then b, of many sets of postures at once:
    ``commands`` (..., N, n), N > n and of full rank, ``measured`` (..., N, m)."""
    mean_u = commands.mean(axis=-2, keepdims=True)
    mean_y = measured.mean(axis=-2, keepdims=True)
    q, r = np.linalg.qr(commands - mean_u)
    slopes = np.linalg.solve(r, np.matrix_transpose(q) @ (measured - mean_y))
    biases = (mean_y - mean_u @ slopes)[..., 0, :]
    matrix = np.matrix_transpose(slopes)
    return np.concatenate([matrix.reshape(*biases.shape[:-1], -1), biases], axis=-1)
