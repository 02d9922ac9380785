"""Turning scores into a choice: greedy, sampled, best of the likeliest first picks.

A ``Scorer`` is the network in JAX (``policies.scorer``) or the compact one in numpy
(``selection.policy``). Needs no JAX. B candidate sets, E episodes (a set and
the choices made from it), M candidates, K choices in all, p regressors of a candidate.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Indices, Mask

Array = NDArray[Any]


class Scorer(Protocol):
    """A network as decoding sees it; a subclass has what is not abstract from here."""

    @property
    def piece_rows(self) -> int | None:
        """Candidates of all tries that are scored at a time, the pieces on every core;
        None where one call takes all."""
        return None

    def encode(self, rows: Array, usable: Mask) -> Any:
        """What ``scores`` needs of sets: rows (B, M, p), of which the last column is 1
        before whitening, and usable (B, M), available or required."""

    def part(self, memory: Any, sets: Indices) -> Any:
        """The memory of E episodes on the ``sets`` (E,) of an encoded batch."""
        return memory

    def scores(
        self, memory: Any, chosen: Indices, free: Mask, count: int, best_only: bool
    ) -> Array:
        """(E, M) unnormalised log-probabilities of the choice after ``count`` choices,
        of ``chosen`` (E, K), -1 from there on, and ``free`` (E, M). ``best_only``: all
        but the largest may be too low where nothing is learned."""

    def worth(self, rows: Array, usable: Mask, tries: Indices) -> Array:
        """(B, T) by which the best of the tries (B, T, K) on each set is taken."""
        return log_dets(rows, tries)


def choose(
    scorer: Scorer,
    rows: Array,
    available: Mask,
    required: Indices,
    k: int,
    *,
    decoding: str = "greedy",
    num: int = 16,
    generators: Sequence[np.random.Generator] = (),
) -> Indices:
    """(B, k) of M candidates: the ``required`` first, then in the order of choice.

    Args:
        scorer: the network.
        rows: (B, M, p) regressors of the candidates.
        available: (B, M) bool.
        required: (B, r) distinct indices, chosen before the policy begins.
        k: candidates to choose in all.
        decoding: as for ``selection.policy.select_batch``, without "exchange".
        num: passes for "samples" and "first".
        generators: one a set, for "samples"; else none.
    """
    batch, r = required.shape
    chosen = np.full((batch, k), -1, np.int64)
    chosen[:, :r] = required
    usable, free = available.copy(), available.copy()
    np.put_along_axis(usable, required, True, axis=1)
    np.put_along_axis(free, required, False, axis=1)
    memory = scorer.encode(rows, usable)
    if decoding == "greedy" or r == k:
        return _completed(scorer, memory, chosen, free, r, ())
    begun = r
    if decoding == "first":
        scores = np.where(free, scorer.scores(memory, chosen, free, r, False), -np.inf)
        firsts = np.argsort(-scores, axis=1, kind="stable")[:, :num]
        # Fewer than num are left: try the best again, not one that is masked.
        valid = np.take_along_axis(free, firsts, axis=1)
        firsts = np.where(valid, firsts, firsts[:, :1])
        num, generators, begun = firsts.shape[1], (), r + 1
    sets = np.repeat(np.arange(batch), num)
    chosen, free = chosen[sets], free[sets]
    if decoding == "first":
        chosen[:, r] = firsts.ravel()
        np.put_along_axis(free, firsts.reshape(-1, 1), False, axis=1)

    def piece(part: slice) -> Indices:
        some = scorer.part(memory, sets[part])
        return _completed(scorer, some, chosen[part], free[part], begun, generators)

    size = len(sets)
    if scorer.piece_rows is not None and not generators:
        size = max(1, scorer.piece_rows // rows.shape[1])
    tries = in_pieces(piece, len(sets), size).reshape(batch, num, k)
    best = scorer.worth(rows, usable, tries).argmax(axis=1)
    return tries[np.arange(batch), best]


def log_dets(rows: Array, tries: Indices) -> Array:
    """(B, T) log det of the information of tries (B, T, K); -inf where singular."""
    picked = np.take_along_axis(rows[:, None], tries[..., None], axis=2)
    sign, value = np.linalg.slogdet(np.matrix_transpose(picked) @ picked)
    return np.asarray(np.where(sign > 0, value, -np.inf))


def _completed(
    scorer: Scorer,
    memory: Any,
    chosen: Indices,
    free: Mask,
    begun: int,
    generators: Sequence[np.random.Generator],
) -> Indices:
    """``chosen``, written, as ``free`` is, from position ``begun`` to the end: the
    likeliest candidate at every step or, where generators are given, a draw from the
    policy, each for as many episodes in a row."""
    episodes = np.arange(len(chosen))
    for count in range(begun, chosen.shape[1]):
        scores = scorer.scores(memory, chosen, free, count, not generators)
        if generators:
            shape = (len(episodes) // len(generators), free.shape[1])
            # The largest of scores plus Gumbel noise is a draw from their softmax.
            scores = scores + np.concatenate([g.gumbel(size=shape) for g in generators])
        pick = np.where(free, scores, -np.inf).argmax(axis=1)
        chosen[:, count] = pick
        free[episodes, pick] = False
    return chosen


def in_pieces(call: Callable[[slice], Indices], count: int, size: int) -> Indices:
    """``call`` on slices of ``size`` of ``count``, on every core, joined."""
    parts = [slice(begin, begin + size) for begin in range(0, count, size)]
    if len(parts) == 1:
        return call(parts[0])
    # The kernel and numpy's products release the interpreter.
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return np.concatenate(list(pool.map(call, parts)))
