"""Compiled: blocks of one set centred, scaled, whitened; ``blocks`` says what for."""

# Products may be fused.

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.information.linear_algebra import (
    cholesky,
    dot,
    invert_lower,
    multiply,
)
from cython.cimports.libc.math import INFINITY, fabs, log, sqrt

__all__ = ["centred", "scaled", "whitened"]

_EPS = cython.declare(cython.double, 2.0**-52)


def centred(given, usable, root_of):
    """Rows of blocks (M, q, p) and prior (r, p), less what is the same in every block.

    Args:
        given, root_of: blocks and root of the prior.
        usable: (M,) not zero where a block counts, the others are zero; None: all do.

    Returns:
        (M q + r, p) rows ``B - B @ shift``, (p,) the largest entries of B, and (p, p)
        shift.
    """
    blocks: cython.const[cython.double][:, :, ::1] = np.ascontiguousarray(given)
    root: cython.const[cython.double][:, ::1] = np.ascontiguousarray(root_of)
    count, q = blocks.shape[0], blocks.shape[1]
    p: cython.int = blocks.shape[2]
    i: cython.Py_ssize_t
    r: cython.Py_ssize_t
    a: cython.Py_ssize_t
    seen: cython.const[cython.uchar][::1] = usable
    first: cython.Py_ssize_t = -1
    number: cython.Py_ssize_t = 0
    stacked = np.zeros((count * q + root.shape[0], p))
    rows: cython.double[:, ::1] = stacked
    # The first block, zero where others differ, and the sum of the others.
    numbers: cython.double[:, :, ::1] = np.zeros((2, q, p))
    constant, total = numbers[0], numbers[1]
    sizes, shifted = np.zeros(p), np.zeros((p, p))
    largest: cython.double[::1] = sizes
    differs: cython.double[::1] = np.zeros(p)
    shift: cython.double[:, ::1] = shifted
    for i in range(count):
        if seen is not None and not seen[i]:
            continue
        first = i if first < 0 else first
        number += 1
        for r in range(q):
            for a in range(p):
                x: cython.double = blocks[i, r, a]
                rows[i * q + r, a] = x
                total[r, a] += x
                largest[a] = max(largest[a], fabs(x))
                if x != blocks[first, r, a]:
                    differs[a] = 1.0
    some: cython.double = 0.0

    moving: cython.double = 0.0
    for a in range(p if number else 0):
        moving += differs[a]
        for r in range(q):
            constant[r, a] = 0.0 if differs[a] else blocks[first, r, a]
            some += constant[r, a] * constant[r, a]
            total[r, a] *= differs[a] / number
    if some > 0.0 and moving:
        if q == 1:
            for a in range(p):
                for b in range(p):
                    shift[a, b] = constant[0, a] / some * total[0, b]
        else:
            shifted = np.linalg.pinv(constant) @ np.asarray(total)
            shift = shifted
        for r in range(q):
            for b in range(p):
                total[r, b] = 0.0
                for a in range(p):
                    total[r, b] += constant[r, a] * shift[a, b]
        for i in range(count):
            if seen is None or seen[i]:
                for r in range(q):
                    for a in range(p):
                        rows[i * q + r, a] -= total[r, a]
    if root.shape[0]:
        last = cython.address(rows[count * q, 0])
        multiply(
            False, False, cython.cast(cython.int, root.shape[0]), p, p,
            cython.address(root[0, 0]), cython.address(shift[0, 0]), last,
        )  # fmt: skip
    for i in range(root.shape[0]):
        for a in range(p):
            largest[a] = max(largest[a], fabs(root[i, a]))
            rows[count * q + i, a] = root[i, a] - rows[count * q + i, a]
    return stacked, sizes, shifted


