"""Compiled: a chain of elementary rotations and translations at many postures.

The derivative of the tool by one step of the chain is geometric: a rotation about ``w``
through ``o`` turns the tool by ``w`` and moves its point ``t`` by ``w x (t - o)``; a
translation along ``w`` moves it by ``w``.
"""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.libc.math import M_PI, cos, sin

__all__ = ["forward", "slopes"]


def forward(kinds, values, fixed, ends):
    """Frames after some of the steps, from the identity, and where each step acted.

    Args:
        kinds: (S,) int64: 0, 1, 2 a translation along x, y, z of the frame reached so
            far, 3, 4, 5 a rotation about it; 6 and on a constant rotation.
        values: (S, N) float64 lengths and degrees.
        fixed: (F, 3, 3) float64, the constant rotation of step kind 6 + i.
        ends: (L,) int64, after how many steps, at most S, a frame is asked for.

    Returns:
        (L, 4, 3, N) axes x, y, z of the frames and their origins; of each step the axis
        w (S, 3, N) and the origin o (S, 3, N).
    """
    size, count = values.shape
    frames = np.empty((len(ends), 4, 3, count))
    axes, origins = np.empty((2, size, 3, count))
    turns = np.array([[0.0], [1.0], [0.0]]).repeat(size, axis=1)
    _forward(kinds, values, fixed, ends, turns, frames, axes, origins)
    return frames, axes, origins


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _forward(
    kinds: cython.Py_ssize_t[::1],
    values: cython.double[:, ::1],
    fixed: cython.double[:, :, ::1],
    ends: cython.Py_ssize_t[::1],
    turns: cython.double[:, ::1],  # angle, cosine, sine of each step: most stay
    frames: cython.double[:, :, :, ::1],
    axes: cython.double[:, :, ::1],
    origins: cython.double[:, :, ::1],
) -> cython.void:
    at = cython.declare(cython.double[3][4])  # in C at[4][3]: four of three
    old = cython.declare(cython.double[3][3])
    for n in range(values.shape[1]):
        for j in range(4):
            for c in range(3):
                at[j][c] = j == c
        for s in range(values.shape[0] + 1):
            for i in range(ends.shape[0]):
                if ends[i] == s:
                    for j in range(4):
                        for c in range(3):
                            frames[i, j, c, n] = at[j][c]
            if s == values.shape[0]:
                break
            kind: cython.Py_ssize_t = kinds[s]
            axis = kind % 3 if kind < 6 else 0
            for c in range(3):
                axes[s, c, n] = at[axis][c]
                origins[s, c, n] = at[3][c]
            value = values[s, n]
            if kind >= 6:
                for j in range(3):
                    for c in range(3):
                        old[j][c] = at[j][c]
                for j in range(3):
                    for c in range(3):
                        at[j][c] = 0.0
                        for k in range(3):
                            at[j][c] += old[k][c] * fixed[kind - 6, k, j]
            elif value == 0.0:
                continue
            elif kind < 3:
                for c in range(3):
                    at[3][c] += value * at[axis][c]
            else:
                if value != turns[0, s]:
                    turns[0, s] = value
                    turns[1, s] = cos(value * (M_PI / 180.0))
                    turns[2, s] = sin(value * (M_PI / 180.0))
                cosine, sine = turns[1, s], turns[2, s]
                one, two = (axis + 1) % 3, (axis + 2) % 3
                for c in range(3):
                    first, second = at[one][c], at[two][c]
                    at[one][c] = cosine * first + sine * second
                    at[two][c] = cosine * second - sine * first


def slopes(tip, axes, origins, steps, by_tip):
    """Derivatives of readings by some of the steps of a chain.

    Args:
        tip: (3, N) the point that is measured.
        axes, origins: (S, 3, N) of ``forward``.
        steps: (K, 2) int64: which step, and whether it turns.
        by_tip: (N, q, 6) of the readings by a shift of the tip, and by its turn in
            radians.

    Returns:
        (N, q, K) by a unit of length or a degree of each step.
    """
    count, outputs, _ = by_tip.shape
    result = np.empty((count, outputs, len(steps)))
    _slopes(tip, axes, origins, steps, np.array(by_tip, order="C"), result)
    return result


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def _slopes(
    tip: cython.double[:, ::1],
    axes: cython.double[:, :, ::1],
    origins: cython.double[:, :, ::1],
    steps: cython.Py_ssize_t[:, ::1],
    by_tip: cython.double[:, :, ::1],
    result: cython.double[:, :, ::1],
) -> cython.void:
    # Of a step: its axis and its arm to the tip, or what it shifts and turns.
    turn = cython.declare(cython.double[3])
    lever = cython.declare(cython.double[3])
    shift = cython.declare(cython.double[3])
    for n in range(by_tip.shape[0]):
        for k in range(steps.shape[0]):
            s: cython.Py_ssize_t = steps[k, 0]
            for c in range(3):
                turn[c] = axes[s, c, n]
                if steps[k, 1]:
                    turn[c] *= M_PI / 180.0
                lever[c] = tip[c, n] - origins[s, c, n]
            for c in range(3):
                after, before = (c + 1) % 3, (c + 2) % 3
                shift[c] = turn[c]
                if steps[k, 1]:
                    shift[c] = turn[after] * lever[before] - turn[before] * lever[after]
            for i in range(by_tip.shape[1]):
                slope: cython.double = 0.0
                for c in range(3):
                    slope += by_tip[n, i, c] * shift[c]
                if steps[k, 1]:
                    for c in range(3):
                        slope += by_tip[n, i, 3 + c] * turn[c]
                result[n, i, k] = slope
