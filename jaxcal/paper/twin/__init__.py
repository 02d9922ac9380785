"""The paper's robot, simulated: in closed form, in MuJoCo, and in pictures.

``robot`` is what the robot is and its closed form (JAX); ``robot_model`` the same in
MuJoCo; ``robot_pictures`` draws it. Names load on first use: the closed form needs no
MuJoCo.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxcal.paper.twin.robot import RobotConfig, joint_angles, measure, read_out
    from jaxcal.paper.twin.robot_model import simulate, trajectory
    from jaxcal.paper.twin.robot_pictures import animate, render

__all__ = [
    "RobotConfig",
    "animate",
    "joint_angles",
    "measure",
    "read_out",
    "render",
    "simulate",
    "trajectory",
]

_HOME = {
    "animate": "robot_pictures",
    "render": "robot_pictures",
    "simulate": "robot_model",
    "trajectory": "robot_model",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = importlib.import_module(f"{__name__}.{_HOME.get(name, 'robot')}")
    return getattr(home, name)
