"""Selection by a trained policy: one pass over the candidates, or a few.

JAX is loaded by the first call. Candidates are brought to order one in float64 before
the network, in float32, sees them, so pulses and degrees give the same pick.
"""

from __future__ import annotations

import functools
import pathlib
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxcal.selection.exchange import exchange_from
from jaxcal.selection.problem import make_problems

if TYPE_CHECKING:
    from jaxcal.learning.checkpoint import Policy

__all__ = ["DECODINGS", "load_policy", "select_batch", "to_order_one"]

DECODINGS = ("greedy", "samples", "first", "exchange")

_CELLS = 4_000_000  # pairs of candidates scored at once: bounds memory, not the result
_LARGEST_CHUNK = 512  # sets a compiled call

Array = NDArray[np.float64]


@functools.lru_cache(maxsize=8)
def _cached(folder: str | None) -> Policy:
    from jaxcal.learning import cache, checkpoint

    cache.keep_compiled_programs()
    return checkpoint.load(folder)


def load_policy(checkpoint: str | pathlib.Path | None = None) -> Policy:
    """The policy of a checkpoint folder, read once a process.

    Args:
        checkpoint: a checkpoint's or training run's folder; the shipped one when None.

    Raises:
        ValueError: it is missing, damaged, or made by another version.
    """
    return _cached(None if checkpoint is None else str(checkpoint))


def to_order_one(candidates: Array, usable: NDArray[np.bool_], white: bool) -> Array:
    """Candidates about 0 with identity covariance, or per axis in [0, 1].

    The compact network sees only what no affine map changes: whitening in float64 first
    spares float32 the offsets and scales of encoder pulses. The paper's network was
    trained on [0, 1]: other ranges are mapped to it axis by axis.
    """
    weight = usable[..., None].astype(np.float64)
    number = weight.sum(axis=1, keepdims=True)
    if white:
        centred = (
            candidates - (candidates * weight).sum(1, keepdims=True) / number
        ) * (weight)
        spread = np.sqrt((centred**2).sum(1, keepdims=True) / number)
        centred = centred / np.where(spread > 0, spread, 1.0)
        covariance = np.matrix_transpose(centred) @ centred / number
        lower = np.linalg.cholesky(covariance + 1e-14 * np.eye(candidates.shape[-1]))
        return np.matrix_transpose(np.linalg.solve(lower, np.matrix_transpose(centred)))
    low = np.where(usable[..., None], candidates, np.inf).min(1, keepdims=True)
    high = np.where(usable[..., None], candidates, -np.inf).max(1, keepdims=True)
    if low.min() >= 0.0 and high.max() <= 1.0:
        return candidates
    return np.where(usable[..., None], (candidates - low) / (high - low), 0.0)


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
    chunk: int | None = None,
) -> NDArray[np.int64]:
    """Choose k postures for every candidate set of a batch.

    The sets are cut into chunks of one size, and every device of this process takes one
    at a time: what is chosen does not depend on how many there are.

    Args:
        candidates: (B, M, n) commands, none of the sets in one plane.
        k: postures to choose, at least n + 1.
        available: (B, M) bool, True where a candidate may be chosen; all by default.
        required: (B, r) candidates that must be chosen; the policy goes on from them.
        decoding: "greedy": the likeliest at every step, one pass; "samples": the best
            of ``num`` sampled passes; "first": the best of the ``num`` likeliest first
            picks, each completed greedily; "exchange": greedy, then Fedorov exchange
            from there.
        num: passes of "samples" and "first".
        seed: of "samples".
        checkpoint: see ``load_policy``.
        chunk: cut after every so many sets, at least; the whole batch when None.

    Returns:
        (B, k) distinct indices, required ones first, then in the order of choice.

    Raises:
        ValueError: naming the argument, the rule and the value; or what is wrong with
            the checkpoint.
    """
    if decoding not in DECODINGS:
        raise ValueError(
            f"decoding must be one of {', '.join(DECODINGS)}, got {decoding!r}"
        )
    if num < 1:
        raise ValueError(f"num must be at least 1, got {num}")
    problems = make_problems(candidates, k, available=available, required=required)
    sets = np.stack([problem.candidates for problem in problems])
    usable = np.stack([problem.available for problem in problems])
    kept = np.stack([problem.required for problem in problems])
    batch, m, _ = sets.shape
    from jaxcal.learning.geometry import num_starts

    policy = load_policy(checkpoint)
    import jax

    scaled = to_order_one(sets, usable, white=policy.network.config.kind == "compact")
    inputs = np.where(usable[..., None], scaled, 0.0).astype(np.float32)
    tries = num if decoding in ("samples", "first") else 1
    chunk = batch if chunk is None else chunk
    pairs = m * num_starts(m) * tries
    size = max(1, min(batch, chunk, _CELLS // pairs, _LARGEST_CHUNK))
    how = "greedy" if decoding == "exchange" else decoding
    cuts = [
        slice(begin, min(begin + size, first + chunk, batch))
        for first in range(0, batch, chunk)
        for begin in range(first, min(first + chunk, batch), size)
    ]
    number = min(len(cuts), jax.local_device_count())
    chosen = []
    for begin in range(0, len(cuts), number):
        parts = [
            (inputs[cut], usable[cut], kept[cut], seed + cut.start)
            for cut in cuts[begin : begin + number]
        ]
        chosen += _choose(policy, parts, k, how, num, size, number)
    indices = np.concatenate(chosen)
    if decoding == "exchange":
        found = zip(problems, indices, strict=True)
        indices = np.stack([exchange_from(problem, start) for problem, start in found])
    return indices


def _choose(
    policy: Policy,
    parts: list[tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.int64], int]],
    k: int,
    decoding: str,
    num: int,
    size: int,
    number: int,
) -> list[NDArray[np.int64]]:
    """One compiled call on so many devices, a part (candidates, free, kept, seed) each.

    A short part is filled up by repeating its first set, a missing one by the first.
    """
    import jax

    from jaxcal.learning import decoding as decoders

    given = [parts[min(i, len(parts) - 1)] for i in range(number)]
    fills = [np.arange(size) * (np.arange(size) < len(part[0])) for part in given]
    candidates, free, kept = (
        np.concatenate(
            [part[n][fill] for part, fill in zip(given, fills, strict=True)]  # type: ignore[index]  # the first three of a part
        )
        for n in range(3)
    )
    keys = [jax.random.key(part[3]) for part in given]
    choose: Any = decoders.choose if number == 1 else decoders.choose_on_devices
    indices = choose(
        policy.network,
        policy.params,
        candidates,
        free,
        kept.astype(np.int32),
        keys[0] if number == 1 else jax.numpy.stack(keys),
        k=k,
        num_required=kept.shape[1],
        decoding=decoding,
        num=num,
    )
    rows = np.asarray(indices).reshape(number, size, k).astype(np.int64)
    return [row[: len(part[0])] for row, part in zip(rows, parts, strict=False)]
