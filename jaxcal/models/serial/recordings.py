"""What a robot recorded: joint states at rest from a rosbag2 folder or MCAP file."""

from __future__ import annotations

import os
import pathlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from jaxcal.extras import needs

__all__ = ["at_rest", "jitter", "joint_states"]

Array = NDArray[np.float64]

_WITHIN = 0.05  # degrees in which a resting joint stays
_JITTER = 8.0  # standard deviations: no reading of a joint at rest is farther apart
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


def jitter(joints: Array) -> Array:
    """(J,) standard deviation of what a resting joint reads, of joints (T, J).

    From second differences, in which a steady motion leaves nothing; the median, so
    that a third of the recording may be jerks.
    """
    if len(joints) < 3:
        return np.zeros(joints.shape[1])
    second = joints[2:] - 2.0 * joints[1:-1] + joints[:-2]
    return np.asarray(np.median(np.abs(second), axis=0) / (0.6745 * np.sqrt(6.0)))


def at_rest(
    times: Array, joints: Array, seconds: float, within: float | None
) -> NDArray[np.float64]:
    """(N, J) means of the stretches of ``seconds`` or more that stay ``within``.

    When not given that is 0.05, or eight times what the joint jitters by if that is
    more; the first and the last third of a stretch then agree to 0.05 and the noise of
    their means, so a slow motion is no rest. A stretch at the posture of the one before
    is the same rest.
    """
    noise = jitter(joints)
    most = np.full(joints.shape[1], _WITHIN if within is None else within)
    if within is None:
        most = np.maximum(most, _JITTER * noise)
    resting: list[Array] = []
    first = 0
    low, high = joints[0], joints[0]
    for i in range(1, len(joints) + 1):
        if i < len(joints):
            wider = np.minimum(low, joints[i]), np.maximum(high, joints[i])
            if (wider[1] - wider[0] <= most).all():
                low, high = wider
                continue
        if times[i - 1] - times[first] >= seconds:
            stretch = joints[first:i]
            third = -(-len(stretch) // 3)
            drift = stretch[-third:].mean(axis=0) - stretch[:third].mean(axis=0)
            still = (
                within is not None
                or (np.abs(drift) <= _WITHIN + 4.0 * noise * np.sqrt(2.0 / third)).all()
            )
            mean = stretch.mean(axis=0)
            if still and not (
                resting and (np.abs(mean - resting[-1]) <= 2.0 * most).all()
            ):
                resting.append(mean)
        if i < len(joints):
            first, low, high = i, joints[i], joints[i]
    return np.array(resting).reshape(-1, joints.shape[1])
