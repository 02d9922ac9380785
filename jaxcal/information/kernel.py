"""Compiled: blocks of one set centred, scaled, whitened; ``blocks`` says what for."""

# Products may be fused.

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.information.linear_algebra import (
    cholesky,
    copy,
    dot,
    invert_lower,
    multiply,
)
from cython.cimports.libc.math import INFINITY, fabs, log, sqrt

__all__ = ["centred", "scaled", "whitened"]

_EPS = cython.declare(cython.double, 2.0**-52)


def centred(given, usable, root_of):
    """Rows of blocks and prior (r, p), less what is the same in every block of a set.

    Args:
        given: (S, M, q, p) blocks of S sets.
        usable: (S, M) not zero where a block counts, the others are zero; None: all do.
        root_of: root of the prior.

    Returns:
        (S, M q + r, p) rows ``B - B @ shift``, (S, p) the largest entries of B, and
        (S, p, p) shift.
    """
    blocks: cython.const[cython.double][:, :, :, ::1] = np.ascontiguousarray(given)
    root: cython.const[cython.double][:, ::1] = np.ascontiguousarray(root_of)
    count, q, known = blocks.shape[1], blocks.shape[2], root.shape[0]
    p: cython.int = blocks.shape[3]
    n: cython.Py_ssize_t
    i: cython.Py_ssize_t
    r: cython.Py_ssize_t
    a: cython.Py_ssize_t
    seen: cython.const[cython.uchar][:, ::1] = usable
    stacked = np.zeros((blocks.shape[0], count * q + known, p))
    sizes = np.zeros((blocks.shape[0], p))
    shifted = np.zeros((blocks.shape[0], p, p))
    all_rows: cython.double[:, :, ::1] = stacked
    all_largest: cython.double[:, ::1] = sizes
    shifts: cython.double[:, :, ::1] = shifted
    # The first block, zero where others differ, the sum of the others, where they do.
    constant: cython.double[:, ::1] = np.empty((q, p))
    total: cython.double[:, ::1] = np.empty((q, p))
    differs: cython.double[::1] = np.empty(p)
    for n in range(blocks.shape[0]):
        rows, largest, shift = all_rows[n], all_largest[n], shifts[n]
        first: cython.Py_ssize_t = -1
        number: cython.Py_ssize_t = 0
        total[:, :] = 0.0
        differs[:] = 0.0
        for i in range(count):
            if seen is not None and not seen[n, i]:
                continue
            first = i if first < 0 else first
            number += 1
            for r in range(q):
                for a in range(p):
                    x: cython.double = blocks[n, i, r, a]
                    rows[i * q + r, a] = x
                    total[r, a] += x
                    largest[a] = max(largest[a], fabs(x))
                    if x != blocks[n, first, r, a]:
                        differs[a] = 1.0
        some: cython.double = 0.0
        moving: cython.double = 0.0
        for a in range(p if number else 0):
            moving += differs[a]
            for r in range(q):
                constant[r, a] = 0.0 if differs[a] else blocks[n, first, r, a]
                some += constant[r, a] * constant[r, a]
                total[r, a] *= differs[a] / number
        if some > 0.0 and moving:
            if q == 1:
                for a in range(p):
                    for b in range(p):
                        shift[a, b] = constant[0, a] / some * total[0, b]
            else:
                shifted[n] = np.linalg.pinv(constant) @ np.asarray(total)
            for r in range(q):
                for b in range(p):
                    total[r, b] = 0.0
                    for a in range(p):
                        total[r, b] += constant[r, a] * shift[a, b]
            for i in range(count):
                if seen is None or seen[n, i]:
                    for r in range(q):
                        for a in range(p):
                            rows[i * q + r, a] -= total[r, a]
        for i in range(known):
            for a in range(p):
                largest[a] = max(largest[a], fabs(root[i, a]))
                x = root[i, a]
                for b in range(p):
                    x -= root[i, b] * shift[b, a]
                rows[count * q + i, a] = x
    return stacked, sizes, shifted


