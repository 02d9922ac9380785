"""The paper's robot, simulated: in closed form and in MuJoCo."""

from __future__ import annotations

import importlib
from typing import Any

_HOMES = {  # loaded when first used: the closed form needs no MuJoCo
    "RobotConfig": "robot",
    "joint_angles": "robot",
    "measure": "robot",
    "read_out": "robot",
    "simulate": "robot_model",
    "trajectory": "robot_model",
}

__all__ = list(_HOMES)  # the names above


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
