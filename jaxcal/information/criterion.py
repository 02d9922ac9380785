"""The criterion of a selection: one concave function of the information matrix.

``V = C M^-1 C.T`` is the covariance of the combinations ``C theta`` that matter, M the
information (p, p). Every criterion is written as a concave phi(M) to be maximised:

========  ===========================  ======  ===========================  ==========
kind      phi                          names   reported value               efficiency
========  ===========================  ======  ===========================  ==========
``det``   -log det V                   D, Ds   log det V^-1, larger better  e^((v-b)/s)
``trace`` -trace V                     A I As  trace V, smaller better      b / v
``least`` 1 / largest eigenvalue of V  E       the same, larger better      v / b
========  ===========================  ======  ===========================  ==========

v is the value of a selection, b that of the optimum or a bound on it, s the rows of C.
C is the identity for D, A and E, picks the parameters of interest for Ds and As, and
for I ``C.T @ C`` is the mean of ``J.T @ J`` over a region: V's trace is then the mean
variance of the predictions there.

Sources: Pukelsheim, Optimal Design of Experiments (concavity, subsets of parameters);
Atkinson, Donev and Tobias, Optimum Experimental Designs.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from jaxcal.information.blocks import significant

__all__ = ["Criterion"]

Array = NDArray[np.float64]


@dataclasses.dataclass(frozen=True, eq=False)
class Criterion:
    """A criterion in the coordinates of ``root``; the table above defines the kinds."""

    name: str  # "D", "A", ...
    kind: str  # "det", "trace" or "least"
    root: Array  # C (s, p), of full row rank; square for "least"
    times: int = 1  # how often log det V or trace V counts: outputs of equal blocks
    offset: float = 0.0  # added to phi of "det" where C was changed by a factor

    @property
    def larger_is_better(self) -> bool:
        """Of the reported value."""
        return self.kind != "trace"

    def value(self, information: Array) -> Array:
        """phi (...,) of information matrices (..., p, p); -inf where singular."""
        half, regular = self._half(information)
        if self.kind == "least":
            phi = np.linalg.norm(half, 2, axis=(-2, -1)) ** -2.0
        elif self.kind == "trace":
            phi = -(half * half).sum(axis=(-2, -1))
        else:
            phi = -np.linalg.slogdet(half @ np.matrix_transpose(half))[1]
        return np.where(regular, phi, -np.inf)

    def reported(self, phi: Array | float) -> Array | float:
        """The value as the caller reads it."""
        if self.kind == "det":
            return self.times * (phi + self.offset)
        return -self.times * phi if self.kind == "trace" else phi

    def efficiency(self, value: float, bound: float) -> float:
        """Share in (0, 1] of the best possible, of reported values."""
        if self.kind == "det":
            return float(np.exp((value - bound) / (self.times * len(self.root))))
        if value == bound:  # both may be zero: predictions that nothing depends on
            return 1.0
        return float(bound / value if self.kind == "trace" else value / bound)

    def bettered(self, value: float, share: float) -> float:
        """A reported value where every variance is smaller by ``share`` of itself."""
        if self.kind == "det":
            return value + self.times * len(self.root) * float(np.log1p(share))
        return value / (1.0 + share) if self.kind == "trace" else value * (1.0 + share)

    def enough(self, efficiency: float) -> tuple[float, float]:
        """A bound on phi of at most the first times phi, plus the second, proves it."""
        if self.kind == "det":
            return 1.0, -len(self.root) * float(np.log(efficiency))
        return (efficiency if self.kind == "trace" else 1.0 / efficiency), 0.0

    def _half(self, information: Array) -> tuple[Array, NDArray[np.bool_]]:
        """H (..., s, p) with ``H @ H.T = V``, and where M is not singular."""
        values, vectors = np.linalg.eigh(information)
        regular = significant(values, squares=True)[..., 0]
        scale = np.where(regular[..., None], values, 1.0)
        return self.root @ vectors / np.sqrt(scale)[..., None, :], regular
