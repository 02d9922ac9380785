"""The paper's robot, simulated: in closed form and in MuJoCo, which loads on use."""

from jaxcal.paper.twin.robot import RobotConfig, joint_angles, measure, read_out
from jaxcal.paper.twin.robot_model import simulate

__all__ = [
    "RobotConfig",
    "joint_angles",
    "measure",
    "read_out",
    "simulate",
]
