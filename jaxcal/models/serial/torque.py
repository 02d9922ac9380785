"""Torques that weights put on the joints of an arm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from jaxcal.models.serial.kinematics import OF_BASE, OF_ROW, Step, cross, forward

__all__ = ["Load", "torque"]

Array = NDArray[np.float64]
Load = tuple[int, float, tuple[float, float, float]]  # link from 1, weight, its centre


def torque(
    count: int,
    steps: Sequence[Step],
    moved: NDArray[np.int64],
    revolute: NDArray[np.bool_],
    at: NDArray[np.int64],
    loads: Sequence[Load],
    gravity: Array,
) -> tuple[Array, Array]:
    """Torque of the loads on some joints, and its derivative by the commands.

    A joint's torque is the work of the loads per radian, so its derivative by another
    joint is a second derivative of their positions: ``w_i x J_j``, i before j.

    Args:
        count: N postures.
        steps: the chain; the rows of its table are five steps each, ending at the tool.
        moved: (n,) the step of each joint.
        revolute: (n,) else prismatic.
        at: (C,) joints, from 0, whose torque is asked for.
        loads: each in the frame after its link's row.
        gravity: (3,) direction.

    Returns:
        (C, N) and (C, n, N), the latter per degree or unit of length.
    """
    n = len(moved)
    _, all_axes, all_origins = forward(count, steps)
    axes = np.stack([all_axes[i] for i in moved])
    origins = np.stack([all_origins[i] for i in moved])
    turns = revolute[:, None, None]
    first = np.minimum(at[:, None], np.arange(n))
    second = np.maximum(at[:, None], np.arange(n))
    result, rate = np.zeros((len(at), count)), np.zeros((len(at), n, count))
    for link, weight, centre in loads:
        end = OF_BASE + OF_ROW * link
        point = all_origins[end]
        if any(centre):
            frame = forward(count, steps[:end])[0]
            point = point + np.einsum("k,kcn->cn", centre, frame[:3])
        motion = np.where(turns, cross(axes, point - origins), axes)
        motion[link:] = 0.0
        force = weight * gravity
        result += np.einsum("c,jcn->jn", force, motion[at])
        bent = cross((axes * turns)[first], motion[second])
        rate += np.einsum("c,ijcn->ijn", force, bent)
    rate[:, revolute] = np.radians(rate[:, revolute])
    return result, rate
