"""A chain of rotations and translations, with the motion that each of them causes.

A frame is (4, 3, N): its axes x, y, z and its origin, of N postures at once. The
derivative of the tool by one step of the chain is geometric: a rotation about ``w``
through ``o`` turns the tool by ``w`` and moves its point ``t`` by ``w x (t - o)``; a
translation along ``w`` moves it by ``w``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["OF_BASE", "OF_ROW", "Step", "cross", "forward"]

Array = NDArray[np.float64]


OF_BASE = 7  # steps of the base: three shifts, three turns, its nominal rotation
OF_ROW = 5  # steps of a row of the table


class Step(NamedTuple):
    """One elementary transform about or along an axis of the frame reached so far."""

    turns: bool  # a rotation, in degrees; else a translation
    axis: int | None  # 0 x, 1 y, 2 z; None: ``value`` is a constant (3, 3) rotation
    value: Array | float  # one number, or (N,)


def cross(left: Array, right: Array, out: Array | None = None) -> Array:
    """Cross products of (..., 3, N): over the axis before the last."""
    x, y, z = (left[..., k, :] for k in range(3))
    u, v, w = (right[..., k, :] for k in range(3))
    if out is None:
        out = np.empty(np.broadcast_shapes(left.shape, right.shape))
    np.subtract(y * w, z * v, out=out[..., 0, :])
    np.subtract(z * u, x * w, out=out[..., 1, :])
    np.subtract(x * v, y * u, out=out[..., 2, :])
    return out


def forward(
    count: int, steps: Sequence[Step]
) -> tuple[Array, list[Array], list[Array]]:
    """Frame after the last step, from the identity, and where each step acted.

    Returns:
        (4, 3, N) frame; of each step the axis w (3, N) and the origin o (3, N).
    """
    frame = [np.repeat(np.eye(3)[i][:, None], count, axis=1) for i in range(3)]
    origin = np.zeros((3, count))
    axes, origins = [], []
    for turns, axis, value in steps:
        axes.append(frame[axis or 0])
        origins.append(origin)
        if axis is None:
            frame = list(np.einsum("kj,kcn->jcn", value, frame))
        elif np.ndim(value) == 0 and value == 0.0:
            continue
        elif not turns:
            origin = origin + value * frame[axis]
        else:
            angle = np.radians(value)
            cosine, sine = np.cos(angle), np.sin(angle)
            j, k = (axis + 1) % 3, (axis + 2) % 3
            first, second = frame[j], frame[k]
            frame[j] = cosine * first + sine * second
            frame[k] = cosine * second - sine * first
    return np.stack([*frame, origin]), axes, origins
