"""Arms: chains from a DH table or a URDF file, and what their tips are measured with.

Loaded where an arm is asked for; nothing else of jaxcal loads it.
"""

import importlib
from typing import Any

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


def __getattr__(name: str) -> Any:
    if name != "ArmCalibration":  # a model of an arm needs no calibration
        raise AttributeError(f"module 'jaxcal.arms' has no attribute {name!r}")
    return importlib.import_module("jaxcal.arms.written").ArmCalibration
