"""The device in three dimensions: a gimbal and a foot plate."""

from __future__ import annotations

import contextlib
import math
from typing import Any

import numpy as np
from nicegui import ui

from rig.outputs.run_state import Degrees
from rig_workbench.live.charts import AXIS_COLORS

RADII = (1.5, 1.2)  # of the two rings of the gimbal
UNIT = {"X": np.eye(3)[0], "Y": np.eye(3)[1], "Z": np.eye(3)[2]}
FOOT = (  # outline of the sole, toes along +y
    (-0.26, -0.72), (-0.31, -0.45), (-0.24, -0.05), (-0.33, 0.35), (-0.30, 0.62),
    (-0.12, 0.80), (0.12, 0.80), (0.30, 0.62), (0.33, 0.35), (0.24, -0.05),
    (0.31, -0.45), (0.26, -0.72), (0.12, -0.82), (-0.12, -0.82),
)  # fmt: skip
# The same on light and dark pages: style sheets do not reach a canvas.
BACK, METAL, PLATE, GHOST = "#1b232c", "#8c98a6", "#c4d0dc", "#e0568f"


def _axle(to: Any, of: Any, color: str) -> None:
    """Tubes on either side of the origin, between two points on one side."""
    for side in (-1.0, 1.0):
        a, b = side * np.asarray(to), side * np.asarray(of)
        start, middle, end = (point.tolist() for point in (a, (a + b) / 2, b))
        tube = ui.scene.quadratic_bezier_tube(start, middle, end, 6, 0.04, 8)
        tube.material(color)


def _ring(first: Any, second: Any, radius: float, color: str) -> None:
    """A flat ring through two perpendicular units."""
    ring = ui.scene.ring(radius - 0.05, radius + 0.05, 48).material(color, 1.0, "both")
    ring.rotate_R(np.column_stack([first, second, np.cross(first, second)]).tolist())


def _plate(color: str, opacity: float) -> None:
    outline = [list(point) for point in FOOT]
    plate = ui.scene.extrusion(outline, 0.08).move(z=-0.04)
    plate.material(color, opacity)


class DeviceScene:
    """The device as the phone says, and a ghost of its plate as commanded."""

    def __init__(self, config: dict[str, Any]) -> None:
        axes = [] if config.get("readings") else config.get("axes", [])
        letters = [axis["rotates"] for axis in axes]
        # Outermost joint first.
        order = config.get("mechanism", {}).get("order", "ZXY")
        self._order = [letter for letter in order if letter in letters]
        self._joints = [letters.index(letter) for letter in self._order]
        turns = [UNIT[letter] for letter in self._order]
        colors = [AXIS_COLORS[joint] for joint in self._joints]
        ends = [1.95, *RADII[: len(turns) - 1], 0.3]  # of the axle of each joint
        groups = []
        self._shown: list[Degrees | None] = [None, None]
        self._chains: tuple[list[Any], list[Any]] = ([], [])
        if not axes:  # numbers are no joints that could be drawn
            return
        camera = ui.scene.perspective_camera(fov=32)
        camera.x, camera.y, camera.z = 4.7, -5.3, 2.7
        scene = ui.scene(grid=False, camera=camera, background_color=BACK)
        with scene.classes("device"):
            with contextlib.ExitStack() as inside:
                for number, turn in enumerate(turns):
                    color = METAL if number == 0 else colors[number]
                    _axle(ends[number] * turn, ends[number + 1] * turn, color)
                    groups.append(inside.enter_context(ui.scene.group()))
                    if number + 1 < len(turns):
                        radius = RADII[number]
                        _ring(turn, turns[number + 1], radius, colors[number])
                _plate(PLATE, 1.0)
                ui.scene.box(0.3, 0.62, 0.05).move(z=0.065).material("#10151b")
                ui.scene.box(0.26, 0.56, 0.01).move(z=0.092).material("#3b9de0")
            with contextlib.ExitStack() as inside:
                ghosts = [inside.enter_context(ui.scene.group()) for _ in turns]
                _plate(GHOST, 0.32)
            for axis, color in zip(axes, AXIS_COLORS, strict=False):
                style = f"color:{color};font:600 12px system-ui"
                at = 1.72 * UNIT[axis["rotates"]]
                ui.scene.text(axis["name"], style).move(*at.tolist())
        self._chains = (groups, ghosts)
        groups[0].with_name("device")  # a browser makes them in any order
        ghosts[0].with_name("ghost")

    def show(self, measured: Degrees | None, commanded: Degrees | None) -> None:
        """Turn device and ghost, where they changed."""
        for index, angles in enumerate((measured, commanded)):
            if angles is not None and angles != self._shown[index]:
                self._shown[index] = angles
                chain = zip(self._chains[index], self._joints, self._order, strict=True)
                for group, joint, letter in chain:
                    euler = math.radians(angles[joint]) * UNIT[letter]
                    group.rotate(*euler.tolist())