def scaled(given, sizes, count: cython.Py_ssize_t):
    """Lengths of columns (S, R, p) of S sets, and the volume they span.

    Args:
        given, sizes: the columns, and (S, p) the largest entries before centring.
        count: rows that rounding errors add up over.

    Returns:
        (S, p) lengths, zero where a column is rounding; (S,) of the share that is
        rounding; of the least distance of a unit column to the span of those before it;
        and log det of ``columns.T @ columns``, of those that are no rounding.
    """
    columns: cython.const[cython.double][:, :, ::1] = given
    largest: cython.const[cython.double][:, ::1] = sizes
    num_rows, p = columns.shape[1], columns.shape[2]
    n: cython.Py_ssize_t
    a: cython.Py_ssize_t
    b: cython.Py_ssize_t
    i: cython.Py_ssize_t
    # Columns are turned into rows, and those made orthogonal one after the other.
    turned: cython.double[:, ::1] = np.empty((p, num_rows))
    lengths, found = np.zeros((columns.shape[0], p)), np.empty((3, columns.shape[0]))
    norms: cython.double[:, ::1] = lengths
    judged: cython.double[:, ::1] = found
    size = cython.cast(cython.int, num_rows)
    resolution = _EPS * max(count, 1)
    for n in range(columns.shape[0]):
        rounding: cython.double = 8.0
        for a in range(p):
            for i in range(num_rows):
                turned[a, i] = columns[n, i, a]
            row = cython.address(turned[a, 0])
            length = sqrt(dot(row, row, size))
            norms[n, a] = length if length > resolution * largest[n, a] else 0.0
            for i in range(num_rows):
                turned[a, i] = turned[a, i] / length if norms[n, a] > 0.0 else 0.0
            if norms[n, a] > 0.0:
                rounding = max(rounding, largest[n, a] / norms[n, a])
        least: cython.double = 1.0 if num_rows >= p else 0.0
        value: cython.double = 0.0
        for a in range(p):
            row = cython.address(turned[a, 0])
            length = sqrt(dot(row, row, size))
            least = min(least, length)
            if length > 0.0:
                value += 2.0 * log(length * norms[n, a])
                for b in range(a + 1, p):
                    other = cython.address(turned[b, 0])
                    along = dot(row, other, size) / (length * length)
                    for i in range(num_rows):
                        other[i] -= along * row[i]
        judged[0, n], judged[1, n], judged[2, n] = resolution * rounding, least, value
    return lengths, found[0].tolist(), found[1].tolist(), found[2]


def whitened(blocks, usable, root, coarse: cython.double):
    """Blocks and prior of ``centred`` where their information is the identity.

    By Cholesky's factor of ``rows.T @ rows``, the cheapest, which loses as much again.

    Args:
        coarse: how many times coarser than float64 the numbers are.

    Returns:
        What ``centred`` does; of every set (M q + r, p) the rows in these coordinates;
        (p, p) the triangle that takes them back; what takes blocks there; log det of
        ``rows.T @ rows``; the share of orthogonality lost, infinite where columns may
        be dependent.
    """
    stacked, sizes, shifted = centred(blocks, usable, root)
    rows: cython.double[:, :, ::1] = stacked
    largest: cython.double[:, ::1] = sizes
    sets, count = rows.shape[0], cython.cast(cython.int, rows.shape[1])
    p: cython.int = rows.shape[2]
    out, inverses = np.empty((sets, count, p)), np.empty((sets, p, p))
    triangles, found = np.zeros((sets, p, p)), np.zeros((2, sets))
    white: cython.double[:, :, ::1] = out
    back: cython.double[:, :, ::1] = triangles
    shift: cython.double[:, :, ::1] = shifted
    basis: cython.double[:, :, ::1] = inverses
    judged: cython.double[:, ::1] = found
    room: cython.double[:, ::1] = np.zeros((p + 1, p))
    lower, scale = cython.address(room[0, 0]), cython.address(room[p, 0])
    n: cython.Py_ssize_t
    for n in range(sets):
        first = cython.address(rows[n, 0, 0])
        gram = cython.address(basis[n, 0, 0])
        log_det: cython.double = 0.0
        clear: cython.bint = True
        judged[1, n] = INFINITY
        multiply(True, False, p, p, count, first, first, gram)
        for a in range(p):
            scale[a] = sqrt(gram[a * p + a])
            clear = clear and scale[a] > 1e-6 * coarse * largest[n, a]
        if clear:
            for a in range(p):
                log_det += 2.0 * log(scale[a])
                for b in range(a + 1):
                    lower[a * p + b] = gram[a * p + b] / (scale[a] * scale[b])
            log_det += cholesky(lower, lower, p, 0.0)
            clear = log_det > -INFINITY
        for a in range(p if clear else 0):  # reciprocals of the diagonal
            clear = clear and lower[a * p + a] < 1e6
        if not clear:
            continue
        for a in range(p):
            back[n, a, a] = scale[a] / lower[a * p + a]
            for b in range(a):
                back[n, b, a] = lower[a * p + b] * scale[a]
        invert_lower(lower, p)
        judged[0, n], judged[1, n] = log_det, _EPS * dot(lower, lower, p * p)
        for a in range(p):
            for b in range(p):
                gram[a * p + b] = lower[b * p + a] / scale[a]
        multiply(False, False, count, p, p, first, gram, cython.address(white[n, 0, 0]))
        copy(lower, gram, p * p)
        for a in range(p):
            for b in range(p):
                for c in range(p):
                    gram[a * p + b] -= shift[n, a, c] * lower[c * p + b]
    return stacked, sizes, shifted, out, triangles, inverses, *found.tolist()
