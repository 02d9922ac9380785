"""Selection methods on the same candidate sets, against the proven optimum.

Every method is judged by what it returned: log det S is computed here, from the
indices, in the unit of the dataset's candidates. Random is drawn many times an episode;
each draw counts as one selection in its statistics.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.parameters import estimate_parameters
from jaxcal.evaluation.results import Evaluation, MethodResult
from jaxcal.information.regression import log_det_gram

__all__ = [
    "BASELINES",
    "DEFAULT_METHODS",
    "DEFAULT_RANDOM_DRAWS",
    "check_methods",
    "evaluate",
    "evaluate_policies",
    "label_of",
]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Progress = Callable[[str, int, int], None]
"""label, selections done, selections in all"""

BASELINES = ("random", "greedy", "exchange", "exact")
DECODINGS = ("greedy", "samples", "first", "exchange")
POLICIES = ("policy", "policy:samples", "policy:first", "policy:exchange")
DEFAULT_METHODS = (*POLICIES, *BASELINES)
METHODS = (*DEFAULT_METHODS, "auto")
DEFAULT_RANDOM_DRAWS = 100

_LEARNED = (*POLICIES, "auto")  # what a checkpoint matters to
_CHUNK = 250  # episodes between two reports of progress
_CHUNK_EXACT = 50  # the slow one for k above n + 1
_REDRAWS = 20


def label_of(method: str, num: int = 16) -> str:
    """A method in words, as in the table."""
    return {
        "policy:samples": f"policy best of {num} samples",
        "policy:first": f"policy best of {num} first picks",
        "policy:exchange": "policy + exchange",
    }.get(method, method)


def check_methods(methods: Sequence[str]) -> tuple[str, ...]:
    """The methods by their one name each, without repeats.

    ``policy:greedy`` is ``policy``; ``policy:all`` is the policy under every decoding.

    Raises:
        ValueError: naming the one that is unknown, or that there is none.
    """
    chosen: list[str] = []
    for name in methods:
        if name == "policy:all":
            chosen += POLICIES
        elif name == "policy:greedy":
            chosen.append("policy")
        elif name in METHODS:
            chosen.append(name)
        else:
            known = ", ".join((*METHODS, "policy:all"))
            raise ValueError(f"method must be one of {known}, got {name!r}")
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
) -> Evaluation:
    """Run methods on a dataset and judge them against the proven optimum.

    Args:
        dataset: candidate sets.
        k: postures to choose in each episode.
        methods: names from ``DEFAULT_METHODS``, or "auto".
        checkpoints: of the policy; None is the one that ships.
        num: decodings tried by ``policy:samples`` and ``policy:first``.
        random_draws: random selections an episode.
        seed: of everything drawn at random.
        time_limit: seconds for the exact solver over the whole dataset; episodes not
            proven by then are judged against an upper bound.
        progress: called as selections are made.

    Raises:
        ValueError: naming the dataset and what is wrong with it, k or a method.
        OSError: a checkpoint cannot be read.
    """
    methods = check_methods(methods)
    for name, value in (("num", num), ("random_draws", random_draws)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    _check(dataset, k)
    run = _Run(dataset, k, num, seed, progress or (lambda *_: None))
    found: dict[tuple[str, str | None], MethodResult] = {}
    for method in methods:
        for checkpoint in checkpoints if method in _LEARNED else ():
            if method == "auto":
                found[method, checkpoint] = run.auto(checkpoint)
            else:
                found[method, checkpoint] = run.policy(method, checkpoint)
    random = run.random(random_draws)
    exact, reference, proven = run.exact(time_limit)
    found["random", None] = random
    found["exact", None] = exact
    for method in methods:
        if method in ("greedy", "exchange"):
            found[method, None] = run.baseline(method)
    results = [
        found[method, checkpoint]
        for method in methods
        for checkpoint in (checkpoints if method in _LEARNED else (None,))
    ]
    return Evaluation(
        dataset=dataset,
        k=k,
        seed=seed,
        results=tuple(results),
        reference=reference,
        proven=proven,
        random_log_det=random.log_det,
    )


def evaluate_policies(
    dataset: Dataset,
    k: int,
    policies: Sequence[tuple[str, str | None]],
    *,
    num: int = 16,
    seed: int = 0,
) -> dict[tuple[str, str | None], MethodResult]:
    """The (method, checkpoint) rows that policies have in ``evaluate``, alone.

    Args:
        dataset, k, num, seed: see ``evaluate``.
        policies: methods from ``POLICIES`` with their checkpoints.
    """
    run = _Run(dataset, k, num, seed, lambda *_: None)
    return {
        (method, checkpoint): run.policy(method, checkpoint)
        for method, checkpoint in policies
    }


def _check(dataset: Dataset, k: int) -> None:
    from jaxcal.selection import make_problems

    try:
        make_problems(dataset.candidates, k, available=dataset.available)
    except ValueError as error:
        raise ValueError(f"{dataset.name}: {error}") from None


class _Run:
    """The methods on one dataset, timed."""

    def __init__(
        self, dataset: Dataset, k: int, num: int, seed: int, progress: Progress
    ) -> None:
        self.dataset = dataset
        self.k = k
        self.num = num
        self.seed = seed
        self.progress = progress

    def result(
        self,
        method: str,
        indices: Indices,
        seconds: float,
        checkpoint: str | None = None,
        log_det: Array | None = None,
    ) -> MethodResult:
        """Judge (E, R, k) indices, unless their (E, R) ``log_det`` is known."""
        return MethodResult(
            method=method,
            label=label_of(method, self.num),
            checkpoint=checkpoint,
            indices=indices,
            log_det=self.log_det(indices) if log_det is None else log_det,
            seconds=seconds,
            parameters=estimate_parameters(self.dataset, indices),
        )

    def log_det(self, indices: Indices) -> Array:
        """(E, R) natural log det S of (E, R, k) indices."""
        gram = np.empty(indices.shape[:2])
        for begin in range(0, len(indices), _CHUNK):
            cut = slice(begin, begin + _CHUNK)
            gram[cut] = _log_det_gram(self.dataset.candidates[cut], indices[cut])
        return self.dataset.num_outputs * gram

    def pieces(self, label: str, size: int = _CHUNK) -> Any:
        """Slices of episodes, reporting progress between them."""
        total = self.dataset.num_episodes
        for begin in range(0, total, size):
            end = min(begin + size, total)
            yield slice(begin, end)
            self.progress(label, end, total)

    def part(self, cut: slice) -> dict[str, Any]:
        """Candidates and mask of some episodes."""
        available = self.dataset.available
        return {
            "candidates": self.dataset.candidates[cut],
            "available": None if available is None else available[cut],
        }

    def policy(self, method: str, checkpoint: str | None) -> MethodResult:
        """One decoding of one checkpoint."""
        from jaxcal.selection.policy import select_batch

        label = label_of(method, self.num)
        if checkpoint is not None:
            label = f"{label} ({checkpoint})"
        count = self.dataset.num_episodes

        def choose(cut: slice) -> Indices:
            return select_batch(
                k=self.k,
                decoding=method.partition(":")[2] or "greedy",
                num=self.num,
                seed=self.seed + cut.start,
                checkpoint=checkpoint,
                **self.part(cut),
            )

        self.progress(label, 0, count)
        choose(slice(0, min(_CHUNK, count)))  # compiles
        chosen, seconds = [], 0.0
        for cut in self.pieces(label):
            start = time.perf_counter()
            chosen.append(choose(cut))
            seconds += time.perf_counter() - start
        indices = np.concatenate(chosen)
        self.require_valid(label, indices)
        return self.result(method, indices[:, None], seconds / len(indices), checkpoint)

    def auto(self, checkpoint: str | None) -> MethodResult:
        """The policy where it proves good enough, else the optimum, one by one."""
        from jaxcal.selection import select

        label = "auto" if checkpoint is None else f"auto ({checkpoint})"
        part = self.part(slice(None))
        masks = part["available"]
        chosen, seconds = [], 0.0
        for cut in (slice(0, 1), *self.pieces(label)):  # the first compiles
            for i in range(cut.start, cut.stop):
                found = select(
                    part["candidates"][i],
                    self.k,
                    "auto",
                    available=None if masks is None else masks[i],
                    num_outputs=self.dataset.num_outputs,
                    seed=self.seed,
                    checkpoint=checkpoint,
                )
                chosen.append(found.indices)
                seconds += found.seconds if len(chosen) > 1 else 0.0
        indices = np.array(chosen[1:])
        return self.result("auto", indices[:, None], seconds / len(indices), checkpoint)

    def require_valid(self, label: str, indices: Indices) -> None:
        """A policy is trained, not proven: look at what it returned."""
        expected = (self.dataset.num_episodes, self.k)
        if indices.shape != expected:
            raise ValueError(f"{label} must return {expected}, got {indices.shape}")
        ordered = np.sort(indices, axis=1)
        bad = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
        bad |= (ordered[:, 0] < 0) | (ordered[:, -1] >= self.dataset.num_candidates)
        if not bad.any() and self.dataset.available is not None:
            bad = ~np.take_along_axis(self.dataset.available, indices, 1).all(axis=1)
        if bad.any():
            episode = int(np.flatnonzero(bad)[0])
            raise ValueError(
                f"{label} must choose {self.k} distinct available candidates, got "
                f"{indices[episode].tolist()} in episode {episode}"
            )

    def baseline(self, method: str) -> MethodResult:
        """Greedy or exchange."""
        from jaxcal import selection

        solve: Any = {
            "greedy": selection.greedy_batch,
            "exchange": selection.exchange_batch,
        }[method]
        options = {"seed": self.seed} if method == "exchange" else {}
        solve(k=self.k, **self.part(slice(0, 1)), **options)  # compiles
        chosen, seconds = [], 0.0
        for cut in self.pieces(method):
            batch = solve(k=self.k, **self.part(cut), **options)
            chosen.append(batch.indices)
            seconds += batch.seconds
        indices = np.concatenate(chosen)[:, None]
        return self.result(method, indices, seconds / len(indices))

    def exact(
        self, time_limit: float | None
    ) -> tuple[MethodResult, Array, NDArray[np.bool_]]:
        """The optimum, its log det S or an upper bound, and where it is proven."""
        from jaxcal.selection import exact_batch

        m = self.dataset.num_outputs
        exact_batch(
            k=self.k, **self.part(slice(0, 1)), time_limit=time_limit
        )  # compiles
        chosen, bounds, proofs = [], [], []
        seconds = 0.0
        for cut in self.pieces("exact", _CHUNK_EXACT):
            left = None if time_limit is None else max(time_limit - seconds, 1e-3)
            batch = exact_batch(
                k=self.k, **self.part(cut), num_outputs=m, time_limit=left
            )
            chosen.append(batch.indices)
            bounds.append(batch.bound)
            proofs.append(batch.proven)
            seconds += batch.seconds
        indices = np.concatenate(chosen)[:, None]
        result = self.result("exact", indices, seconds / len(indices))
        proven = np.concatenate(proofs)
        bound = np.maximum(np.concatenate(bounds), result.log_det[:, 0])
        return result, np.where(proven, result.log_det[:, 0], bound), proven

    def random(self, draws: int) -> MethodResult:
        """``draws`` selections an episode, uniform among the invertible ones."""
        from jaxcal.selection import random_batch

        timed = random_batch(k=self.k, **self.part(slice(None)), seed=self.seed)
        count, size = self.dataset.num_episodes, self.dataset.num_candidates
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(0,)))
        available = self.dataset.available
        chosen, grams = [], []
        for cut in self.pieces("random"):
            mask = None if available is None else available[cut]
            shape = (min(cut.stop, count) - cut.start, draws, size)
            picks = _draw(rng, shape, self.k, mask)
            grams.append(self._without_singular(rng, cut, picks, mask))
            chosen.append(picks)
        return self.result(
            "random",
            np.concatenate(chosen),
            timed.seconds / count,
            log_det=self.dataset.num_outputs * np.concatenate(grams),
        )

    def _without_singular(
        self,
        rng: np.random.Generator,
        cut: slice,
        picks: Indices,
        mask: NDArray[np.bool_] | None,
    ) -> Array:
        """Draw the singular ones again; the few that stay so are left to the solver.

        Args:
            rng: source of the draws.
            cut: the episodes.
            picks: (E, R, k), mended in place.
            mask: (E, M) available candidates.

        Returns:
            (E, R) log det of the Gram matrices of what is then in ``picks``.
        """
        from jaxcal.selection import random_batch

        candidates = self.dataset.candidates[cut]
        gram = _log_det_gram(candidates, picks)
        for attempt in range(_REDRAWS + 1):
            episode, draw = np.nonzero(np.isneginf(gram))
            if not episode.size:
                break
            sets = candidates[episode]
            again = None if mask is None else mask[episode]
            if attempt < _REDRAWS:
                shape = (len(episode), 1, candidates.shape[1])
                fresh = _draw(rng, shape, self.k, again)
            else:
                batch = random_batch(sets, self.k, available=again, seed=self.seed)
                fresh = batch.indices[:, None]
            picks[episode, draw] = fresh[:, 0]
            gram[episode, draw] = _log_det_gram(sets, fresh)[:, 0]
        return gram


def _log_det_gram(candidates: Array, indices: Indices) -> Array:
    """(E, R) log det of Z.T Z for (E, R, k) indices into (E, M, n) candidates."""
    chosen = np.take_along_axis(candidates[:, None], indices[..., None], axis=2)
    return log_det_gram(chosen)


def _draw(
    rng: np.random.Generator,
    shape: tuple[int, int, int],
    k: int,
    mask: NDArray[np.bool_] | None,
) -> Indices:
    """(E, R, k) distinct candidates out of (E, R, M), uniform among the available."""
    order = rng.random(shape)
    if mask is not None:
        order[np.broadcast_to(~mask[:, None], shape)] = 2.0
    if k == shape[2]:
        return np.argsort(order, axis=2)
    return np.argpartition(order, k - 1, axis=2)[..., :k]
