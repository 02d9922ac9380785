"""Compiled value, gradient and curvature of a criterion at fractional counts.

At information M the gradient G gives candidate i its leverage ``trace(B_i G B_i.T)``,
and the Hessian over the counts is, with W = inverse(M) and <.,.> the entrywise product,

    D       -|X|^2           X = B_i W B_j.T
    Ds      |X|^2 - 2 <X, Y> X = B_i G B_j.T, Y = B_i W B_j.T
    A I As  -2 <X, Y>        the same.

E and the sharper forms of D and of A I As, for few readings, go by eigenvalues:
:mod:`jaxcal.selection.exact.spectral_kernel`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from jaxcal.information.linear_algebra import INNER, factor
from jaxcal.selection.exact.eigen_kernel import FAST
from jaxcal.selection.exact.spectral_kernel import (
    LEAST,
    LOG_DET,
    SHARES,
    evaluate_spectrum,
    spectral_hessian,
)

__all__ = [
    "DS",
    "RANK",
    "RANK_TRACE",
    "TRACE",
    "D",
    "E",
    "Local",
    "Relaxation",
    "evaluate",
    "hessian",
    "new_local",
]

D, DS, TRACE, E, RANK, RANK_TRACE = range(6)  # RANK: D and TRACE in a sharper form


class Relaxation(NamedTuple):
    """What stays the same in all nodes of a search."""

    kind: int
    blocks: NDArray[np.float64]  # (M, q, p)
    prior: NDArray[np.float64]  # (p, p)
    root: NDArray[np.float64] | None  # (s, p) C of DS, TRACE and E; None: D, never RANK
    k: int  # selections in all
    rank: int  # of one block, at most


class Local(NamedTuple):
    """Where the relaxation is; :func:`evaluate` fills what it needs."""

    known: NDArray[np.float64]  # (p, p) P, the prior and what the node has chosen
    rest: NDArray[np.float64]  # (p, p) N, the information of the other counts
    gram: NDArray[np.float64]  # (p, p) M = P + N
    gradient: NDArray[np.float64]  # (p, p) G
    inverse: NDArray[np.float64]  # (p, p) W
    reach: NDArray[np.float64]  # (p, p) G of the covariance alone
    half: NDArray[np.float64]  # (p, p) H of RANK with H P H.T = I, lower triangular
    basis: NDArray[np.float64]  # (p, p) V of E and RANK, G = V diag V.T
    bend: NDArray[np.float64]  # (p, p) curvature in that basis
    tail: NDArray[np.float64]  # (p,) direction of its last, rank-one part
    lines: NDArray[np.float64]  # (p, p) eigenvectors that make up C, in rows
    share: NDArray[np.float64]  # (p, p) C of RANK_TRACE; only its first rows count
    weights: NDArray[np.float64]  # (p,) w of the eigenvectors, smallest first
    settings: NDArray[np.float64]  # (7,) the tail's weight, b of E, t, constant, mu, s,
    # and the sum of the shares 1 / (1 + l)


@njit(inline="always")
def new_local(p):
    square = np.zeros((11, p, p))
    return Local(
        square[0], square[1], square[2], square[3], square[4], square[5], square[6],
        square[7], square[8], np.empty(p), square[9], square[10], np.empty(p),
        np.zeros(7),
    )  # fmt: skip


@njit(**INNER)
def evaluate(kind, root, local):
    """Fill ``local`` at its P, N and M.

    Returns:
        The value to climb by, -inf where M is singular, and the value to which the
        linear gain is added for a bound; they differ by rounding, and for E.
    """
    inverse, gradient = local.inverse, local.gradient
    value, base = 0.0, 0.0
    if root is None:
        value = factor(local.gram, gradient)
        return value, value
    if kind == E:
        if not factor(local.gram, inverse) > -np.inf:
            return -np.inf, -np.inf
    elif kind != RANK:
        value = factor(local.gram, inverse)
        base = value
        if kind == D or not value > -np.inf:
            for a in range(len(inverse)):
                for b in range(len(inverse)):
                    gradient[a, b] = inverse[a, b]
            return value, value
        few = kind == RANK_TRACE
        rows = local.share[: int(local.settings[5])] if few else root
        value = _covariance(kind, rows, inverse, local.reach if few else gradient)
        base = value
    if kind >= E:
        form = LEAST if kind == E else LOG_DET if kind == RANK else SHARES
        other, bound = evaluate_spectrum(form, root, local)
        value, base = value + other, base + bound
        if kind == RANK_TRACE:
            for a in range(len(inverse)):
                for b in range(len(inverse)):
                    gradient[a, b] += local.reach[a, b]
    return value, base


@njit(**FAST)
def _covariance(kind, root, inverse, gradient):
    """Value of DS and TRACE, W being there, and their gradient."""
    s, p = root.shape
    reach, scaled = np.zeros((s, p)), np.zeros((s, p))
    covariance, precision = np.empty((s, s)), np.zeros((s, s))
    value = 0.0
    for r in range(s):
        for a in range(p):
            for b in range(p):
                reach[r, b] += root[r, a] * inverse[a, b]
        for a in range(p):
            value -= root[r, a] * reach[r, a]
    if kind == DS:
        for r in range(s):
            for t in range(s):
                total = 0.0
                for a in range(p):
                    total += root[r, a] * reach[t, a]
                covariance[r, t] = total
        value = -factor(covariance, precision)
        for r in range(s):
            for t in range(s):
                for a in range(p):
                    scaled[r, a] += precision[r, t] * reach[t, a]
    for a in range(p):
        for b in range(p):
            gradient[a, b] = 0.0
    for r in range(s):
        for a in range(p):
            weight = scaled[r, a] if kind == DS else reach[r, a]
            for b in range(p):
                gradient[a, b] += weight * reach[r, b]
    return value


@njit(**FAST)
def hessian(kind, root, blocks, which, local, out):
    """Fill ``out`` (m, m): minus the Hessian over the counts of ``which`` (m,)."""
    m = len(which)
    for i in range(m):
        for j in range(m):
            out[i, j] = 0.0
    if root is None:
        turned = _turned(blocks, which, local.gradient)
        other = turned
    else:
        if kind >= E:
            spectral_hessian(_turned(blocks, which, local.basis), local, out)
            if kind != RANK_TRACE:
                return
        turned = _turned(blocks, which, local.inverse)
        few = kind == RANK_TRACE
        other = _turned(blocks, which, local.reach if few else local.gradient)
    _, q, p = turned.shape
    for i in range(m):
        for j in range(i + 1):
            total = 0.0
            for s in range(q):
                for r in range(q):
                    y = 0.0
                    for a in range(p):
                        y += turned[i, r, a] * blocks[which[j], s, a]
                    if root is None or kind == D:
                        total += y * y
                    else:
                        x = 0.0
                        for a in range(p):
                            x += other[i, r, a] * blocks[which[j], s, a]
                        total += 2.0 * x * y - (x * x if kind == DS else 0.0)
            out[i, j] += total
            out[j, i] = out[i, j]


@njit(**FAST)
def _turned(blocks, which, matrix):
    """``B_i @ matrix`` (m, q, p) of the blocks of ``which``."""
    _, q, p = blocks.shape
    turned = np.zeros((len(which), q, p))
    for i in range(len(which)):
        for r in range(q):
            for a in range(p):
                weight = blocks[which[i], r, a]
                for b in range(p):
                    turned[i, r, b] += weight * matrix[a, b]
    return turned
