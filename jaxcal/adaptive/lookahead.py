"""``Ahead``: the next measurement by a tree of those that may follow.

``fit`` finds its constants for one task from simulated sessions of that task, in about
a second on one core:

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
import jax.numpy as jnp
import numpy as np
from flax import struct
from numpy.typing import NDArray

from jaxcal.adaptive.grid import GridTask
from jaxcal.adaptive.rules import SHARES, Shares
from jaxcal.adaptive.search_kernel import NODE, SUM, Tree
from jaxcal.adaptive.session import Options, Session, fingerprint, on_host
from jaxcal.adaptive.tuning import search

Array = NDArray[np.float32]

# Multiplications to simulate: each set of constants in a generation, the deep tree,
# each combination.
_TUNE, _PLAY, _TRY = 6e7, 1e10, 2e9
_DEEP = 2e7
_MOST, _LEAST = 512, 16  # sessions of one estimate
_OF_ALL, _POWER = 8.0, 0.25  # pseudo-counts of the mean share; hint = (A share)^.25
_HASTE = 0.3  # start of its search where time is not limited


@struct.dataclass
class Ahead:
    """``shares`` on a tree of the next measurements and all of their outcomes.

    The measurement of the largest expected total of nats: exact where the session ends
    within the tree, with an estimate of what follows elsewhere; deterministic. It is
    ``shares`` on any class but ``GridTask`` itself, and where even a small tree takes
    more than ``effort`` multiplications per choice (7e5: about .04 ms of one core).
    """

    base: Shares = SHARES
    doubt: Any = 0.3  # share of the estimated nats by which to beat ``shares``
    hints: Any = None  # (N, A) multiples of the scores of the first N measurements
    effort: float = struct.field(pytree_node=False, default=7e5)

    def __call__(
        self, task: Any, belief: Any, session: Session, options: Options, key: jax.Array
    ) -> jax.Array:
        if type(task) is not GridTask:  # one of its own may not allow every design
            return self.base(task, belief, session, options, key)
        constants, hints = self.constants()
        return on_host(
            functools.partial(_chosen, task.horizon, self.effort),
            jax.ShapeDtypeStruct((), jnp.int32),
            *(task.likelihood, task.travel, task.extra, task.uses, task.place_after),
            *(*task.limits, jnp.stack(constants), hints, belief.weights),
            *(session.place, session.seconds, session.uses, session.made),
        )

    def constants(self) -> tuple[list[Any], Any]:
        """Constants of ``shares`` and ``doubt``; (N, A) hints, (1, 1) without any."""
        rule = self.base
        numbers = [rule.time, rule.use, rule.a, rule.b, rule.haste, self.doubt]
        return numbers, np.ones((1, 1)) if self.hints is None else self.hints


AHEAD = Ahead()

# Dimensions of the task's arrays, which come first.
_TABLES = (3, 2, 2, 2, 2, 1, 1, 1, 2)


def _chosen(horizon: int, effort: float, *arrays: Any) -> Any:
    """(...) int32 choices in sessions of one task; (...) are axes of ``vmap``."""
    tables: list[Any] = []
    for array, dims in zip(arrays, _TABLES, strict=False):
        if np.prod(array.shape[: array.ndim - dims]) > 1:
            raise ValueError("Ahead decides for one task at a time, got several")
        tables.append(np.reshape(array, array.shape[array.ndim - dims :]))
    belief, *session = map(np.asarray, arrays[len(_TABLES) :])
    batch = np.broadcast_shapes(belief.shape[:-1], *(leaf.shape for leaf in session))
    states = belief.shape[-1]
    beliefs = np.broadcast_to(belief, (*batch, states)).reshape(-1, states)
    kinds = np.int32, np.float32, np.int32, np.int32  # place, seconds, uses, made
    place, seconds, uses, made = (
        np.broadcast_to(leaf, batch).astype(kind).ravel()
        for leaf, kind in zip(session, kinds, strict=True)
    )
    chosen = np.empty(len(beliefs), np.int32)
    searched = tree(*[*tables, horizon, effort])
    searched.choose(_single(beliefs), place, seconds, uses, made, chosen)
    return chosen.reshape(batch)


def tree(
    likelihood: Any, travel: Any, extra: Any, uses: Any, place_after: Any,
    most_extra: Any, most_uses: Any, constants: Any, hints: Any,
    horizon: int, effort: float,
) -> Tree:  # fmt: skip
    """The kernel's object from tables as ``GridTask`` and its ``limits`` have them."""
    hints = np.broadcast_to(hints, (len(hints), len(likelihood)))
    return Tree(
        _single(likelihood), _single(travel), _single(np.transpose(extra)),
        _single(np.transpose(uses)), np.array(place_after, np.int32),
        _single(most_extra), _single(most_uses), horizon, constants, _single(hints),
        effort,
    )  # fmt: skip


def _single(array: Any) -> Any:
    return np.array(array, np.float32, order="C")  # JAX's cannot be written


# -- constants of a task ---------------------------------------------------------------


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
