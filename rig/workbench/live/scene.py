"""The device and the space of commands in three dimensions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from nicegui import ui

from rig.config import AXIS_NAMES
from rig.workbench.live.charts import AXIS_COLORS, Palette
from rig.workbench.live.state import Degrees, RunState

RADII = (1.5, 1.2)  # of the two rings of the gimbal
ARCS = 12  # Bezier tubes of a ring
UNIT = {"X": np.eye(3)[0], "Y": np.eye(3)[1], "Z": np.eye(3)[2]}
FOOT = (  # outline of the sole, toes along +y
    (-0.26, -0.72), (-0.31, -0.45), (-0.24, -0.05), (-0.33, 0.35), (-0.30, 0.62),
    (-0.12, 0.80), (0.12, 0.80), (0.30, 0.62), (0.33, 0.35), (0.24, -0.05),
    (0.31, -0.45), (0.26, -0.72), (0.12, -0.82), (-0.12, -0.82),
)  # fmt: skip
GHOST = "#e0568f"
STATE_COLORS = {"done": "#1fae85", "waiting": "#8c98a6"}
ACTIVE_COLOR = "#3b9de0"
MARKED = 200  # newest postures; more would make the page slow


def _view(palette: Palette, camera_at: Degrees, kind: str) -> Any:
    camera = ui.scene.perspective_camera(fov=32)
    camera.x, camera.y, camera.z = camera_at
    made = ui.scene(grid=False, camera=camera, background_color=palette.scene)
    return made.classes(kind)


def _tube(start: Any, bend: Any, end: Any, radius: float, color: str) -> None:
    a, b, c = (np.asarray(point, float).tolist() for point in (start, bend, end))
    ui.scene.quadratic_bezier_tube(a, b, c, 6, radius, 8).material(color)


def _axle(to: Any, of: Any, color: str) -> None:
    """Tubes on either side of the origin, between two points on one side."""
    for side in (-1.0, 1.0):
        a, b = side * np.asarray(to), side * np.asarray(of)
        _tube(a, (a + b) / 2, b, 0.04, color)


def _ring(first: Any, second: Any, radius: float, color: str) -> None:
    """A ring through two perpendicular units, of tubes that bend through one arc."""
    half = math.pi / ARCS

    def at(step: int, r: float) -> Any:
        return r * (math.cos(step * half) * first + math.sin(step * half) * second)

    for arc in range(0, 2 * ARCS, 2):
        bend = at(arc + 1, radius / math.cos(half))
        _tube(at(arc, radius), bend, at(arc + 2, radius), 0.045, color)


class DeviceScene:
    """A gimbal and a foot plate as the phone says; a ghost plate as commanded."""

    def __init__(self, config: dict[str, Any], palette: Palette) -> None:
        letters = [axis["rotates"] for axis in config.get("axes", [])] or [*"XZY"]
        # Outermost joint first.
        self._order = config.get("mechanism", {}).get("order", "ZXY")
        self._joints = [letters.index(letter) for letter in self._order]
        outer, inner, last = (UNIT[letter] for letter in self._order)
        colors = [AXIS_COLORS[joint] for joint in self._joints]
        self._shown: list[Degrees | None] = [None, None]
        with _view(palette, [4.7, -5.3, 2.7], "device"):
            _axle(1.95 * outer, RADII[0] * outer, palette.metal)
            device, ghost = [], []
            with ui.scene.group() as group:
                device.append(group)
                _ring(outer, inner, RADII[0], colors[0])
                _axle(RADII[0] * inner, RADII[1] * inner, colors[1])
                with ui.scene.group() as group:
                    device.append(group)
                    _ring(inner, last, RADII[1], colors[1])
                    _axle(RADII[1] * last, 0.3 * last, colors[2])
                    with ui.scene.group() as group:
                        device.append(group)
                        _plate(palette.plate, 1.0)
                        ui.scene.box(0.3, 0.62, 0.05).move(z=0.065).material("#10151b")
                        ui.scene.box(0.26, 0.56, 0.01).move(z=0.092).material("#3b9de0")
            with ui.scene.group() as a, ui.scene.group() as b, ui.scene.group() as c:
                ghost += [a, b, c]
                _plate(GHOST, 0.32)
            for letter, name, color in zip(
                letters, AXIS_NAMES, AXIS_COLORS, strict=True
            ):
                _label(name, color, 1.72 * UNIT[letter])
        self._chains = (device, ghost)
        device[0].with_name("device")  # a browser makes them in any order
        ghost[0].with_name("ghost")

    def show(self, measured: Degrees | None, commanded: Degrees | None) -> None:
        """Turn device and ghost, where they changed."""
        for index, angles in enumerate((measured, commanded)):
            if angles is not None and angles != self._shown[index]:
                self._shown[index] = angles
                chain = zip(self._chains[index], self._joints, self._order, strict=True)
                for group, joint, letter in chain:
                    euler = math.radians(angles[joint]) * UNIT[letter]
                    group.rotate(*euler.tolist())


def _plate(color: str, opacity: float) -> None:
    outline = [list(point) for point in FOOT]
    plate = ui.scene.extrusion(outline, 0.08).move(z=-0.04)
    plate.material(color, opacity)


def _label(name: str, color: str, at: Any) -> None:
    style = f"color:{color};font:600 12px system-ui"
    ui.scene.text(name, style).move(*np.asarray(at).tolist())


class CommandScene:
    """Candidates and postures in the cube of their ranges."""

    def __init__(self, palette: Palette) -> None:
        self._palette = palette
        self._marks: dict[str, tuple[str, Any]] = {}  # of postures, and their states
        self._cloud: Any = None
        self._scene = _view(palette, [3.9, -4.8, 2.6], "commands")
        edges = ([0, -1, -1], [-1, -1, 0], [1, 0, -1])  # of pitch, yaw, roll
        with self._scene:
            ui.scene.box(2, 2, 2, wireframe=True).material(palette.metal, 0.5)
            for name, color, at in zip(AXIS_NAMES, AXIS_COLORS, edges, strict=True):
                _label(name, color, 1.15 * np.array(at))

    def show(self, state: RunState) -> None:
        """Candidates, and postures in the colour of their state."""
        ranges = np.array(state.setting("session", "ranges", [[-1, 1]] * 3), float)
        middle, half = ranges.mean(axis=1), np.ptp(ranges, axis=1) / 2

        def place(angles: Any) -> Any:  # pitch along x, roll along y, yaw upwards
            return ((np.asarray(angles, float) - middle) / half)[..., [0, 2, 1]]

        postures = [p for p in state.postures.values() if p.commanded][-MARKED:]
        with self._scene:
            if self._cloud is None and state.candidates:
                points = place(state.candidates).tolist()
                shade = bytes.fromhex(self._palette.metal.lstrip("#"))
                colors = [[value / 255 for value in shade]] * len(points)
                self._cloud = ui.scene.point_cloud(points, colors, 0.07)
            looks = {posture.name: posture.state for posture in postures}
            for name, (look, mark) in [*self._marks.items()]:
                if looks.get(name) != look:
                    mark.delete()
                    del self._marks[name]
            for posture in postures:
                if posture.name not in self._marks:
                    mark = ui.scene.sphere(0.065).move(*place(posture.commanded))
                    mark.material(STATE_COLORS.get(posture.state, ACTIVE_COLOR))
                    self._marks[posture.name] = (posture.state, mark)
