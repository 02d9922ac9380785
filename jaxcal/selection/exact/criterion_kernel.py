"""Compiled value, gradient and curvature of a criterion at fractional counts.

At information M the gradient G gives candidate i its leverage ``trace(B_i G B_i.T)``,
and the Hessian over the counts is, with W = inverse(M) and <.,.> the entrywise product,

    D       -|X|^2           X = B_i W B_j.T
    Ds      |X|^2 - 2 <X, Y> X = B_i G B_j.T, Y = B_i W B_j.T
    A I As  -2 <X, Y>        the same.

E is smoothed, ``-log(trace exp(-b M)) / b``; its gradient is a Z >= 0 of trace 1 and
so a bound trace(Z M) on the smallest eigenvalue, however good the smoothing is.

D has a sharper form where what is still to be chosen has fewer readings t than there
are parameters: with P what is chosen for certain, the rest N = M - P of a selection has
rank t at most, and of the eigenvalues l of N in the metric of P the smallest are
replaced by their total in equal shares among what is left of the t,

    log det P + sum over the i largest of log(1 + l) + (t - i) log(1 + rest / (t - i)),

which is concave, exact at every selection, and nowhere above log det M. Source: Li and
Xie, Best principal submatrix selection (the augmented factorization bound), 2023.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from jaxcal.information.linear_algebra import INNER, factor

__all__ = [
    "DS",
    "FAST",
    "RANK",
    "TRACE",
    "D",
    "E",
    "Local",
    "Relaxation",
    "eigen",
    "evaluate",
    "hessian",
]

D, DS, TRACE, E, RANK = range(5)  # RANK: D in its sharper form

_EPS = float(np.finfo(np.float64).eps)
FAST = INNER | {"fastmath": {"reassoc", "contract", "nsz"}}  # sums in any order


class Relaxation(NamedTuple):
    """What stays the same in all nodes of a search."""

    kind: int
    blocks: NDArray[np.float64]  # (M, q, p)
    prior: NDArray[np.float64]  # (p, p)
    root: NDArray[np.float64] | None  # (s, p) C of DS and TRACE; None: D, never RANK
    k: int  # selections in all
    rank: int  # of one block, at most


class Local(NamedTuple):
    """Where the relaxation is; all arrays are filled by :func:`evaluate`."""

    gram: NDArray[np.float64]  # (p, p) M
    gradient: NDArray[np.float64]  # (p, p) G
    inverse: NDArray[np.float64]  # (p, p) W; of E and RANK a basis V, G = V diag V.T
    bend: NDArray[np.float64]  # (p, p) curvature in that basis
    tail: NDArray[np.float64]  # (p,) direction of its last, rank-one part
    known: NDArray[np.float64]  # (p, p) P of RANK
    half: NDArray[np.float64]  # (p, p) H of RANK with H P H.T = I
    settings: NDArray[np.float64]  # (4,) weight of the tail, b of E, t, log det P


@njit(**FAST)
def _dots(x, y, out):
    """``out = x @ y.T``."""
    for a in range(len(x)):
        for b in range(len(y)):
            total = 0.0
            for c in range(x.shape[1]):
                total += x[a, c] * y[b, c]
            out[a, b] = total


@njit(**INNER)
def eigen(matrix, values, vectors):
    """Eigenvalues, smallest first, and eigenvectors in rows; loops copy them.

    A slice assignment of two axes takes numba seconds to compile.
    """
    found, columns = np.linalg.eigh(matrix)
    for a in range(len(values)):
        values[a] = found[a]
        for b in range(len(values)):
            vectors[a, b] = columns[b, a]


@njit(**INNER)
def evaluate(kind, root, local):
    """Fill ``local`` at ``local.gram``.

    Returns:
        The value to climb by, -inf where M is singular, and the value to which the
        linear gain is added for a bound; they differ for E only.
    """
    inverse, gradient = local.inverse, local.gradient
    if root is not None and kind >= E:
        return _spectral(kind, local)
    value = factor(local.gram, inverse)
    if root is None or kind == D or not value > -np.inf:
        for a in range(len(inverse)):
            for b in range(len(inverse)):
                gradient[a, b] = inverse[a, b]
        return value, value
    return _covariance(kind, root, local)


@njit(inline="always")
def _covariance(kind, root, local):
    """:func:`evaluate` of DS and TRACE, W being there."""
    inverse, gradient = local.inverse, local.gradient
    s, p = root.shape
    reach, scaled = np.empty((p, s)), np.empty((p, s))
    _dots(inverse, root, reach)
    covariance, precision = np.empty((s, s)), np.empty((s, s))
    value = 0.0
    for r in range(s):
        for t in range(s):
            covariance[r, t] = 0.0
            precision[r, t] = 1.0 if r == t else 0.0
            for a in range(p):
                covariance[r, t] += root[r, a] * reach[a, t]
        value -= covariance[r, r]
    if kind == DS:
        value = -factor(covariance, precision)
    _dots(reach, precision, scaled)
    _dots(scaled, reach, gradient)
    return value, value


@njit(inline="always")
def _spectral(kind, local):
    """:func:`evaluate` of E and RANK, by eigenvalues."""
    p = len(local.gram)
    bend, tail, settings = local.bend, local.tail, local.settings
    basis, gradient = local.inverse, local.gradient
    slopes, own, values = np.empty(p), np.empty(p), np.empty(p)
    vectors = np.empty((p, p))
    value, base = 0.0, 0.0
    if kind == E:
        eigen(local.gram, values, vectors)
        b = settings[1]
        total = 0.0
        for a in range(p):
            apart = values[a] - values[0]
            slopes[a] = np.exp(-b * apart) if apart > 0.0 else 1.0
            total += slopes[a]
        for a in range(p):
            slopes[a] /= total
            base += slopes[a] * values[a]
            tail[a] = slopes[a]
            own[a] = -b * slopes[a]
            for c in range(p):
                basis[a, c] = vectors[c, a]
        value = values[0] - np.log(total) / b
        settings[0] = b
    else:
        for a in range(p):
            for c in range(p):
                bend[a, c] = local.gram[a, c] - local.known[a, c]
        _dots(local.half, bend, basis)
        _dots(basis, local.half, bend)
        eigen(bend, values, vectors)
        rest = 0.0
        for a in range(p):
            values[a] = max(values[a], 0.0)
            rest += values[a]
            for c in range(p):
                basis[a, c] = 0.0
                for d in range(p):
                    basis[a, c] += local.half[d, a] * vectors[c, d]
        places = int(settings[2])
        kept = 0
        value = settings[3]
        while kept < places - 1 and values[p - 1 - kept] * (places - kept) > rest:
            rest -= values[p - 1 - kept]
            value += np.log1p(values[p - 1 - kept])
            kept += 1
        rest /= places - kept
        value += (places - kept) * np.log1p(rest)
        base = value + p * _EPS * values[p - 1]  # what eigenvalues are rounded by
        for a in range(p):
            held = a >= p - kept
            slopes[a] = 1.0 / (1.0 + (values[a] if held else rest))
            tail[a] = 0.0 if held else slopes[a]
            own[a] = -slopes[a] * slopes[a] if held else 0.0
        settings[0] = -1.0 / (places - kept)
    for a in range(p):
        for c in range(a):
            apart = values[a] - values[c]
            if apart > 1e-7 * values[a]:
                bend[a, c] = (slopes[a] - slopes[c]) / apart
            else:
                bend[a, c] = 0.5 * (own[a] + own[c])
        bend[a, a] = own[a]
        for c in range(p):
            vectors[a, c] = basis[a, c] * slopes[c]
    _dots(vectors, basis, gradient)
    return value, base


@njit(**FAST)
def hessian(kind, root, blocks, which, local, out):
    """Fill ``out`` (m, m): minus the Hessian over the counts of ``which`` (m,)."""
    m = len(which)
    turned = _turned(blocks, which, local.inverse)
    if root is not None and kind >= E:
        _spectral_hessian(turned, local, out)
        return
    other = turned
    if root is not None and kind != D:
        other = _turned(blocks, which, local.gradient)
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
            out[i, j] = total
            out[j, i] = total


@njit(**INNER)
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


@njit(**FAST)
def _spectral_hessian(turned, local, out):
    """:func:`hessian` of blocks turned into the basis V, (m, q, p)."""
    m, q, p = turned.shape
    size = p * (p + 1) // 2
    plain, bent = np.zeros((m, size)), np.empty((m, size))
    ends = np.zeros(m)
    for i in range(m):
        at = 0
        for a in range(p):
            for c in range(a + 1):
                for r in range(q):
                    plain[i, at] += turned[i, r, a] * turned[i, r, c]
                bent[i, at] = plain[i, at] * local.bend[a, c] * (1 if a == c else 2)
                at += 1
            ends[i] += local.tail[a] * plain[i, at - 1]
    for i in range(m):
        for j in range(i + 1):
            total = local.settings[0] * ends[i] * ends[j]
            for at in range(size):
                total += plain[i, at] * bent[j, at]
            out[i, j] = -total
            out[j, i] = -total
