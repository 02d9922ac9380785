"""What an arm is measured with: sensors that turn the tip's pose into readings."""

from jaxcal.models.sensors.board import Board
from jaxcal.models.sensors.distance import Distance
from jaxcal.models.sensors.gravity import Gravity
from jaxcal.models.sensors.plane import Plane
from jaxcal.models.sensors.pose import Pose
from jaxcal.models.sensors.position import Position
from jaxcal.models.sensors.sensor import Landmarks, Reading, Sensor, Tip, hats
from jaxcal.models.sensors.several import Several
from jaxcal.models.sensors.socket import Socket
from jaxcal.models.sensors.wrench import Wrench

__all__ = [
    "SENSORS",
    "Board",
    "Distance",
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
        Distance,
        Gravity,
        Wrench,
        Board,
        Several,
    )
}
