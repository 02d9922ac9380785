"""Compiled: log det of the information of selections, where no doubt of it is left.

A selection is judged thousands of times a second. What is not clear here is judged by
``rank_rule``, at leisure. And Cholesky's factors of small matrices, of which numpy's
two functions take longer to begin than to compute.
"""

# Products may be fused.

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.jaxcal.information.linear_algebra import (
    cholesky,
    dot,
    invert_lower,
)
from cython.cimports.jaxcal.watch import Watch, begin, late
from cython.cimports.libc.math import INFINITY, NAN, fabs, log, sqrt

_EPS = cython.declare(cython.double, 2.0**-52)


def clear_log_dets(
    given,
    root_of,
    beside,
    ordinary: cython.double,
    least_share: cython.double,
    sure: cython.double,
):
    """Log det of ``columns.T @ columns`` of each of S sets of blocks and a root.

    Columns are centred as ``jaxcal.information.blocks`` says.

    Args:
        given: (S, N, q, p) blocks of S sets, N at least 1.
        root_of: (r, p) of the prior.
        beside: (p,) sizes that columns were computed beside.
        ordinary: entries above it and below its inverse can be squared.
        least_share: of a column of length 1 that is rounding at least.
        sure: how many times that a column must be from the span of those before it.

    Returns:
        (S,) natural log, NaN where it is not clear; and whether all are clear.
    """
    blocks: cython.const[cython.double][:, :, :, ::1] = np.ascontiguousarray(given)
    root: cython.const[cython.double][:, ::1] = np.ascontiguousarray(root_of)
    size: cython.const[cython.double][::1] = beside
    p: cython.Py_ssize_t = blocks.shape[3]
    num_rows = blocks.shape[1] * blocks.shape[2] + root.shape[0]
    values = np.full(blocks.shape[0], NAN)
    log_det: cython.double[::1] = values
    columns: cython.double[:, ::1] = np.empty((p, num_rows))
    largest: cython.double[:, ::1] = np.empty((2, p))
    all_clear: cython.bint = num_rows >= p
    n: cython.Py_ssize_t
    watch: Watch = begin(INFINITY)
    with cython.nogil:
        for n in range(blocks.shape[0] if num_rows >= p else 0):
            late(cython.address(watch))
            if _centred(blocks, n, root, ordinary, columns, largest):
                log_det[n] = _volume(
                    columns, largest[0], size, _EPS * blocks.shape[1], least_share, sure
                )
            all_clear = all_clear and log_det[n] == log_det[n]
    return values, all_clear


def factors(information):
    """R of ``R.T @ R`` of each of S symmetric matrices, and inverse(R), both upper.

    Args:
        information: (S, p, p).

    Returns:
        R (S, p, p), inverse(R) (S, p, p) and the natural log det (S,) of the matrix;
        NaN all three where it is not positive definite.
    """
    matrices: cython.const[cython.double][:, :, ::1] = np.ascontiguousarray(information)
    sets, p = matrices.shape[0], cython.cast(cython.int, matrices.shape[1])
    upper, inverse = np.full((2, sets, p, p), NAN)
    values = np.full(sets, NAN)
    back: cython.double[:, :, ::1] = upper
    across: cython.double[:, :, ::1] = inverse
    log_det: cython.double[::1] = values
    room: cython.double[:, ::1] = np.empty((2, p * p))
    n: cython.Py_ssize_t
    a: cython.int
    b: cython.int
    watch: Watch = begin(INFINITY)
    with cython.nogil:
        for n in range(sets if p > 0 else 0):
            late(cython.address(watch))
            matrix = cython.address(room[0, 0])
            lower = cython.address(room[1, 0])
            for a in range(p):
                for b in range(p):
                    matrix[a * p + b] = matrices[n, a, b]
            value: cython.double = cholesky(matrix, lower, p, 0.0)
            if not value > -INFINITY:
                continue
            log_det[n] = value
            for a in range(p):
                for b in range(p):
                    back[n, b, a] = lower[a * p + b] if b < a else 0.0
                back[n, a, a] = 1.0 / lower[a * p + a]
            invert_lower(lower, p)
            for a in range(p):
                for b in range(p):
                    across[n, b, a] = lower[a * p + b]
    return upper, inverse, values


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _centred(
    blocks: cython.const[cython.double][:, :, :, ::1],
    n: cython.Py_ssize_t,
    root: cython.const[cython.double][:, ::1],
    ordinary: cython.double,
    columns: cython.double[:, ::1],
    largest: cython.double[:, ::1],
) -> cython.bint:
    """Columns (p, R) of a set, centred, their largest entries before, and which move.

    False where that is not simple.
    """
    count, q, prior_rows = blocks.shape[1], blocks.shape[2], root.shape[0]
    simple: cython.bint = True
    constant: cython.bint = False
    moving: cython.bint = False
    for a in range(blocks.shape[3]):
        most: cython.double = 0.0
        differs: cython.bint = False
        some: cython.bint = False
        for i in range(count):
            for r in range(q):
                x: cython.double = blocks[n, i, r, a]
                columns[a, i * q + r] = x
                most = max(most, fabs(x))
                differs = differs or x != blocks[n, 0, r, a]
                some = some or x != 0.0
        for i in range(prior_rows):
            columns[a, count * q + i] = root[i, a]
            most = max(most, fabs(root[i, a]))
        simple = simple and ordinary < most and most < 1.0 / ordinary
        largest[0, a] = most
        largest[1, a] = differs
        moving = moving or differs
        constant = constant or (some and not differs)
    if not (simple and constant and moving):
        return simple
    for a in range(blocks.shape[3]):
        if largest[1, a] != 0.0:
            first: cython.double = columns[a, 0]
            mean: cython.double = 0.0
            for i in range(count):
                columns[a, i] -= first
                mean += columns[a, i]
            mean /= count
            for i in range(count):
                columns[a, i] -= mean
    return q == 1 and prior_rows == 0


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _volume(
    columns: cython.double[:, ::1],
    largest: cython.double[::1],
    size: cython.const[cython.double][::1],
    resolution: cython.double,
    least_share: cython.double,
    sure: cython.double,
) -> cython.double:
    """Twice the log of the volume that columns (p, R) span; NaN where it is not clear.

    They are made orthogonal one after the other.
    """
    p, num_rows = columns.shape[0], columns.shape[1]
    count = cython.cast(cython.int, num_rows)
    worst: cython.double = 8.0
    value: cython.double = 0.0
    length: cython.double
    for a in range(p):
        row = cython.address(columns[a, 0])
        length = sqrt(dot(row, row, count))
        most: cython.double = max(largest[a], size[a])
        if not length > resolution * most:
            return NAN
        worst = max(worst, most / length)
        value += 2.0 * log(length)
        for i in range(num_rows):
            row[i] /= length
    share: cython.double = sure * max(resolution * worst, least_share)
    for a in range(p):
        row = cython.address(columns[a, 0])
        length = sqrt(dot(row, row, count))
        if not length > share:
            return NAN
        value += 2.0 * log(length)
        for b in range(a + 1, p):
            other = cython.address(columns[b, 0])
            along: cython.double = dot(row, other, count) / (length * length)
            for i in range(num_rows):
                other[i] -= along * row[i]
    return value
