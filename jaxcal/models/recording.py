"""``Recording``: an arm's recording instead of commands and readings."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence


@dataclasses.dataclass(frozen=True)
class Recording:
    """A recording of an arm that rested at each of several postures, as commands.

    Joints are found by name; readings are the mean over each rest of the bag's points
    or poses (geometry_msgs PointStamped, PoseStamped; of a board in the camera too),
    lengths of a wire (sensor_msgs Range, std_msgs Float64), accelerations (sensor_msgs
    Imu), wrenches (WrenchStamped), in metres, radians, newtons; contacts need none.
    """

    # rosbag2 folder or MCAP file (extra ``ros``), or the folder of a LeRobot dataset
    # (extra ``lerobot``), whose joints are in degrees.
    path: str | os.PathLike[str]
    which: Sequence[int] | None = None  # socket, plane or wire of each rest, in order
    seconds: float = 0.5  # shortest rest
    # Degrees (or units of length) in which a resting joint stays. None: 0.05, or eight
    # times what the joint's readings jitter by.
    within: float | None = None
    # LeRobot's calibration file of an arm whose dataset is in -100 to 100 of each
    # motor's range instead of degrees.
    servos: str | os.PathLike[str] | None = None
    # Of joints recorded under another name: {"Rotation": "shoulder_pan"}.
    names: Mapping[str, str] = dataclasses.field(default_factory=dict)
    topic: str = ""  # of the readings, if the bag has several of this type
