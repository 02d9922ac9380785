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

from jaxcal.information.linear_algebra import factor

__all__ = [
    "DS",
    "FAST",
    "OPTIONS",
    "RANK",
    "TRACE",
    "D",
    "E",
    "Local",
    "Relaxation",
    "evaluate",
    "hessian",
]

D, DS, TRACE, E, RANK = range(5)  # RANK: D in its sharper form

_EPS = float(np.finfo(np.float64).eps)
# Inner functions: a caller that is compiled includes them, so they need no entry from
# Python; what has one place to be called from is inlined, which compiles it once.
OPTIONS = {
    "cache": True, "nogil": True, "error_model": "numpy", "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}  # fmt: skip
FAST = OPTIONS | {"fastmath": {"reassoc", "contract", "nsz"}}  # sums in any order


class Relaxation(NamedTuple):
    """What stays the same in all nodes of a search."""

    kind: int
    blocks: NDArray[np.float64]  # (M, q, p)
    prior: NDArray[np.float64]  # (p, p)
    root: NDArray[np.float64]  # (s, p) C of DS and TRACE
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
def _multiply(x, y, out):
    """``out = x @ y``."""
    for a in range(len(x)):
        for b in range(y.shape[1]):
            out[a, b] = 0.0
        for c in range(len(y)):
            weight = x[a, c]
            for b in range(y.shape[1]):
                out[a, b] += weight * y[c, b]


@njit(**OPTIONS)
def evaluate(kind, root, local):
    """Fill ``local`` at ``local.gram``.

    Returns:
        The value to climb by, -inf where M is singular, and the value to which the
        linear gain is added for a bound; they differ for E only.
    """
    if kind >= E:
        return _spectral(kind, local)
    value = factor(local.gram, local.inverse)
    if kind == D or not value > -np.inf:
        local.gradient[:] = local.inverse
        return value, value
    s, p = root.shape
    reach = np.empty((s, p))
    _multiply(root, local.inverse, reach)
    if kind == TRACE:
        value = 0.0
        for a in range(s):
            for b in range(p):
                value -= reach[a, b] * root[a, b]
        _multiply(reach.T.copy(), reach, local.gradient)
        return value, value
    covariance, precision = np.empty((s, s)), np.empty((s, s))
    _multiply(reach, root.T.copy(), covariance)
    value = -factor(covariance, precision)
    scaled = np.empty((s, p))
    _multiply(precision, reach, scaled)
    _multiply(reach.T.copy(), scaled, local.gradient)
    return value, value


@njit(inline="always")
def _spectral(kind, local):
    """:func:`evaluate` of E and RANK, by eigenvalues."""
    p = len(local.gram)
    bend, tail = local.bend, local.tail
    slopes = np.empty(p)
    if kind == E:
        values, vectors = np.linalg.eigh(local.gram)
        local.inverse[:] = vectors
        b = local.settings[1]
        for a in range(p):
            apart = values[a] - values[0]
            slopes[a] = np.exp(-b * apart) if apart > 0.0 else 1.0
        total = slopes.sum()
        slopes /= total
        value, base = values[0] - np.log(total) / b, (slopes * values).sum()
        tail[:] = slopes
        local.settings[0] = b
        own = -b * slopes
    else:
        left, extra = np.empty((p, p)), np.empty((p, p))
        _multiply(local.half, local.gram - local.known, left)
        _multiply(left, local.half.T.copy(), extra)
        values, vectors = np.linalg.eigh(extra)  # smallest first
        _multiply(local.half.T.copy(), vectors.copy(), local.inverse)
        values = np.maximum(values, 0.0)
        places = int(local.settings[2])
        kept = 0
        rest = values.sum()
        value = local.settings[3]
        while kept < places - 1 and values[p - 1 - kept] * (places - kept) > rest:
            rest -= values[p - 1 - kept]
            value += np.log1p(values[p - 1 - kept])
            kept += 1
        value += (places - kept) * np.log1p(rest / (places - kept))
        base = value + p * _EPS * values[p - 1]  # what eigenvalues are rounded by
        for a in range(p):
            held = a >= p - kept
            slopes[a] = 1.0 / (1.0 + (values[a] if held else rest / (places - kept)))
            tail[a] = 0.0 if held else slopes[a]
        local.settings[0] = -1.0 / (places - kept)
        own = np.where(tail == 0.0, -slopes * slopes, 0.0)
    for a in range(p):
        for c in range(a):
            apart = values[a] - values[c]
            if apart > 1e-7 * values[a]:
                bend[a, c] = (slopes[a] - slopes[c]) / apart
            else:
                bend[a, c] = 0.5 * (own[a] + own[c])
        bend[a, a] = own[a]
    _multiply(local.inverse * slopes, local.inverse.T.copy(), local.gradient)
    return value, base


@njit(**FAST)
def hessian(kind, blocks, which, local, out):
    """Fill ``out`` (m, m): minus the Hessian over the counts of ``which`` (m,)."""
    m, q, p = len(which), blocks.shape[1], blocks.shape[2]
    by_inverse = np.zeros((m, q, p))
    by_gradient = by_inverse
    if kind == DS or kind == TRACE:
        by_gradient = np.zeros((m, q, p))
    for i in range(m):
        for r in range(q):
            for a in range(p):
                weight = blocks[which[i], r, a]
                for b in range(p):
                    by_inverse[i, r, b] += weight * local.inverse[a, b]
                if kind == DS or kind == TRACE:
                    for b in range(p):
                        by_gradient[i, r, b] += weight * local.gradient[a, b]
    if kind >= E:
        _spectral_hessian(by_inverse, local, out)
        return
    for i in range(m):
        for j in range(i + 1):
            total = 0.0
            for s in range(q):
                for r in range(q):
                    y = 0.0
                    for a in range(p):
                        y += by_inverse[i, r, a] * blocks[which[j], s, a]
                    if kind == D:
                        total += y * y
                        continue
                    x = 0.0
                    for a in range(p):
                        x += by_gradient[i, r, a] * blocks[which[j], s, a]
                    total += 2.0 * x * y - (x * x if kind == DS else 0.0)
            out[i, j] = total
            out[j, i] = total


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
