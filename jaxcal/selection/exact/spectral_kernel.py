"""Compiled bounds that go by eigenvalues: E, and D, A, I and As of few readings.

E is 1 / the largest eigenvalue of V = C inverse(M) C.T, which double precision holds
where it does not hold the smallest one of inverse(V): commands far from zero. With v an
eigenvector of V, y = inverse(M) C.T v scaled to |C y| = 1 makes ``y.T M y`` its
reciprocal at M, and at every other M a bound on E. E is smoothed over all reciprocals,
``-log(sum of exp(-b l)) / b``; its gradient is a mean of such y y.T and so a bound too,
however good the smoothing is.

Where what is still to be chosen has fewer readings t than there are parameters: with
P what is chosen for certain, the rest N = M - P of a selection has rank t at most. Of
the eigenvalues l of N in the metric of P (of H N H.T, H P H.T = I) the smallest are
replaced by their total in equal shares among what is left of the t,

    F(N) = sum over the i largest of f(l) + (t - i) f(rest / (t - i)),

which is concave where f is, exact at every selection, and nowhere below the sum of f
over the t largest. ``f = log(1 + l)`` bounds D, beside log det P. Source: Li and Xie,
Best principal submatrix selection (the augmented factorization bound), 2023.

A, I and As are trace(W inverse(I + H N H.T)) with W = H C.T C H.T. For every mu >= 0,
W is at most (W - mu)+ + mu I, and I - inverse(I + H N H.T) is at most 1 and of rank t:

    trace >= trace((W - mu)+ inverse(I + H N H.T)) + sum of min(w, mu) - mu t
             + mu (sum of 1 / (1 + l) over the t places of F).

mu = 0 is the natural bound. At a given N the best mu is an eigenvalue of W, the first
whose eigenvector no longer finds room among the t readings: see :func:`share_out`.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import INNER
from jaxcal.selection.exact.eigen_kernel import FAST, eigen

__all__ = [
    "LEAST",
    "LOG_DET",
    "SHARES",
    "best_place",
    "evaluate_spectrum",
    "share_out",
    "spectral_hessian",
    "weigh",
    "whiten",
]

LEAST, LOG_DET, SHARES = range(3)

_EPS = float(np.finfo(np.float64).eps)
_ROUNDING = 1e-6  # of a reading, in what eigenvectors take
_SINGULAR = 1e-12  # least reciprocal of the condition of P


@njit(**FAST)
def whiten(known, half):
    """Fill H (p, p), lower triangular with ``H P H.T = I``; log det P.

    -inf where P is singular, by the product of trace(P) and trace(inverse(P)).
    """
    p = len(known)
    total, inverse = 0.0, 0.0
    log_det = 0.0
    for a in range(p):
        total += known[a, a]
        for b in range(a + 1):
            x = known[a, b]
            for c in range(b):
                x -= half[a, c] * half[b, c]
            if a == b:
                if not x > _SINGULAR * known[a, a]:
                    return -np.inf
                half[a, a] = np.sqrt(x)
                log_det += np.log(x)
            else:
                half[a, b] = x / half[b, b]
                half[b, a] = 0.0
    for a in range(p):  # the factor becomes its own inverse, row by row
        row = half[a]
        diagonal = row[a]
        for c in range(a):
            weight = row[c]
            row[c] = 0.0
            for b in range(c + 1):
                row[b] -= weight * half[c, b]
        row[a] = 1.0
        for b in range(a + 1):
            row[b] /= diagonal
            inverse += row[b] * row[b]
    return log_det if total * inverse * _SINGULAR < 1.0 else -np.inf


@njit(**FAST)
def _between(half, matrix, out):
    """``out = H matrix H.T`` of a symmetric matrix, H lower triangular."""
    p = len(half)
    row = np.empty(p)
    for a in range(p):
        for b in range(p):
            row[b] = 0.0
        for c in range(a + 1):
            weight = half[a, c]
            for b in range(p):
                row[b] += weight * matrix[c, b]
        for b in range(a + 1):
            total = 0.0
            for c in range(b + 1):
                total += row[c] * half[b, c]
            out[a, b] = total
            out[b, a] = total


@njit(**FAST)
def _back(half, vectors, out):
    """``out[a] = H.T vectors[a]``: eigenvectors in the coordinates of M."""
    p = len(half)
    for a in range(p):
        for b in range(p):
            out[a, b] = 0.0
        for c in range(p):
            weight = vectors[a, c]
            for b in range(c + 1):
                out[a, b] += weight * half[c, b]


@njit(inline="always")
def weigh(root, local):
    """Fill ``local.weights`` and ``local.lines``: w and ``v.T inverse(H)``, by rows.

    Then ``C.T C`` is the sum of w times the outer product of a row with itself.
    """
    s, p = root.shape
    matrix, vectors = np.zeros((p, p)), np.empty((p, p))
    for r in range(s):
        for a in range(p):
            for b in range(p):
                matrix[a, b] += root[r, a] * root[r, b]
    _between(local.half, matrix, vectors)
    for a in range(p):
        for b in range(p):
            matrix[a, b] = vectors[a, b]
    eigen(matrix, local.weights, vectors)
    _back(local.half, vectors, matrix)
    for a in range(p):
        for b in range(p):
            local.lines[a, b] = 0.0
        for c in range(p):
            for b in range(p):
                local.lines[a, b] += matrix[a, c] * local.known[c, b]


@njit(**INNER)
def share_out(local, place):
    """Let mu be the eigenvalue ``place`` of W (-1: none), and fill C and the constant.

    Returns:
        Whether the bound can be sharper than the natural one.
    """
    p = len(local.weights)
    settings = local.settings
    mu = local.weights[place] if place >= 0 else 0.0
    if not mu > p * _EPS * local.weights[p - 1]:
        return False
    size = 0
    constant = -mu * settings[2]
    for j in range(p - 1, -1, -1):
        if local.weights[j] > mu:
            constant += mu
            scale = np.sqrt(local.weights[j] - mu)
            for a in range(p):
                local.share[size, a] = scale * local.lines[j, a]
            size += 1
        else:
            constant += max(local.weights[j], 0.0)
    # Eigenvalues of W are rounded by p eps times the largest, t of them count.
    settings[3] = p * _EPS * local.weights[p - 1] * settings[2] - constant
    settings[4] = mu
    settings[5] = size
    return True


@njit(**INNER)
def best_place(local):
    """Of the eigenvalues of W the best mu at the present N; -1 for the natural bound.

    The bound is convex and piecewise linear in mu, with slope minus the total that the
    eigenvectors above mu lose by N, plus what F allows the t readings to take. At a
    whole selection several are best, and the largest serves its neighbours.
    """
    p = len(local.weights)
    allowed = local.settings[2] - local.settings[6]
    for j in range(p - 1, -1, -1):
        taken = 1.0
        for a in range(p):
            total = 0.0
            for b in range(p):
                total += local.inverse[a, b] * local.lines[j, b]
            taken -= local.lines[j, a] * total
        allowed -= taken
        if allowed < _ROUNDING * local.settings[2]:
            return j
    return -1


@njit(**FAST)
def _reach(root, inverse, out):
    """``out = C W`` (p, p)."""
    p = len(inverse)
    for a in range(p):
        for b in range(p):
            out[a, b] = 0.0
        for c in range(p):
            weight = root[a, c]
            for b in range(p):
                out[a, b] += weight * inverse[c, b]


@njit(**FAST)
def _weakest(root, inverse, values, vectors, rows):
    """Eigenvalues of V become the l, smallest first, and ``rows`` their y."""
    p = len(values)
    largest = values[p - 1]
    for a in range(p // 2):
        x = values[a]
        values[a] = values[p - 1 - a]
        values[p - 1 - a] = x
    for a in range(p):
        values[a] = 1.0 / max(values[a], _EPS * largest)
        row = rows[a]
        for c in range(p):
            row[c] = 0.0
        for b in range(p):  # C.T v, then W times it
            weight = 0.0
            for c in range(p):
                weight += vectors[p - 1 - a, c] * root[c, b]
            for c in range(p):
                row[c] += weight * inverse[b, c]
        length = 0.0
        for b in range(p):
            across = 0.0
            for c in range(p):
                across += root[b, c] * row[c]
            length += across * across
        scale = 1.0 / np.sqrt(length) if length > 0.0 else 0.0
        for c in range(p):
            row[c] *= scale


@njit(**FAST)
def evaluate_spectrum(kind, root, local):
    """Fill the gradient, and the basis and bend of the Hessian.

    Args:
        root: C (p, p) of LEAST.
        kind: LEAST: E at M, W being there. LOG_DET, SHARES: F at N in the metric of P,
            t and the constant in ``local.settings``; the f of SHARES is
            ``-mu / (1 + l)``.

    Returns:
        The value, and the value to which the linear gain is added for a bound.
    """
    p = len(local.gram)
    bend, tail, settings = local.bend, local.tail, local.settings
    gradient, basis = local.gradient, local.basis
    slopes, own, values = np.empty(p), np.empty(p), np.empty(p)
    vectors, rows = np.empty((p, p)), np.empty((p, p))
    value, base = 0.0, 0.0
    if kind == LEAST:
        _reach(root, local.inverse, rows)
        for a in range(p):
            for c in range(a + 1):
                total_ac = 0.0
                for d in range(p):
                    total_ac += rows[a, d] * root[c, d]
                bend[a, c] = total_ac
                bend[c, a] = total_ac
    else:
        _between(local.half, local.rest, bend)
    eigen(bend, values, vectors)
    if kind == LEAST:
        _weakest(root, local.inverse, values, vectors, rows)
        b = settings[1]
        total = 0.0
        for a in range(p):
            apart = values[a] - values[0]
            slopes[a] = np.exp(-b * apart) if apart > 0.0 else 1.0
            total += slopes[a]
        for a in range(p):
            slopes[a] /= total
            tail[a] = slopes[a]
            own[a] = -b * slopes[a]
            if slopes[a] > 0.0:
                for c in range(p):
                    across = 0.0
                    for d in range(p):
                        across += local.gram[c, d] * rows[a, d]
                    base += slopes[a] * across * rows[a, c]
        value = values[0] - np.log(total) / b
        settings[0] = b
    else:
        _back(local.half, vectors, rows)
        rest = 0.0
        for a in range(p):
            values[a] = max(values[a], 0.0)
            rest += values[a]
        places = int(settings[2])
        kept = 0
        shares, logs = 0.0, 0.0
        while kept < places - 1 and values[p - 1 - kept] * (places - kept) > rest:
            rest -= values[p - 1 - kept]
            logs += np.log1p(values[p - 1 - kept])
            shares += 1.0 / (1.0 + values[p - 1 - kept])
            kept += 1
        rest /= places - kept
        logs += (places - kept) * np.log1p(rest)
        shares += (places - kept) / (1.0 + rest)
        mu = settings[4] if kind == SHARES else 1.0
        value = settings[3] + (-mu * shares if kind == SHARES else logs)
        base = value + mu * p * _EPS * values[p - 1]  # what eigenvalues are rounded by
        for a in range(p):
            held = a >= p - kept
            x = 1.0 / (1.0 + (values[a] if held else rest))
            slopes[a] = mu * x * x if kind == SHARES else x
            own[a] = -(2.0 * mu * x if kind == SHARES else 1.0) * x * x
            tail[a] = 1.0
            if held:
                tail[a] = 0.0
            else:
                settings[0] = own[a] / (places - kept)
                own[a] = 0.0
        settings[6] = shares
    for a in range(p):
        for c in range(a):
            apart = values[a] - values[c]
            if apart > 1e-7 * values[a]:
                bend[a, c] = (slopes[a] - slopes[c]) / apart
            else:
                bend[a, c] = 0.5 * (own[a] + own[c])
        bend[a, a] = own[a]
        for c in range(p):
            basis[c, a] = rows[a, c]
            gradient[a, c] = 0.0
    for a in range(p):
        for b in range(p):
            weight = slopes[a] * rows[a, b]
            for c in range(p):
                gradient[b, c] += weight * rows[a, c]
    return value, base


@njit(**FAST)
def spectral_hessian(turned, local, out):
    """Add minus the Hessian of blocks turned into the basis V, (m, q, p)."""
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
            out[i, j] -= total
            if i != j:
                out[j, i] -= total
