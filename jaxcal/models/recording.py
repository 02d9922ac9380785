"""``Recording``: what an arm recorded, in the place of commands and readings."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence


@dataclasses.dataclass(frozen=True)
class Recording:
    """What an arm recorded while it went to postures and stood still at each.

    ``identify`` and ``check`` take it for commands. Joints are found by name; what the
    sensor read is the mean over each rest, of the bag's messages: points or poses
    (geometry_msgs PointStamped, PoseStamped; of a board in the camera too), lengths of
    a wire (sensor_msgs Range, std_msgs Float64), accelerations (sensor_msgs Imu),
    wrenches (WrenchStamped), in metres, radians, newtons; contacts need none.

    Attributes:
        path: rosbag2 folder or MCAP file (extra ``ros``), or the folder of a LeRobot
            dataset (extra ``lerobot``), whose joints are in degrees.
        which: of each rest, in their order, the socket, plane or wire it is of.
        seconds: of rest, at least.
        within: degrees (or units of length) in which a resting joint stays. When not
            given 0.05, or eight times what the joint's readings jitter by.
        servos: LeRobot's calibration file of the arm, where its dataset is not in
            degrees but in -100 to 100 of each motor's range.
        names: of joints that are recorded under another name: {"Rotation":
            "shoulder_pan"}.
        topic: of the readings, where the bag has several of their kind.
    """

    path: str | os.PathLike[str]
    which: Sequence[int] | None = None
    seconds: float = 0.5
    within: float | None = None
    servos: str | os.PathLike[str] | None = None
    names: Mapping[str, str] = dataclasses.field(default_factory=dict)
    topic: str = ""
