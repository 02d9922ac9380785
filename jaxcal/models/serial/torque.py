"""Torques that weights put on the joints of an arm."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["Load", "cross", "torque"]

Array = NDArray[np.float64]
Load = tuple[int, float, tuple[float, float, float]]  # link from 1, weight, its centre


def torque(
    axes: Array,
    origins: Array,
    revolute: NDArray[np.bool_],
    at: NDArray[np.int64],
    loads: Sequence[Load],
    frame: Callable[[int], Array],
    gravity: Array,
) -> tuple[Array, Array]:
    """Torque of the loads on some joints, and its derivative by the commands.

    A joint's torque is the work of the loads per radian, so its derivative by another
    joint is a second derivative of their positions: ``w_i x J_j``, i before j.

    Args:
        axes: (n, 3, N) of the joints.
        origins: (n, 3, N) of these axes.
        revolute: (n,) else prismatic.
        at: (C,) joints, from 0, whose torque is asked for.
        loads: each in the frame after its link's row.
        frame: of a link, its axes and origin (4, 3, N).
        gravity: (3,) direction.

    Returns:
        (C, N) and (C, n, N), the latter per degree or unit of length.
    """
    n, count = len(axes), axes.shape[-1]
    turns = revolute[:, None, None]
    first = np.minimum(at[:, None], np.arange(n))
    second = np.maximum(at[:, None], np.arange(n))
    result, rate = np.zeros((len(at), count)), np.zeros((len(at), n, count))
    for link, weight, centre in loads:
        reached = frame(link)
        point = reached[3] + np.einsum("k,kcn->cn", centre, reached[:3])
        motion = np.where(turns, cross(axes, point - origins), axes)
        motion[link:] = 0.0
        force = weight * gravity
        result += np.einsum("c,jcn->jn", force, motion[at])
        bent = cross((axes * turns)[first], motion[second])
        rate += np.einsum("c,ijcn->ijn", force, bent)
    rate[:, revolute] = np.radians(rate[:, revolute])
    return result, rate


def cross(left: Array, right: Array) -> Array:
    """Cross products of (..., 3, N): over the axis before the last."""
    x, y, z = (left[..., k, :] for k in range(3))
    u, v, w = (right[..., k, :] for k in range(3))
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-2)
