"""The device and the space of commands in three dimensions."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from nicegui import ui

from rig.config import AXIS_NAMES
from rig.workbench.live.charts import AXIS_COLORS, Palette
from rig.workbench.live.state import Degrees, Posture, RunState
from rig.workbench.live.worth import ellipsoid

RADII = (1.5, 1.2)  # of the two rings of the gimbal
TUBE = 0.045
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
MARKED = 200  # postures of a kind; more would make the page slow
UNKNOWN = 1.0  # drawn radius along directions that no posture has measured
LEAST = 0.12  # drawn radius of a slope known to KNOWN
KNOWN = 1e-4  # degrees per degree


def _tube(start: Any, end: Any, radius: float, color: str) -> Any:
    middle = (np.asarray(start) + end) / 2
    tube = ui.scene.quadratic_bezier_tube(
        list(start), middle.tolist(), list(end), 1, radius, 10
    )
    return tube.material(color)


def _ring(normal: Any, radius: float, color: str) -> None:
    """A ring about the origin, of tubes that each bend through one arc."""
    first = UNIT["X"] if abs(normal[0]) < 0.5 else UNIT["Y"]
    second = np.cross(normal, first)
    turn, bulge = 2 * math.pi / ARCS, radius / math.cos(math.pi / ARCS)

    def at(angle: float, r: float) -> list[float]:
        return (r * (math.cos(angle) * first + math.sin(angle) * second)).tolist()

    for arc in range(ARCS):
        a = arc * turn
        ui.scene.quadratic_bezier_tube(
            at(a, radius), at(a + turn / 2, bulge), at(a + turn, radius), 6, TUBE, 8
        ).material(color)


class Chain:
    """Three nested groups that turn about the joints' axes, outermost first."""

    def __init__(self, letters: list[str], order: str) -> None:
        self._joints = [letters.index(letter) for letter in order]
        self._order = order
        self.groups: list[Any] = []

    def add(self) -> Any:
        """The next group, to be entered inside the one before."""
        self.groups.append(ui.scene.group())
        return self.groups[-1]

    def turn(self, angles: Degrees) -> None:
        """Set pitch, yaw and roll in degrees."""
        for group, joint, letter in zip(
            self.groups, self._joints, self._order, strict=True
        ):
            euler = math.radians(angles[joint]) * UNIT[letter]
            group.rotate(*euler.tolist())


class DeviceScene:
    """A gimbal and a foot plate as the phone says; a ghost plate as commanded."""

    def __init__(self, state: RunState, palette: Palette) -> None:
        axes = state.start.get("config", {}).get("axes", [])
        letters = [axis["letter"] for axis in axes] or ["X", "Z", "Y"]
        order = state.start.get("config", {}).get("mechanism_order", "ZXY")
        self.device, self.ghost = Chain(letters, order), Chain(letters, order)
        camera = ui.scene.perspective_camera(fov=32)
        camera.x, camera.y, camera.z = 4.7, -5.3, 2.7
        camera.look_at_z = -0.1
        self.scene = ui.scene(
            grid=False, camera=camera, background_color=palette.scene, fps=20
        ).classes("device")
        with self.scene:
            self._build(letters, order, palette)
        self._shown: list[Any] = [None, None]

    def _build(self, letters: list[str], order: str, palette: Palette) -> None:
        outer, inner = (UNIT[order[i]] for i in (0, 1))
        colors = {
            letter: AXIS_COLORS[letters.index(letter)] for letter in letters
        }  # by axis letter
        self._base(order, palette)
        with self.device.add():
            _ring(np.cross(outer, inner), RADII[0], colors[order[0]])
            self._pins(order[1], RADII, colors[order[1]])
            with self.device.add():
                last = UNIT[order[2]]
                _ring(np.cross(inner, last), RADII[1], colors[order[1]])
                self._pins(order[2], (RADII[1], 0.3), colors[order[2]])
                with self.device.add():
                    self._plate(palette.plate, 1.0, phone=True)
        with self.ghost.add(), self.ghost.add(), self.ghost.add():
            self._plate(GHOST, 0.32, phone=False)
        for index, name in enumerate(AXIS_NAMES):
            at = 1.72 * UNIT[letters[index]]
            style = f"color:{AXIS_COLORS[index]};font:600 12px system-ui"
            ui.scene.text(name, style).move(*at.tolist())

    def _base(self, order: str, palette: Palette) -> None:
        ui.scene.cylinder(0.75, 0.85, 0.1, 48).rotate(math.pi / 2, 0, 0).move(
            z=-1.98
        ).material(palette.metal)
        axis = UNIT[order[0]]
        if order[0] == "Z":
            _tube([0, 0, -1.95], [0, 0, -RADII[0]], 0.09, palette.metal)
            return
        for side in (-1.0, 1.0):
            top = side * 1.62 * axis
            foot = np.array([top[0], top[1], -1.95])
            _tube(foot, top, 0.06, palette.metal)
            _tube(top, side * RADII[0] * axis, 0.06, palette.metal)

    def _pins(self, letter: str, radii: tuple[float, float], color: str) -> None:
        for side in (-1.0, 1.0):
            axis = side * UNIT[letter]
            _tube((radii[0] * axis).tolist(), (radii[1] * axis).tolist(), 0.035, color)

    def _plate(self, color: str, opacity: float, phone: bool) -> None:
        outline = [list(point) for point in FOOT]
        plate = ui.scene.extrusion(outline, 0.08).move(z=-0.04)
        plate.material(color, opacity)
        if phone:
            ui.scene.box(0.30, 0.62, 0.05).move(0, 0.02, 0.065).material("#10151b")
            ui.scene.box(0.26, 0.56, 0.01).move(0, 0.02, 0.092).material("#3b9de0")

    def show(self, measured: Degrees | None, commanded: Degrees | None) -> None:
        """Turn device and ghost, where they changed."""
        chains = (self.device, self.ghost)
        for index, (chain, angles) in enumerate(
            zip(chains, (measured, commanded), strict=True)
        ):
            if angles is not None and angles != self._shown[index]:
                self._shown[index] = list(angles)
                chain.turn(angles)


