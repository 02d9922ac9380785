"""Choosing by a checkpoint: its weights read once, its kind of network looked up.

The compact network is inferred in numpy and a compiled kernel and needs no JAX; any
other kind goes through JAX, which the extra ``policy`` installs. Both read whitened or
rescaled candidates, so pulses and degrees give the same pick.

Letters: B candidate sets, E episodes (a set and the choices made from it), M
candidates, K choices in all, p regressors, w width of the network. Weights are float32.
"""

from __future__ import annotations

import functools
import pathlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.checks import Array, Indices, Mask, one_of, whole_number
from jaxcal.extras import needs
from jaxcal.learning.policies import decoding as decoders
from jaxcal.learning.runtime import weights
from jaxcal.selection.policy.policy_kernel import CLOSE, describe
from jaxcal.selection.problem import Problem, make_problems

Array32 = NDArray[np.float32]
DECODINGS = ("greedy", "samples", "first", "exchange")

_CELLS = 4_000_000  # pairs of candidates that JAX scores at once: bounds memory alone
_LARGEST_CALL = 512  # sets

_ROWS = 1_024  # candidates of all episodes in a piece of work: they fit a core's cache
_RULE = 20.0  # multiple of the look-ahead in the rule that ``trust`` weighs
_UNLEARNED = 2  # choices at the end that the look-ahead makes alone: they are exact
_SHARP = 60.0  # inverse temperature of those
_ONE = np.float32(1.0)
_ONE_THREAD = 2**18  # multiplications up to which OpenBLAS uses one thread


# A policy, ready to choose (B, k) for problems of one M, n, k and number of required,
# which come first, then in the order of choice: of problems, decoding, num, seed.
Chooser = Callable[[Sequence[Problem], str, int, int], Indices]


def load_policy(checkpoint: str | pathlib.Path | None = None) -> Chooser:
    """The newest policy of a weights file or a run's folder, or (None) the shipped one;
    read again only where its files have changed.

    Raises:
        ValueError: it is missing, damaged, or made by another version.
        MissingExtraError: it needs JAX, which is not installed.
    """
    path = weights.locate(checkpoint)
    state = path.stat()  # a save makes another folder, an export another file
    given = path if checkpoint is None else pathlib.Path(checkpoint)
    return _loaded(given, path, (state.st_mtime_ns, state.st_size, state.st_ino))


@functools.lru_cache(maxsize=8)
def _loaded(given: pathlib.Path, path: pathlib.Path, state: tuple[int, ...]) -> Chooser:
    """A weights file, a run or its step as ``given``, which ``path`` is at present;
    the state is what changes when it is replaced."""
    if path.is_file():
        stored = weights.read(path)
        held = stored.meta | {"network": stored.network}
        weights.require_trained_by_d(path, held)
    else:
        with needs("policy", f"checkpoint {path}, the folder of a training run,"):
            from jaxcal.learning.training import checkpoint
        stored = checkpoint.load(given).weights
    if stored.network["kind"] == "compact":
        return CompactScorer(stored.network, stored.arrays)
    with needs("policy", f"checkpoint {path}, a network other than compact,"):
        return _ThroughJax(given)


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
            return decoders.choose(
                self, rows, available, required, problems[0].k,
                decoding=decoding, num=num,
                generators=[np.random.default_rng((seed, b)) for b in draws],
            )  # fmt: skip

        return decoders.in_pieces(piece, len(problems), size)

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
        return decoders.log_dets(rows, tries)

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


