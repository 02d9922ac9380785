"""Compiled eigenvalues and eigenvectors of small symmetric matrices.

Householder's reduction to tridiagonal form, then implicit QL steps (Wilkinson and
Reinsch, Handbook for Automatic Computation II/2 and II/3). For 40 parameters it takes a
third of the time of LAPACK's divide and conquer through numba, and less to compile.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from jaxcal.information.linear_algebra import INNER

__all__ = ["FAST", "eigen"]

FAST = INNER | {"fastmath": {"reassoc", "contract", "nsz"}}  # sums in any order

_EPS = float(np.finfo(np.float64).eps)
_MOST_STEPS = 60  # of one eigenvalue; two are usual


@njit(**FAST)
def eigen(matrix, values, vectors):
    """Fill ``values`` (p,), smallest first, and ``vectors`` (p, p), one a row.

    Args:
        matrix: (p, p) symmetric; it is overwritten.
    """
    p = len(values)
    beside, scale, pulled = np.zeros(p), np.zeros(p), np.empty(p)
    for k in range(p - 2):  # what is right of the diagonal becomes the reflector
        mirror = matrix[k, k + 1 :]
        m = len(mirror)
        length = 0.0
        for a in range(m):
            length += mirror[a] * mirror[a]
        if length == 0.0:
            continue
        first = mirror[0]
        beside[k] = -np.copysign(np.sqrt(length), first)
        mirror[0] = first - beside[k]
        scale[k] = 1.0 / (length - first * beside[k])
        across = 0.0
        for a in range(m):
            row = matrix[k + 1 + a, k + 1 :]
            total = 0.0
            for b in range(m):
                total += row[b] * mirror[b]
            pulled[a] = scale[k] * total
            across += pulled[a] * mirror[a]
        for a in range(m):
            pulled[a] -= 0.5 * scale[k] * across * mirror[a]
        for a in range(m):
            row = matrix[k + 1 + a, k + 1 :]
            x, y = mirror[a], pulled[a]
            for b in range(m):
                row[b] -= x * pulled[b] + y * mirror[b]
    if p > 1:
        beside[p - 2] = matrix[p - 2, p - 1]
    for a in range(p):
        values[a] = matrix[a, a]
        for b in range(p):
            vectors[a, b] = 1.0 if a == b else 0.0
    _tridiagonal(values, beside, vectors)
    for k in range(p - 3, -1, -1):
        mirror = matrix[k, k + 1 :]
        for a in range(p):
            row = vectors[a, k + 1 :]
            across = 0.0
            for b in range(len(mirror)):
                across += row[b] * mirror[b]
            across *= scale[k]
            for b in range(len(mirror)):
                row[b] -= across * mirror[b]


@njit(**FAST)
def _tridiagonal(values, beside, vectors):
    """Turn the diagonal (p,) into eigenvalues, and the rows of ``vectors`` with it.

    Args:
        values: (p,) diagonal, sorted eigenvalues in the end.
        beside: (p,) the entries beside it, the last 0; overwritten.
        vectors: (p, p) rows to rotate and sort with the eigenvalues.
    """
    p = len(values)
    for low in range(p):
        for _ in range(_MOST_STEPS):
            end = low
            while end < p - 1:
                size = abs(values[end]) + abs(values[end + 1])
                if abs(beside[end]) <= _EPS * size:
                    break
                end += 1
            if end == low:
                break
            g = (values[low + 1] - values[low]) / (2.0 * beside[low])
            g += np.copysign(np.sqrt(g * g + 1.0), g)
            g = values[end] - values[low] + beside[low] / g
            sine, cosine, shift = 1.0, 1.0, 0.0
            whole = True
            for i in range(end - 1, low - 1, -1):
                f, b = sine * beside[i], cosine * beside[i]
                r = np.sqrt(f * f + g * g)
                beside[i + 1] = r
                if r == 0.0:
                    values[i + 1] -= shift
                    whole = False
                    break
                sine, cosine = f / r, g / r
                g = values[i + 1] - shift
                r = (values[i] - g) * sine + 2.0 * cosine * b
                shift = sine * r
                values[i + 1] = g + shift
                g = cosine * r - b
                row, below = vectors[i], vectors[i + 1]
                for a in range(p):
                    x, y = row[a], below[a]
                    below[a] = sine * x + cosine * y
                    row[a] = cosine * x - sine * y
            if whole:
                values[low] -= shift
                beside[low] = g
            beside[end] = 0.0
    for a in range(p - 1):
        least = a
        for b in range(a + 1, p):
            if values[b] < values[least]:
                least = b
        if least != a:
            x = values[a]
            values[a] = values[least]
            values[least] = x
            for b in range(p):
                x = vectors[a, b]
                vectors[a, b] = vectors[least, b]
                vectors[least, b] = x
