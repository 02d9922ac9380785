"""The simulated robot: a picture, and a film of it on its way through postures."""

from __future__ import annotations

import pathlib
import tempfile

import numpy as np

from jaxcal.paper.datasets import dataset0_robot
from jaxcal.paper.twin.robot import read_out
from jaxcal.paper.twin.robot_model import simulate
from studies.paper.exhibits.exhibit import Exhibit
from studies.paper.exhibits.material import Material, commands_deg
from studies.paper.robot_pictures import TOUR_DEG, animate, render

__all__ = ["exhibits"]


def exhibits(material: Material) -> list[Exhibit]:
    """The robot of Table 1 that dataset0 is measured on."""
    robot = dataset0_robot()
    chosen = material.result("dataset3", "policy").indices[0, 0]
    four = postures = commands_deg(material.dataset("dataset3"))[0, chosen]
    way = "the policy's four"
    if not material.settings.quick:
        way = f"each axis alone, then {way}"
        postures = np.concatenate([TOUR_DEG[:6], four])  # to either side of each axis
    said, notice, files = "Drawn by MuJoCo, without a screen.", "", {}
    with tempfile.TemporaryDirectory() as place:
        still, film = (pathlib.Path(place) / n for n in ("robot.png", "robot.gif"))
        try:
            render(robot, still, four[0])
            animate(robot, film, postures, progress=material.progress)
            files = {path.name: path.read_bytes() for path in (still, film)}
        except RuntimeError as error:
            said = notice = f"{error}; the report has no picture of the robot."
    apart = np.abs(simulate(robot, postures) - np.asarray(read_out(robot, postures)))
    return [
        Exhibit.from_texts(
            "robot",
            {"way": way, "drawn_by": said},
            numbers={"largest_difference_deg": float(apart.max())},
            pictures=files,
            notice=notice,
        )
    ]
