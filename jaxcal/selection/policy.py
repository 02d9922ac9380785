"""Selection by a trained policy: one pass over the candidates, or a few.

JAX is loaded by the first call. Candidates are brought to order one in float64 before
the network, in float32, sees them, so pulses and degrees give the same pick.
"""

from __future__ import annotations

import functools
import pathlib
from typing import TYPE_CHECKING

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
) -> NDArray[np.int64]:
    """Choose k postures for every candidate set of a batch.

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
    policy = load_policy(checkpoint)
    scaled = to_order_one(sets, usable, white=policy.network.config.kind == "compact")
    inputs = np.where(usable[..., None], scaled, 0.0).astype(np.float32)
    tries = num if decoding in ("samples", "first") else 1
    size = max(1, min(batch, _CELLS // (m * m * tries), _LARGEST_CHUNK))
    how = "greedy" if decoding == "exchange" else decoding
    indices = np.concatenate(
        [
            _choose(
                policy, inputs[i:j], usable[i:j], kept[i:j], k, how, num, seed + i, size
            )
            for i in range(0, batch, size)
            for j in [min(i + size, batch)]
        ]
    )
    if decoding == "exchange":
        found = zip(problems, indices, strict=True)
        indices = np.stack([exchange_from(problem, start) for problem, start in found])
    return indices


def _choose(
    policy: Policy,
    candidates: NDArray[np.float32],
    free: NDArray[np.bool_],
    kept: NDArray[np.int64],
    k: int,
    decoding: str,
    num: int,
    seed: int,
    size: int,
) -> NDArray[np.int64]:
    """One compiled call; a short last chunk is padded by repeating its first set."""
    import jax

    from jaxcal.learning import decoding as decoders

    count = len(candidates)
    fill = np.concatenate([np.arange(count), np.zeros(size - count, np.int64)])
    indices = decoders.choose(
        policy.network,
        policy.params,
        candidates[fill],
        free[fill],
        kept[fill].astype(np.int32),
        jax.random.key(seed),
        k=k,
        num_required=kept.shape[1],
        decoding=decoding,
        num=num,
    )
    return np.asarray(indices)[:count].astype(np.int64)
