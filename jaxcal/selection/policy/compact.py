"""The compact network without JAX: numpy over what ``kernel`` compiles, any M, K and n.

Letters: B candidate sets, E episodes (a set and the choices made from it), M
candidates, K choices in all, p regressors, w width of the network. Weights are float32.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.selection.policy.policy_kernel import CLOSE, describe
from jaxcal.selection.problem import Problem

__all__ = ["CompactNetwork"]

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

_ROWS = 1_024  # candidates of all episodes in a piece of work: they fit a core's cache
_RULE = 20.0  # multiple of the look-ahead in the rule that ``trust`` weighs
_UNLEARNED = 2  # choices at the end that the look-ahead makes alone: they are exact
_SHARP = 60.0  # inverse temperature of those
_ONE = np.float32(1.0)
_ONE_THREAD = 2**18  # multiplications up to which OpenBLAS uses one thread


class _Sets(NamedTuple):
    """Candidate sets, one an episode, with the choices made from them."""

    x: Array  # (E, p, M) whitened regressors with mean square 1, 0 where masked
    memory: Array32  # (E, M, w) what the encoder made of them
    chosen: Indices  # (E, K), written as choices are made
    free: Mask  # (E, M) True where a candidate may be chosen, written likewise

    def repeated(self, times: int) -> _Sets:
        """Every episode ``times`` times in a row."""
        return _Sets._make(np.repeat(part, times, axis=0) for part in self)


class _Decision(NamedTuple):
    """What ``describe`` writes, and the candidates that count."""

    features: Array32  # (E, M, F) ``learning.policies.features.FEATURES``
    moments: Array32  # (E, p (p + 1) / 2, M)
    ahead: Array  # (E, M)
    active: Array32  # (E, M) 1 or 0


def _in_pieces(call: Callable[[slice], Indices], count: int, size: int) -> Indices:
    """``call`` on slices of ``size`` of ``count``, on every core, joined."""
    parts = [slice(begin, begin + size) for begin in range(0, count, size)]
    if len(parts) == 1:
        return call(parts[0])
    # The kernel and numpy's products release the interpreter.
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        return np.concatenate(list(pool.map(call, parts)))


def _product(a: Array32, b: Array32) -> Array32:
    """``a @ b`` by rows of ``a``, few enough that BLAS starts no thread of its own.

    Its threads wait for each other, so a busy core made a product 20 times slower.
    """
    size = max(1, _ONE_THREAD // (a.shape[-1] * b.shape[-1]))
    begins = range(0, a.shape[-2], size)
    return np.concatenate([a[..., i : i + size, :] @ b for i in begins], axis=-2)


class CompactNetwork:
    """Chooses for problems of one shape, in pieces, on every core.

    Args:
        config: fields of a ``NetworkConfig`` of kind "compact".
        arrays: weights by flat name.
    """

    def __init__(self, config: Mapping[str, Any], arrays: Mapping[str, Array32]):
        self._lookahead: int = config["lookahead"]
        self._close_up: bool = config["close_up"]
        self._unlearned = min(self._lookahead, _UNLEARNED)
        self._encoder = [f"encoder_{i}" for i in range(config["encoder_rounds"])]
        self._decoder = [f"decoder_{i}" for i in range(config["decoder_rounds"])]
        self._weights = dict(arrays)

    def __call__(
        self, problems: Sequence[Problem], decoding: str, num: int, seed: int
    ) -> Indices:
        """See ``jaxcal.selection.policy.api.Network``."""
        tries = 1 if decoding == "greedy" else num
        size = max(1, _ROWS // (len(problems[0].rows) * tries))

        def piece(part: slice) -> Indices:
            draws = range(len(problems))[part] if decoding == "samples" else ()
            streams = [np.random.default_rng((seed, b)) for b in draws]
            return self._choose(problems[part], decoding, num, streams)

        return _in_pieces(piece, len(problems), size)

    def _choose(
        self,
        problems: Sequence[Problem],
        decoding: str,
        num: int,
        generators: Sequence[np.random.Generator],
    ) -> Indices:
        """(B, k) indices; one generator a problem for "samples", else none."""
        k = problems[0].k
        rows = np.stack([problem.rows for problem in problems])
        available = np.stack([problem.available for problem in problems])
        required = np.stack([problem.required for problem in problems])
        batch, r = required.shape
        x = np.ascontiguousarray(np.matrix_transpose(rows))
        x *= np.sqrt(available.sum(axis=1))[:, None, None]
        chosen = np.full((batch, k), -1, np.int64)
        chosen[:, :r] = required
        free = available.copy()
        np.put_along_axis(free, required, False, axis=1)
        sets = _Sets(x, self._encoded(x, available), chosen, free)
        if decoding == "greedy" or r == k:
            return self._completed(sets, r, ())
        first = r
        if decoding == "first":
            firsts = np.argsort(-self._scores(sets, r), axis=1, kind="stable")[:, :num]
            # Fewer than num are left: try the best again, not one that is masked.
            valid = np.take_along_axis(free, firsts, axis=1)
            firsts = np.where(valid, firsts, firsts[:, :1])
            num, generators, first = firsts.shape[1], (), r + 1
        sets = sets.repeated(num)
        if decoding == "first":
            sets.chosen[:, r] = firsts.ravel()
            np.put_along_axis(sets.free, firsts.reshape(-1, 1), False, axis=1)

        def piece(part: slice) -> Indices:
            some = _Sets._make(each[part] for each in sets)
            return self._completed(some, first, generators)

        size = batch * num if generators else max(1, _ROWS // x.shape[2])
        tries = _in_pieces(piece, batch * num, size).reshape(batch, num, k)
        picked = np.take_along_axis(rows[:, None], tries[..., None], axis=2)
        sign, value = np.linalg.slogdet(np.matrix_transpose(picked) @ picked)
        best = np.where(sign > 0, value, -np.inf).argmax(axis=1)
        return tries[np.arange(batch), best]

    def _completed(
        self, sets: _Sets, first: int, generators: Sequence[np.random.Generator]
    ) -> Indices:
        """``sets.chosen``, written from position ``first`` to the end.

        The likeliest candidate at every step or, where generators are given, a draw
        from the policy; each generator serves as many episodes in a row.
        """
        chosen, free = sets.chosen, sets.free
        each = np.arange(len(chosen))
        for count in range(first, chosen.shape[1]):
            scores = self._scores(sets, count, best_only=not generators)
            if generators:
                shape = (len(each) // len(generators), free.shape[1])
                # The largest of scores plus Gumbel noise is a draw from their softmax.
                scores += np.concatenate([g.gumbel(size=shape) for g in generators])
            pick = np.where(free, scores, -np.inf).argmax(axis=1)
            chosen[:, count] = pick
            free[each, pick] = False
        return chosen

    def _encoded(self, x: Array, available: Mask) -> Array32:
        """(B, M, w) of x (B, p, M) and available (B, M); 0 where not available."""
        batch, p, _ = x.shape
        none = np.zeros((batch, 0), np.int64)
        seen = self._described(x, none, available, p, p)
        scalars = np.empty((batch, 2), np.float32)
        scalars[:, 0] = np.log(available.sum(axis=1) / 50.0) / 3.0
        scalars[:, 1] = p / 4.0 - 1.0
        h = self._dense("embed", seen.features, scalars)
        h *= seen.active[..., None]
        for name in self._encoder:
            h = self._round(name, h, seen)
        return h

    def _scores(self, sets: _Sets, count: int, best_only: bool = False) -> Array:
        """(E, M) scores of the next choice after ``count``; lowest where not free.

        With ``best_only`` all but the best may be too low where nothing is learned.
        """
        x, h, chosen, free = sets
        p, k = x.shape[1], chosen.shape[1]
        left = k - count
        exact = left <= self._unlearned
        only = exact and best_only
        seen = self._described(x, chosen[:, :count].copy(), free, k, left, only)
        if exact:
            return np.where(free, _SHARP * seen.ahead, -np.inf)
        each = np.arange(len(h))[:, None]
        mean = h[each, chosen[:, :count]].sum(axis=1) / np.float32(max(count, 1))
        progress = [left == 1, left == 2, left == 3, 1 / left, count / p]
        progress += [min(left / p, 3.0), k > p]
        scalars = np.tile(np.array(progress, np.float32), (len(h), 1))
        state = np.concatenate([mean, scalars], axis=1)
        g = self._dense("join", np.concatenate([h, seen.features], axis=2), state)
        g *= seen.active[..., None]
        for name in self._decoder:
            g = self._round(name, g, seen)
        g = self._normalised("final_norm", g)
        learned = np.einsum("emw,wo->emo", g, self._weights["actor.kernel"])
        rule = _RULE * seen.ahead
        if self._close_up:
            for scale in CLOSE:
                rule += np.exp(scale * seen.ahead)
        scores = learned[..., 0] + float(self._weights["trust"]) * rule
        return np.where(free, scores, -np.inf)

    def _described(
        self,
        x: Array,
        chosen: Indices,
        active: Mask,
        k: int,
        depth: int,
        best_only: bool = False,
    ) -> _Decision:
        episodes, p, m = x.shape
        features = np.empty((episodes, m, 16 if self._close_up else 13), np.float32)
        moments = np.empty((episodes, p * (p + 1) // 2, m), np.float32)
        ahead = np.empty((episodes, m))
        depth = min(depth, self._lookahead)
        describe(x, chosen, active, k, depth, best_only, features, moments, ahead)
        return _Decision(features, moments, ahead, active.astype(np.float32))

    def _round(self, name: str, h: Array32, seen: _Decision) -> Array32:
        """(E, M, w) ``h`` after one round of messages among the active candidates."""
        weights, width = self._weights, h.shape[2]
        mix = weights[f"{name}.mix.kernel"]
        u = self._normalised(f"{name}.norm", h)
        number = np.maximum(seen.active.sum(axis=1), _ONE)[:, None]
        mean = (u * seen.active[..., None]).sum(axis=1) / number
        shared = mean @ weights[f"{name}.pool.kernel"] + weights[f"{name}.mix.bias"]
        inner = _product(u, mix[:width])
        sent: Array32 = seen.moments @ _product(u, weights[f"{name}.send.kernel"])
        sent = sent @ mix[width:]
        inner += _product(np.matrix_transpose(seen.moments), sent)
        inner += shared[:, None]
        np.maximum(inner, 0.0, out=inner)
        out = _product(inner, weights[f"{name}.out.kernel"])
        out += weights[f"{name}.out.bias"]
        out *= seen.active[..., None]
        out += h
        return out

    def _dense(self, name: str, each: Array32, shared: Array32) -> Array32:
        """(E, M, w) layer of (E, M, a) numbers of candidates beside (E, b) shared."""
        kernel, split = self._weights[f"{name}.kernel"], each.shape[2]
        out = _product(each, kernel[:split])
        out += (shared @ kernel[split:] + self._weights[f"{name}.bias"])[:, None]
        return out

    def _normalised(self, name: str, h: Array32) -> Array32:
        """Layer normalisation over the last axis of (E, M, w)."""
        size = np.float32(h.shape[2])
        centred = h - h.sum(axis=2, keepdims=True) / size
        variance = np.einsum("emw,emw->em", centred, centred) / size
        centred *= (_ONE / np.sqrt(variance + np.float32(1e-6)))[..., None]
        centred *= self._weights[f"{name}.scale"]
        centred += self._weights[f"{name}.bias"]
        return centred