class _ThroughJax:
    """A network that reads the candidates' own coordinates, compiled for each shape."""

    def __init__(self, path: pathlib.Path) -> None:
        from jaxcal.learning.training import checkpoint

        self._path, self._policy = path, checkpoint.load(path)

    def _require_read(self, problems: Sequence[Problem]) -> None:
        """Refuse sets that the network would read as something else."""
        trained = self._policy.meta["tasks"][0]["environment"]["num_inputs"]
        inputs = problems[0].num_regressors - 1
        if inputs != trained:
            raise ValueError(
                f"checkpoint {self._path} chooses for {trained} inputs, got {inputs}"
            )
        masked = max(int((~problem.available).sum()) for problem in problems)
        if masked and self._policy.network.mask_is_chosen:
            raise ValueError(
                f"checkpoint {self._path} needs all candidates available, but {masked} "
                "are not; leave them out"
            )

    def __call__(
        self, problems: Sequence[Problem], decoding: str, num: int, seed: int
    ) -> Indices:
        from jaxcal.learning.policies import scorer

        self._require_read(problems)
        m, tries = len(problems[0].available), 1 if decoding == "greedy" else num
        # A power of two, filled up by repeating the last set: few shapes to compile.
        most = max(1, min(_LARGEST_CALL, _CELLS // (m * m * tries)))
        size = min(1 << (len(problems) - 1).bit_length(), 1 << (most.bit_length() - 1))
        chosen = []
        for begin in range(0, len(problems), size):
            part = list(problems[begin : begin + size])
            filled = part + part[-1:] * (size - len(part))
            sets = [(_in_unit_range(x), x.available, x.required) for x in filled]
            seeds = [(seed, b) for b in range(begin, begin + size)]
            indices = scorer.choose(
                self._policy.network, self._policy.params,
                *map(np.stack, zip(*sets, strict=True)),
                k=problems[0].k, seeds=seeds, decoding=decoding, num=tries,
            )  # fmt: skip
            chosen.append(indices[: len(part)])
        return np.concatenate(chosen)


def _in_unit_range(problem: Problem) -> NDArray[np.float32]:
    """(M, n) candidates on [0, 1], where such networks are trained; 0 where masked.
    Sets in [0, 1] stay as they are; others are mapped axis by axis."""
    assert problem.candidates is not None  # blocks are refused before
    usable = problem.candidates[problem.available]
    low, high = usable.min(axis=0), usable.max(axis=0)
    if low.min() >= 0.0 and high.max() <= 1.0:
        low, high = np.zeros_like(low), np.ones_like(high)
    scaled = (problem.candidates - low) / (high - low)
    return np.where(problem.available[:, None], scaled, 0.0).astype(np.float32)


def select_batch(
    candidates: ArrayLike,
    k: int,
    *,
    available: ArrayLike | None = None,
    required: ArrayLike | None = None,
    decoding: str = "greedy",
    num: int = 16,
    seed: int = 0,
    checkpoint: str | pathlib.Path | None = None,
) -> Indices:
    """(B, k) distinct postures of each candidate set, required ones first, then in the
    order of choice; what is chosen from a set does not depend on the other sets.

    Args:
        candidates: (B, M, n) commands, none of the sets in one plane.
        k: postures to choose, at least n + 1.
        available: (B, M) bool, True where a candidate may be chosen; all by default.
        required: (B, r) candidates that must be chosen; the policy goes on from them.
        decoding: "greedy": the likeliest at every step, one pass; "samples": the best
            of ``num`` sampled passes; "first": the best of the ``num`` likeliest first
            picks, each completed greedily; "exchange": greedy, then Fedorov exchange.
        num, seed: passes of "samples" and "first"; of "samples".
        checkpoint: see ``load_policy``.

    Raises:
        ValueError: also says what is wrong with the checkpoint.
    """
    problems = make_problems(candidates, k, available=available, required=required)
    return choose(problems, decoding, num, seed, checkpoint)


def choose(
    problems: Sequence[Problem],
    decoding: str,
    num: int,
    seed: int,
    checkpoint: str | pathlib.Path | None,
) -> Indices:
    """(B, k) for problems of one shape, of the affine model; see ``select_batch``."""
    one_of("decoding", decoding, DECODINGS)
    num, seed = whole_number("num", num, 1), whole_number("seed", seed, 0)
    climbs = decoding == "exchange"
    policy = load_policy(checkpoint)
    chosen = policy(problems, "greedy" if climbs else decoding, num, seed)
    if climbs:
        from jaxcal.selection.exchange.exchange import exchange_from

        chosen = np.stack(list(map(exchange_from, problems, chosen)))
    return chosen
