"""Greedy and exchange on blocks, for every criterion; front of ``blocks_kernel``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.blocks import largest_rank
from jaxcal.selection.problem import Problem

__all__ = ["Blocks"]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# While a selection grows, a share of the information that k mean candidates give stands
# in for those that are not chosen yet: this one, less where k candidates have fewer
# readings than there are parameters, and in further starts of the exchange others.
_SHARE = 0.2
_FURTHER = (1.0, 0.03)
_MENDING = 10  # random starts where all greedy ones are singular
_RANK_FIRST = 1e-7  # every direction that nothing is known of outweighs the rest


class Blocks:
    """The available candidates of a problem as the compiled kernels take them.

    E is treated as A, the sum of the variances, which is at most p times the largest:
    an incomplete selection has no least eigenvalue to raise.
    """

    def __init__(self, problem: Problem) -> None:
        from jaxcal.selection.exchange import blocks_kernel as kernel

        self._usable = np.flatnonzero(problem.available)
        self._blocks = problem.blocks[self._usable]
        count, q, p = self._blocks.shape
        groups = -(-count // kernel.WIDE)
        padded = np.zeros((groups * kernel.WIDE, q, p))
        padded[:count] = self._blocks
        self._columns = np.ascontiguousarray(
            padded.reshape(groups, kernel.WIDE, q, p).transpose(0, 2, 3, 1)
        )
        self._prior, self._k = problem.prior.copy(), problem.k
        self._known = bool(len(problem.root))
        self._upper = np.zeros(groups * kernel.WIDE, dtype=np.int64)
        self._upper[:count] = problem.upper[self._usable]
        self._required = np.searchsorted(self._usable, problem.required)
        criterion = problem.criterion
        self._kind = kernel.TRACE
        if criterion.kind == "det":
            self._kind = kernel.DET if criterion.name == "D" else kernel.SUBSET
        self._root = criterion.root.copy()
        self._share = _SHARE * min(1.0, self._k * q / p) ** 6

    def greedy(self) -> Indices:
        """(k,) the required, then one at a time by the largest gain.

        A selection that is singular is mended by swaps, as in the exchange.
        """
        for share in (self._share, _RANK_FIRST):
            chosen, phi = self._from(self._required, share, False)
            if phi > -np.inf:
                return self._usable[chosen]
        return self.exchanged(1, 0)[0]

    def climbed(self, start: Indices) -> tuple[Indices, float]:
        """The local optimum that ``start`` (k,), required first, climbs to; its phi."""
        chosen, phi = self._from(np.searchsorted(self._usable, start), 1.0, True)
        return self._usable[chosen], phi

    def exchanged(self, restarts: int, seed: int) -> tuple[Indices, float]:
        """The best local optimum from greedy selections and then random starts."""
        best, phi = self._required, -np.inf
        shares = (self._share, *_FURTHER)[:restarts]
        for share in shares:
            best, phi = self._better(best, phi, self._required, share)
        more = max(restarts - len(shares), 0 if phi > -np.inf else _MENDING)
        for start in self._random(more, seed) if more else ():
            best, phi = self._better(best, phi, start, 1.0)
        return self._usable[best], phi

    def _better(
        self, best: Indices, phi: float, start: Indices, share: float
    ) -> tuple[Indices, float]:
        chosen, found = self._from(start, share, True)
        if not np.isfinite(phi) or found > phi + 1e-10 * abs(phi):
            return chosen, found
        return best, phi

    def _from(
        self, start: Indices, share: float, climbs: bool
    ) -> tuple[Indices, float]:
        from jaxcal.selection.exchange.blocks_kernel import grow_and_climb
        from jaxcal.selection.exchange.starts import RIDGE

        chosen = np.zeros(self._k, dtype=np.int64)
        chosen[: len(start)] = start
        size, phi = len(start), -np.inf
        unit, weight = np.eye(len(self._prior)), share * self._k / len(self._blocks)
        growing = (1.0 - weight) * self._prior + weight * unit
        # Swaps may mend a singular start, the more surely the smaller the ridge.
        for ridge in (0.0, RIDGE, 0.0, 1e-4 * RIDGE, 0.0):
            phi = grow_and_climb(
                self._kind, self._root, self._blocks, self._columns, growing,
                self._prior + ridge * unit, self._upper, len(self._required), chosen,
                size, climbs,
            )  # fmt: skip
            if not climbs or (not ridge and phi > -np.inf):
                break
            size = self._k
        return chosen, float(phi)

    def _random(self, count: int, seed: int) -> list[Indices]:
        from jaxcal.selection.exchange.starts import random_starts

        p = self._prior.shape[0]
        span = np.zeros((0, p))
        if self._known:
            values, vectors = np.linalg.eigh(self._prior)
            span = np.ascontiguousarray(vectors.T[values > 1e-6])
        return list(
            random_starts(
                self._blocks, self._upper[: len(self._blocks)], self._required, span,
                largest_rank(self._blocks), self._k, count, np.uint64(seed % 2**64),
            )
        )  # fmt: skip
