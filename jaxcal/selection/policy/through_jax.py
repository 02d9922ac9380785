"""Inference through JAX, for networks that read the candidates' own coordinates."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence

import jax
import numpy as np
from numpy.typing import NDArray

from jaxcal.learning.policies import decoding as decoders
from jaxcal.learning.training import checkpoint
from jaxcal.selection.problem import Problem

__all__ = ["JaxNetwork"]

_CELLS = 4_000_000  # pairs of candidates scored at once: bounds memory, not the result
_LARGEST_CALL = 512  # sets


class JaxNetwork:
    """The policy of a checkpoint; compiled once for each shape in a process."""

    def __init__(self, path: pathlib.Path) -> None:
        self._policy = checkpoint.load(path)

    def __call__(
        self, problems: Sequence[Problem], decoding: str, num: int, seed: int
    ) -> NDArray[np.int64]:
        """See ``jaxcal.selection.policy.api.Network``."""
        k, required = problems[0].k, len(problems[0].required)
        m = len(problems[0].available)
        tries = 1 if decoding == "greedy" else num
        # A power of two, filled up by repeating the last set: few shapes to compile.
        most = max(1, min(_LARGEST_CALL, _CELLS // (m * m * tries)))
        size = min(1 << (len(problems) - 1).bit_length(), 1 << (most.bit_length() - 1))
        chosen = []
        for begin in range(0, len(problems), size):
            part = list(problems[begin : begin + size])
            filled = part + part[-1:] * (size - len(part))
            indices = decoders.choose(
                self._policy.network,
                self._policy.params,
                np.stack([to_unit_range(problem) for problem in filled]),
                np.stack([problem.available for problem in filled]),
                np.stack([problem.required for problem in filled]).astype(np.int32),
                jax.random.fold_in(jax.random.key(seed), begin),
                k=k,
                num_required=required,
                decoding=decoding,
                num=tries,
            )
            chosen.append(np.asarray(indices, np.int64)[: len(part)])
        return np.concatenate(chosen)


def to_unit_range(problem: Problem) -> NDArray[np.float32]:
    """(M, n) candidates on [0, 1], on which such networks are trained.

    Those of a set that lies in [0, 1] are left as they are; others are mapped axis by
    axis, the least available one to 0 and the largest to 1. 0 where masked.
    """
    assert problem.candidates is not None  # blocks are refused before
    usable = problem.candidates[problem.available]
    low, high = usable.min(axis=0), usable.max(axis=0)
    if low.min() >= 0.0 and high.max() <= 1.0:
        low, high = np.zeros_like(low), np.ones_like(high)
    scaled = (problem.candidates - low) / (high - low)
    return np.where(problem.available[:, None], scaled, 0.0).astype(np.float32)
