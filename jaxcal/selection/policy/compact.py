"""The compact network without JAX: numpy over what ``kernel`` compiles, any M, K and n.

Letters: B candidate sets, E episodes (a set and the choices made from it), M
candidates, K choices in all, p regressors, w width of the network. Weights are float32.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxcal.checks import Array, Indices, Mask
from jaxcal.learning.policies.decoding import choose, in_pieces, log_dets
from jaxcal.selection.policy.policy_kernel import CLOSE, describe
from jaxcal.selection.problem import Problem

Array32 = NDArray[np.float32]

_ROWS = 1_024  # candidates of all episodes in a piece of work: they fit a core's cache
_RULE = 20.0  # multiple of the look-ahead in the rule that ``trust`` weighs
_UNLEARNED = 2  # choices at the end that the look-ahead makes alone: they are exact
_SHARP = 60.0  # inverse temperature of those
_ONE = np.float32(1.0)
_ONE_THREAD = 2**18  # multiplications up to which OpenBLAS uses one thread


class Memory(NamedTuple):
    """Candidate sets, one an episode."""

    x: Array  # (E, p, M) whitened regressors with mean square 1, 0 where masked
    encoded: Array32  # (E, M, w) what the encoder made of them


class _Decision(NamedTuple):
    """What ``describe`` writes, and the candidates that count."""

    features: Array32  # (E, M, F) as ``VectorFeatures.columns``
    moments: Array32  # (E, p (p + 1) / 2, M)
    ahead: Array  # (E, M)
    active: Array32  # (E, M) 1 or 0


def _product(a: Array32, b: Array32) -> Array32:
    """``a @ b`` by rows of ``a``, few enough that BLAS starts no thread of its own: a
    busy core would make a product 20 times slower."""
    size = max(1, _ONE_THREAD // (a.shape[-1] * b.shape[-1]))
    begins = range(0, a.shape[-2], size)
    return np.concatenate([a[..., i : i + size, :] @ b for i in begins], axis=-2)


class CompactScorer:
    """The ``Scorer`` of ``learning.policies.decoding``: fields of a ``NetworkConfig``,
    weights."""

    piece_rows = _ROWS

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
        """(B, k) candidates of each problem, as a ``Chooser`` orders them."""
        tries = 1 if decoding == "greedy" else num
        size = max(1, _ROWS // (len(problems[0].rows) * tries))

        def piece(part: slice) -> Indices:
            draws = range(len(problems))[part] if decoding == "samples" else ()
            rows, available, required = (
                np.stack([getattr(problem, name) for problem in problems[part]])
                for name in ("rows", "available", "required")
            )
            return choose(
                self, rows, available, required, problems[0].k,
                decoding=decoding, num=num,
                generators=[np.random.default_rng((seed, b)) for b in draws],
            )  # fmt: skip

        return in_pieces(piece, len(problems), size)

    def encode(self, rows: Array, usable: Mask) -> Memory:
        """The sets as the network sees them; 0 where not usable."""
        x = np.ascontiguousarray(np.matrix_transpose(rows))
        x *= np.sqrt(usable.sum(axis=1))[:, None, None]
        batch, p, _ = x.shape
        none = np.zeros((batch, 0), np.int64)
        description = self._described(x, none, usable, p, p)
        scalars = np.empty((batch, 2), np.float32)
        scalars[:, 0] = np.log(usable.sum(axis=1) / 50.0) / 3.0
        scalars[:, 1] = p / 4.0 - 1.0
        h = self._dense("embed", description.features, scalars)
        h *= description.active[..., None]
        for name in self._encoder:
            h = self._round(name, h, description)
        return Memory(x, h)

    def part(self, memory: Memory, sets: Indices) -> Memory:
        """The memory of episodes on ``sets``."""
        return Memory(memory.x[sets], memory.encoded[sets])

    def scores(
        self,
        memory: Memory,
        chosen: Indices,
        free: Mask,
        count: int,
        best_only: bool = False,
    ) -> Array:
        """(E, M) scores of the choice after ``count``; lowest where not free."""
        x, h = memory
        p, k = x.shape[1], chosen.shape[1]
        remaining, made = k - count, chosen[:, :count].copy()
        exact = remaining <= self._unlearned
        only = exact and best_only
        description = self._described(x, made, free, k, remaining, only)
        if exact:
            return np.where(free, _SHARP * description.ahead, -np.inf)
        mean = h[np.arange(len(h))[:, None], made].sum(axis=1) / np.float32(
            max(count, 1)
        )
        progress = [remaining == 1, remaining == 2, remaining == 3, 1 / remaining]
        progress += [count / p, min(remaining / p, 3.0), k > p]
        scalars = np.tile(np.array(progress, np.float32), (len(h), 1))
        state = np.concatenate([mean, scalars], axis=1)
        inputs = np.concatenate([h, description.features], axis=2)
        g = self._dense("join", inputs, state)
        g *= description.active[..., None]
        for name in self._decoder:
            g = self._round(name, g, description)
        g = self._normalised("final_norm", g)
        learned = np.einsum("emw,wo->emo", g, self._weights["actor.kernel"])
        rule = _RULE * description.ahead
        if self._close_up:
            for scale in CLOSE:
                rule += np.exp(scale * description.ahead)
        scores = learned[..., 0] + float(self._weights["trust"]) * rule
        return np.where(free, scores, -np.inf)

    def worth(self, rows: Array, usable: Mask, tries: Indices) -> Array:
        """(B, T) log det of the information of tries (B, T, K)."""
        return log_dets(rows, tries)

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
