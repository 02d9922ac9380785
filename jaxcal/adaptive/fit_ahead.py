"""The constants of ``ahead`` for one task, from simulated sessions of that task.

Three things are found, in about a second on one core:

1. the constants of ``shares``, by the cross-entropy method;
2. hints: how often a tree of ``_DEEP`` multiplications per choice, too slow for use,
   makes each measurement first, second and so on;
3. which of these, and which ``doubt``, serve ``ahead``: every combination plays the
   same sessions, others than before, and one is taken if it beats ``AHEAD`` by a
   standard error. Where the tree then loses against ``SHARES`` the rule decides.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.lookahead import AHEAD, Ahead, tree
from jaxcal.adaptive.rules import SHARES, Shares
from jaxcal.adaptive.search_kernel import NODE, SUM
from jaxcal.adaptive.session import fingerprint
from jaxcal.adaptive.tuning import search

Array = NDArray[np.float32]

# Multiplications to simulate: each set of constants in a generation, the deep tree,
# each combination.
_TUNE, _PLAY, _TRY = 6e7, 1e10, 2e9
_DEEP = 2e7
_MOST, _LEAST = 512, 16  # sessions of one estimate
_OF_ALL, _POWER = 8.0, 0.25  # pseudo-counts of the mean share; hint = (A share)^.25
_HASTE = 0.3  # start of its search where time is not limited


def fit(
    task: GridTask,
    seconds: float | None = None,
    uses: int | None = None,
    seed: int = 0,
) -> Ahead | Shares:
    """``ahead`` with the constants that gain most on a task's own sessions, every
    design allowed, or ``SHARES`` where the tree loses against it.

    ``seconds`` and ``uses`` are the budget of the sessions, the task's when None. The
    same arguments give the same constants.
    """
    task = jax.device_get(task)
    budget = np.asarray(task.seconds if seconds is None else (seconds, seconds))
    ends = np.atleast_1d(task.num_uses if uses is None else uses)
    return _fit(_Task(fingerprint((task, budget, ends)), task, budget, ends), seed)


@dataclasses.dataclass(frozen=True)
class _Task:
    """A task and a budget to simulate; compared by ``key``, their hash."""

    key: str
    task: GridTask = dataclasses.field(compare=False)
    seconds: Any = dataclasses.field(compare=False)  # (2,)
    uses: Any = dataclasses.field(compare=False)  # (E,)

    def play(self, decider: Ahead, count: int, seed: int) -> tuple[Array, Any]:
        """(B, T) gains and choices, -1 after the end; the same truths for a seed."""
        task, horizon = self.task, self.task.horizon
        rng = np.random.default_rng(seed)
        at = (np.arange(count) + 0.5) / count  # stratified over the prior
        below = np.cumsum(task.prior, dtype=np.float64)
        truth = np.searchsorted(below, rng.permutation(at) * below[-1])
        low, high = self.seconds
        spread = high - low if np.isfinite(high) else 0.0
        gains = np.zeros((count, horizon), np.float32)
        chosen = np.full((count, horizon), -1, np.int32)
        tree(
            task.likelihood, task.travel, task.extra, task.uses, task.place_after,
            *task.limits, *decider.constants(), horizon, decider.effort,
        ).play(
            np.array(task.prior, np.float32), int(task.place),
            (low + spread * rng.permutation(at)).astype(np.float32),
            rng.permutation(np.resize(self.uses, count)).astype(np.int32),
            np.minimum(truth, len(below) - 1).astype(np.int32),
            rng.random((count, horizon), np.float32), gains, chosen,
        )  # fmt: skip
        return gains, chosen


@functools.lru_cache(maxsize=16)
def _fit(of: _Task, seed: int) -> Ahead | Shares:
    seeds = np.random.SeedSequence(seed).generate_state(4)
    plain = Ahead(SHARES, effort=0.0)  # the rule without a tree
    chosen = of.play(plain, _LEAST, seeds[0])[1]
    length = max(float((chosen >= 0).sum()) / _LEAST, 1.0)
    designs, outcomes, states = of.task.likelihood.shape
    choice_work = designs * outcomes * (states + SUM) + NODE  # by ``shares``

    def sessions(work: float, choice: float) -> int:
        return int(min(work / (length * choice), _MOST))

    bases = [SHARES]
    limited = bool(np.isfinite(of.seconds[1]))
    if (count := sessions(_TUNE, choice_work)) >= _LEAST:
        start = SHARES if limited else SHARES.replace(haste=_HASTE)  # type: ignore[attr-defined]  # flax
        bases.append(
            search(
                start, 8, 12, 4, seeds[1], spread=0.5,
                nats_of=lambda rule, number: float(
                    of.play(Ahead(rule, effort=0.0), count, seeds[1] + number)[0].sum()
                ),
            )
        )  # fmt: skip
    hinted: list[tuple[Shares, Any]] = [(base, None) for base in bases]
    if (count := sessions(_PLAY, max(_DEEP, choice_work))) >= _LEAST // 2:
        for base in bases:
            deep = of.play(Ahead(base, effort=_DEEP), count, seeds[2])[1]
            hinted.append((base, _hints(deep, designs)))
    doubts = AHEAD.doubt, 1.0
    tried = [Ahead(base, doubt, h) for base, h in hinted for doubt in doubts]
    count = max(sessions(_TRY, max(AHEAD.effort, choice_work)), _LEAST)
    nats = np.array([of.play(one, count, seeds[3])[0].sum(axis=1) for one in tried])
    mean, error = _paired(nats - nats[0])
    best = int((mean - error).argmax())
    rule = of.play(plain, count, seeds[3])[0].sum(axis=1)
    more, error = _paired(nats[best] - rule)
    return SHARES if more < -2.0 * error else tried[best]


def _hints(chosen: Any, designs: int) -> Array:
    """(N, A) multiples of scores from choices (B, N), larger for frequent choices."""
    every = [np.bincount(a[a >= 0], minlength=designs) for a in chosen.T]
    counts = np.array([row for row in every if row.any()], np.float64)
    whole = counts.sum(axis=0)
    whole = 0.5 * (whole / whole.sum() + 1.0 / designs)
    total = counts.sum(axis=1, keepdims=True)
    share = (counts + _OF_ALL * whole) / (total + _OF_ALL)
    return ((share * designs) ** _POWER).astype(np.float32)


def _paired(more: Any) -> tuple[Any, Any]:
    """Mean and standard error of differences (..., B) on the same sessions."""
    return more.mean(axis=-1), more.std(axis=-1) / np.sqrt(more.shape[-1])
