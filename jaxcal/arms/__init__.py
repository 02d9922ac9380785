"""Arms: chains from a DH table or a URDF file, and what their tips are measured with.

Loaded where an arm is asked for; nothing else of jaxcal loads it.
"""

from jaxcal.arms.chain import SerialChain
from jaxcal.arms.chains import Chains
from jaxcal.arms.files.recordings import Servos
from jaxcal.arms.sensors import (
    Board,
    Distance,
    Flush,
    Gravity,
    Plane,
    Pose,
    Position,
    Reading,
    Sensor,
    Several,
    Socket,
    Tip,
    Wrench,
)

__all__ = [
    "Board",
    "Chains",
    "Distance",
    "Flush",
    "Gravity",
    "Plane",
    "Pose",
    "Position",
    "Reading",
    "Sensor",
    "SerialChain",
    "Servos",
    "Several",
    "Socket",
    "Tip",
    "Wrench",
]
