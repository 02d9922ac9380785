"""The simulated robot: a picture, and a film of it on its way through postures."""

from __future__ import annotations

import pathlib
import tempfile

import numpy as np
from numpy.typing import NDArray

from jaxcal.paper.datasets import dataset0_robot
from jaxcal.paper.exhibits.exhibit import Exhibit
from jaxcal.paper.exhibits.material import Material, commands_deg
from jaxcal.paper.twin.robot import read_out
from jaxcal.paper.twin.robot_model import simulate
from jaxcal.paper.twin.robot_pictures import TOUR_DEG, animate, render

__all__ = ["exhibits"]

Array = NDArray[np.float64]

ALONE_DEG = TOUR_DEG[:6]  # each axis on its own, to either side
PICTURE, FILM = "robot.png", "robot.gif"


def exhibits(material: Material) -> list[Exhibit]:
    """The robot of Table 1 that dataset0 is measured on."""
    robot = dataset0_robot()
    chosen = material.result("dataset3", "policy").indices[0, 0]
    four = commands_deg(material.dataset("dataset3"))[0, chosen]
    quick = material.settings.quick
    postures = four if quick else np.concatenate([ALONE_DEG, four])
    way = "the policy's four" if quick else "each axis alone, then the policy's four"
    drawn_by, pictures = _draw(postures, four[0], material)
    apart = np.abs(simulate(robot, postures) - np.asarray(read_out(robot, postures)))
    return [
        Exhibit.from_texts(
            "robot",
            {"way": way, "drawn_by": drawn_by},
            numbers={"largest_difference_deg": float(apart.max())},
            pictures=pictures,
            notice="" if "by MuJoCo" in drawn_by else drawn_by,
        )
    ]


def _draw(
    postures: Array, still: Array, material: Material
) -> tuple[str, dict[str, bytes]]:
    """What drew them, in a sentence, and both files."""
    robot = dataset0_robot()
    with tempfile.TemporaryDirectory() as place:
        folder = pathlib.Path(place)
        said, backend = "Drawn by MuJoCo, without a screen.", "mujoco"
        try:
            render(robot, folder / PICTURE, still, backend=backend)
        except RuntimeError as error:
            said, backend = (
                f"{error}; drawn by matplotlib from the same parts and angles.",
                "matplotlib",
            )
            render(robot, folder / PICTURE, still, backend=backend)
        progress = material.progress
        animate(robot, folder / FILM, postures, backend=backend, progress=progress)
        return said, {name: (folder / name).read_bytes() for name in (PICTURE, FILM)}
