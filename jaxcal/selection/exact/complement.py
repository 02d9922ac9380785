"""Choosing what is measured as choosing what is not, for D and few candidates.

With all that may be measured the information is P. Leaving out the blocks Z (r, p),
written in the metric of P, it is

    det(P - Z.T Z) = det P det(I - Z Z.T):                                         (1)

a principal minor of ``I - B P^-1 B.T`` of all candidates. With l its least eigenvalue,
that is ``l (I + F F.T)``, and (1) is a choice of the rows of F with a prior I, of

    log det P + r log l + log det(I + F.T F).                                      (2)

The bound of either problem is one of both. Where few candidates are left out, that of
(2) is sharper. Source: Anstreicher, Fampa, Lee and Williams, Maximum-entropy remote
sampling, 2001 (the complementary problem).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxcal.checks import Array, Indices
from jaxcal.selection.criteria import Criterion

_WIDEST = 2.0  # times as many readings as parameters: beyond, (2) is never sharper
_LARGEST = 400  # readings of all candidates
_LARGEST_ERROR = 5e-10  # of log det, by rounding: half of what is called proven
_EPS = 2.0**-52


@dataclasses.dataclass(frozen=True)
class Complement:
    """The choice of what is left out."""

    blocks: Array  # (N, q, N q - 1), of candidates that may be chosen or left out
    prior: Array
    criterion: Criterion
    which: Indices  # (N,) their places among the given
    most: Indices  # (M,) counts of everything
    left_out: int
    shift: float  # what phi is above phi of this choice
    rounding: float  # what both may be off by

    def start(self, counts: Indices) -> Indices:
        """(N,) of a selection (M,)."""
        return (self.most - counts)[self.which]

    def counts(self, left_out: Indices) -> Indices:
        """(..., M) of selections of what is left out (..., N)."""
        counts = np.broadcast_to(self.most, (*left_out.shape[:-1], len(self.most)))
        counts = counts.copy()
        counts[..., self.which] -= left_out
        return counts


def complement(
    blocks: Array,
    prior: Array,
    criterion: Criterion,
    lower: Indices,
    upper: Indices,
    k: int,
) -> Complement | None:
    """None where it does not apply: other criteria, replicates, many candidates, or
    what is singular without them, or nearly: rounding is then larger than a proof's."""
    which = np.flatnonzero(upper > lower)
    (_, q, p), size = blocks.shape, len(which) * blocks.shape[1]
    some = 1 < size <= min(_WIDEST * p, _LARGEST)
    if criterion.form != "det" or (upper - lower).max(initial=0) > 1 or not some:
        return None
    rows = np.sqrt(upper)[:, None, None] * blocks
    everything = prior + np.tensordot(rows, rows, ((0, 1), (0, 1)))
    triangle = np.linalg.cholesky(everything)
    turned = np.linalg.solve(triangle, blocks[which].reshape(size, p).T)
    values, vectors = np.linalg.eigh(np.eye(size) - turned.T @ turned)
    unit, missing, least = np.eye(size - 1), int(upper.sum()) - k, float(values[0])
    if not least > 0.0:
        return None
    # An error of the matrix counts by the inverse of a minor, trace at most this.
    rounding = _EPS * float((1.0 / values[: missing * q]).sum())
    if rounding > _LARGEST_ERROR:
        return None
    scale = np.sqrt((values[1:] - least).clip(0.0) / least)
    factors = np.ascontiguousarray(vectors[:, 1:] * scale)
    of_root = np.linalg.slogdet(np.array([everything, criterion.root]))[1]
    shift = of_root[0] - 2.0 * of_root[1] + missing * q * np.log(least)
    return Complement(
        factors.reshape(len(which), q, size - 1), unit, criterion.of_rows(unit), which,
        upper, missing, float(shift), rounding,
    )  # fmt: skip