class CommandScene:
    """The candidates in the cube of their ranges, and the ellipsoid of uncertainty."""

    def __init__(self, palette: Palette) -> None:
        camera = ui.scene.perspective_camera(fov=32)
        camera.x, camera.y, camera.z = 3.9, -4.8, 2.6
        self.scene = ui.scene(
            grid=False, camera=camera, background_color=palette.scene, fps=10
        ).classes("commands")
        self._palette = palette
        self._marks: dict[str, tuple[str, Any]] = {}
        self._cloud: Any = None
        with self.scene:
            ui.scene.box(2, 2, 2, wireframe=True).material(palette.metal, 0.5)
            self._body = ui.scene.sphere(1.0, 40, 24).material("#3b9de0", 0.28)
            self._mesh = ui.scene.sphere(1.005, 20, 12, wireframe=True)
            self._mesh.material("#3b9de0", 0.35)
            for index, name in enumerate(AXIS_NAMES):
                at = np.array([0.0, -1.0, -1.0])
                if index:
                    at = np.array([1.0, 0.0, -1.0] if index == 2 else [-1.0, -1.0, 0.0])
                style = f"color:{AXIS_COLORS[index]};font:600 12px system-ui"
                ui.scene.text(name, style).move(*(1.15 * at).tolist())

    def show(self, state: RunState) -> None:
        """Candidates, postures in the colour of their state, the ellipsoid."""
        ranges = np.array(state.setting("session", "ranges", [[-1, 1]] * 3))
        low, high = ranges.astype(np.float64).T

        def place(angles: Any) -> Any:
            u = (2 * np.asarray(angles, float) - (low + high)) / (high - low)
            return u[..., [0, 2, 1]]  # pitch along x, roll along y, yaw upwards

        with self.scene:
            if self._cloud is None and state.candidates:
                points = place(state.candidates).tolist()
                shade = self._palette.metal.lstrip("#")
                rgb = [int(shade[i : i + 2], 16) / 255 for i in (0, 2, 4)]
                self._cloud = ui.scene.point_cloud(points, [rgb] * len(points), 0.07)
            marked = state.by_role("select", "goto")[:MARKED]
            marked += [p for p in state.done if p.role == "collect"][-MARKED:]
            self._mark(marked, place)
        self._ellipsoid(state)

    def _mark(self, postures: list[Posture], place: Callable[[Any], Any]) -> None:
        """A sphere for each posture, redrawn where its state has changed."""
        looks = {p.name: p.state for p in postures if p.commanded is not None}
        for name, (look, mark) in [*self._marks.items()]:
            if looks.get(name) != look:
                mark.delete()
                del self._marks[name]
        for posture in postures:
            if posture.name in looks and posture.name not in self._marks:
                mark = ui.scene.sphere(0.065 if posture.state == "done" else 0.05)
                mark.material(STATE_COLORS.get(posture.state, ACTIVE_COLOR))
                mark.move(*place(posture.commanded).tolist())
                self._marks[posture.name] = (posture.state, mark)

    def _ellipsoid(self, state: RunState) -> None:
        chosen = [p for p in state.by_role("select") if p.state == "done"]
        for body in (self._body, self._mesh):
            body.visible(state.mode == "calibrate")
        noise = state.noise_deg
        std, directions = ellipsoid([p.commanded or [] for p in chosen], noise or KNOWN)
        radii = np.full(3, UNKNOWN)
        known = np.isfinite(std)
        decades = np.log10(np.maximum(std[known], KNOWN) / KNOWN)
        span = np.log10(1.0 / KNOWN)
        radii[known] = LEAST + (UNKNOWN - LEAST) * np.minimum(1.0, decades / span)
        turned = directions[[0, 2, 1]]
        turned[:, 0] *= np.sign(np.linalg.det(turned))
        for body in (self._body, self._mesh):
            body.scale(*radii.tolist()).rotate_R(turned.tolist())
