"""What an arm is measured with: sensors that turn the tip's pose into readings."""

from jaxcal.arms.sensors.at_rest import Gravity, Wrench
from jaxcal.arms.sensors.board import Board
from jaxcal.arms.sensors.landmarks import Distance, Flush, Landmarks, Plane, Socket
from jaxcal.arms.sensors.sensor import Pose, Position, Reading, Sensor, Tip, hats
from jaxcal.arms.sensors.several import Several

__all__ = [
    "SENSORS",
    "Board",
    "Distance",
    "Flush",
    "Gravity",
    "Landmarks",
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

# By their names in files and on the command line; a sensor of one's own is added here.
_KINDS = (Position, Pose, Socket, Plane, Flush, Distance, Gravity, Wrench, Board)
SENSORS: dict[str, type[Sensor]] = {one.kind: one for one in (*_KINDS, Several)}
