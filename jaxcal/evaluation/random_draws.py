"""The random baseline: uniform draws of k candidates, never a singular set."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.regression import log_det_gram
from jaxcal.selection import random_batch

__all__ = ["draw_random", "log_det_gram_of"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

_REDRAWS = 20


def draw_random(
    rng: np.random.Generator,
    candidates: Array,
    available: Mask | None,
    k: int,
    num: int,
) -> tuple[Indices, Array]:
    """Draw ``num`` selections an episode, uniform among the invertible ones.

    Singular draws are drawn again; the few that stay singular are left to the solver.

    Args:
        rng: source of the draws.
        candidates: (E, M, n).
        available: (E, M) True where a candidate may be chosen; all where None.
        k: candidates of a selection.
        num: selections an episode, R.

    Returns:
        (E, R, k) indices and (E, R) natural log det of their Gram matrices.
    """
    picks = _draw(rng, (len(candidates), num, candidates.shape[1]), k, available)
    gram = log_det_gram_of(candidates, picks)
    for attempt in range(_REDRAWS + 1):
        episode, draw = np.nonzero(np.isneginf(gram))
        if not episode.size:
            break
        sets = candidates[episode]
        mask = None if available is None else available[episode]
        if attempt < _REDRAWS:
            fresh = _draw(rng, (len(episode), 1, sets.shape[1]), k, mask)
        else:
            seed = int(rng.integers(2**31))
            fresh = random_batch(sets, k, available=mask, seed=seed).indices[:, None]
        picks[episode, draw] = fresh[:, 0]
        gram[episode, draw] = log_det_gram_of(sets, fresh)[:, 0]
    return picks, gram


def log_det_gram_of(candidates: Array, indices: Indices) -> Array:
    """(E, R) log det of Z.T Z for (E, R, k) indices into (E, M, n) candidates."""
    chosen = np.take_along_axis(candidates[:, None], indices[..., None], axis=2)
    return log_det_gram(chosen)


def _draw(
    rng: np.random.Generator, shape: tuple[int, int, int], k: int, mask: Mask | None
) -> Indices:
    """(E, R, k) distinct candidates out of (E, R, M), uniform among the available."""
    order = rng.random(shape)
    if mask is not None:
        order[np.broadcast_to(~mask[:, None], shape)] = 2.0
    if k == shape[2]:
        return np.argsort(order, axis=2)
    return np.argpartition(order, k - 1, axis=2)[..., :k]