def scaled(
    columns: cython.const[cython.double][:, ::1],
    largest: cython.const[cython.double][::1],
    count: cython.Py_ssize_t,
):
    """Lengths of columns (R, p), and the volume they span.

    Args:
        largest: (p,) of their entries before centring.
        count: rows that rounding errors add up over.

    Returns:
        (p,) lengths, zero where a column is rounding; the share that is rounding; the
        least distance of a unit column to the span of those before it; log det of
        ``columns.T @ columns``, of those that are no rounding.
    """
    num_rows, p = columns.shape[0], columns.shape[1]
    a: cython.Py_ssize_t
    b: cython.Py_ssize_t
    i: cython.Py_ssize_t
    # Columns are turned into rows, and those made orthogonal one after the other.
    turned: cython.double[:, ::1] = np.empty((p, num_rows))
    lengths = np.zeros(p)
    norms: cython.double[::1] = lengths
    size = cython.cast(cython.int, num_rows)
    resolution = _EPS * max(count, 1)
    rounding: cython.double = 8.0
    for a in range(p):
        for i in range(num_rows):
            turned[a, i] = columns[i, a]
        row = cython.address(turned[a, 0])
        length = sqrt(dot(row, row, size))
        norms[a] = length if length > resolution * largest[a] else 0.0
        for i in range(num_rows):
            turned[a, i] = turned[a, i] / length if norms[a] > 0.0 else 0.0
        if norms[a] > 0.0:
            rounding = max(rounding, largest[a] / norms[a])
    least: cython.double = 1.0
    value: cython.double = 0.0
    for a in range(p):
        row = cython.address(turned[a, 0])
        length = sqrt(dot(row, row, size))
        least = min(least, length)
        if length > 0.0:
            value += 2.0 * log(length * norms[a])
            for b in range(a + 1, p):
                other = cython.address(turned[b, 0])
                along = dot(row, other, size) / (length * length)
                for i in range(num_rows):
                    other[i] -= along * row[i]
    if num_rows < p:
        least = 0.0
    return lengths, resolution * rounding, least, value


def whitened(blocks, usable, root, coarse: cython.double):
    """Blocks and prior of ``centred`` where their information is the identity.

    By Cholesky's factor of ``rows.T @ rows``, the cheapest, which loses as much again.

    Args:
        coarse: how many times coarser than float64 the numbers are.

    Returns:
        What ``centred`` does; (M q + r, p) the rows in these coordinates; (p, p) the
        triangle that takes them back; its inverse; log det of ``rows.T @ rows``; the
        share of orthogonality lost, infinite where columns may be dependent.
    """
    stacked, sizes, shifted = centred(blocks, usable, root)
    rows: cython.double[:, ::1] = stacked
    largest: cython.double[::1] = sizes
    count: cython.int = rows.shape[0]
    p: cython.int = rows.shape[1]
    out, triangle, inverse = np.empty((count, p)), np.zeros((p, p)), np.empty((p, p))
    white: cython.double[:, ::1] = out
    back: cython.double[:, ::1] = triangle
    basis: cython.double[:, ::1] = inverse
    room: cython.double[:, ::1] = np.zeros((p + 1, p))
    lower, scale = cython.address(room[0, 0]), cython.address(room[p, 0])
    first = cython.address(rows[0, 0])
    gram = cython.address(basis[0, 0])
    log_det: cython.double = 0.0
    lost: cython.double = INFINITY
    clear: cython.bint = True
    multiply(True, False, p, p, count, first, first, gram)
    for a in range(p):
        scale[a] = sqrt(basis[a, a])
        clear = clear and scale[a] > 1e-6 * coarse * largest[a]
    if clear:
        for a in range(p):
            log_det += 2.0 * log(scale[a])
            for b in range(a + 1):
                lower[a * p + b] = basis[a, b] / (scale[a] * scale[b])
        log_det += cholesky(lower, lower, p, 0.0)
        clear = log_det > -INFINITY
    for a in range(p if clear else 0):  # reciprocals of the diagonal
        clear = clear and lower[a * p + a] < 1e6
    if clear:
        for a in range(p):
            back[a, a] = scale[a] / lower[a * p + a]
            for b in range(a):
                back[b, a] = lower[a * p + b] * scale[a]
        invert_lower(lower, p)
        lost = _EPS * dot(lower, lower, p * p)
        for a in range(p):
            for b in range(p):
                basis[a, b] = lower[b * p + a] / scale[a]
        multiply(False, False, count, p, p, first, gram, cython.address(white[0, 0]))
    return stacked, sizes, shifted, out, triangle, inverse, log_det, lost
