"""What an arm is measured with: sensors that turn the tip's pose into readings."""

from jaxcal.arms.sensors.board import Board
from jaxcal.arms.sensors.distance import Distance
from jaxcal.arms.sensors.gravity import Gravity
from jaxcal.arms.sensors.plane import Flush, Plane
from jaxcal.arms.sensors.pose import Pose
from jaxcal.arms.sensors.position import Position
from jaxcal.arms.sensors.sensor import Landmarks, Reading, Sensor, Tip, hats
from jaxcal.arms.sensors.several import Several
from jaxcal.arms.sensors.socket import Socket
from jaxcal.arms.sensors.wrench import Wrench

__all__ = [
    "SENSORS",
    "Board",
    "Distance",
    "Flush",
    "Gravity",
    "Landmarks",
    "Placed",
    "Plane",
    "Pose",
    "Position",
    "Reading",
    "Sensor",
    "Several",
    "Socket",
    "Tip",
    "Wrench",
    "hats",
]

Placed = Landmarks  # as it was called in 0.2

# By their names in files and on the command line; a sensor of one's own is added here.
SENSORS: dict[str, type[Sensor]] = {
    one.kind: one
    for one in (
        Position,
        Pose,
        Socket,
        Plane,
        Flush,
        Distance,
        Gravity,
        Wrench,
        Board,
        Several,
    )
}
