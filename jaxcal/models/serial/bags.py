"""What a robot recorded: joint states at rest from a rosbag2 folder or MCAP file."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from jaxcal.extras import needs

__all__ = ["at_rest", "joint_states"]

Array = NDArray[np.float64]

_STATES = "sensor_msgs/msg/JointState"


def joint_states(
    path: str | os.PathLike[str], names: Sequence[str]
) -> tuple[Array, Array]:
    """Times (T,) in seconds and positions (T, J) as recorded, radians and metres.

    Raises:
        ValueError: no joint states are in it, or none with all of ``names``.
        MissingExtraError: the extra ``ros`` is not installed.
    """
    with needs("ros", "reading a rosbag"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    store = get_typestore(Stores.ROS2_HUMBLE)
    times, rows = [], []
    seen: set[str] = set()
    with AnyReader([pathlib.Path(path)], default_typestore=store) as bag:
        states = [each for each in bag.connections if each.msgtype == _STATES]
        for connection, time, raw in bag.messages(connections=states):
            message = bag.deserialize(raw, connection.msgtype)
            at = dict(zip(message.name, message.position, strict=False))
            seen |= at.keys()
            if at.keys() >= set(names):
                times.append(1e-9 * time)
                rows.append([at[name] for name in names])
    if not rows:
        raise ValueError(
            f"{os.fspath(path)} must hold joint states of {', '.join(names)}, got "
            f"{', '.join(sorted(seen)) or 'none'}"
        )
    return np.array(times), np.array(rows)


def at_rest(
    times: Array, joints: Array, seconds: float, within: float
) -> NDArray[np.float64]:
    """(N, J) means of the stretches of ``seconds`` or more that stay ``within``.

    A stretch at the posture of the one before is the same rest.
    """
    found: list[Array] = []
    first = 0
    low, high = joints[0], joints[0]
    for i in range(1, len(joints) + 1):
        if i < len(joints):
            wider = np.minimum(low, joints[i]), np.maximum(high, joints[i])
            if (wider[1] - wider[0] <= within).all():
                low, high = wider
                continue
        if times[i - 1] - times[first] >= seconds:
            mean = joints[first:i].mean(axis=0)
            if not found or (np.abs(mean - found[-1]) > 2.0 * within).any():
                found.append(mean)
        if i < len(joints):
            first, low, high = i, joints[i], joints[i]
    return np.array(found).reshape(-1, joints.shape[1])
