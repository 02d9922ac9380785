"""The page: what is where, and when it is drawn anew."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import time
from typing import Any

import numpy as np
from nicegui import ui

from rig.outputs.run_state import Degrees
from rig_workbench.live import draw
from rig_workbench.live.charts import AXIS_COLORS, charts
from rig_workbench.live.watcher import Watcher
from rig_workbench.outputs import view

TICK_S = 0.1
ANSWER_S = 10.0  # for a browser to show what it was sent
PLOT_TICKS = 5  # ticks between two drawings of the plots over time
HEAD = """
<link rel="stylesheet" href="/page.css">
<script src="/page.js" defer></script>
"""
NOTES = {  # of the cards, in their order: below the title
    "Device": "Solid: measured by the phone. Ghost: commanded. The difference is what "
    "is calibrated.",
    "Postures": "",
    "Angles": "Solid: phone. Dashed: drives.",
    "Settling": "Standard deviation over the settle window.",
    "Drift": "The zero posture, measured again; it should read zero.",
    "What happened": "",
}
OF_NUMBERS = {"Device": "", "Angles": "Solid: sensor. Dashed: drives."}

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


class LivePage:
    """One browser's view of a run."""

    def __init__(self, watcher: Watcher) -> None:
        self.watcher = watcher
        self._version = -1
        self._ticks = 0
        self._parts: dict[str, Any] = {}  # HTML by the macro that draws it
        self._charts: dict[str, Any] = {}
        with ui.element("div").classes("live"):
            for name in ("trouble", "verdict"):
                self._parts[name] = ui.html().classes(f"card {name}")
            for title, note in NOTES.items():
                kind = title.lower().replace(" ", "-")
                with ui.element("section").classes(f"card card-{kind}"):
                    if watcher.state.start.get("config", {}).get("readings"):
                        note = OF_NUMBERS.get(title, note)
                    ui.html(f"<h2>{title}</h2><p class='note'>{note}</p>")
                    self._fill(title)
        self.update()

    def _fill(self, title: str) -> None:
        match title:
            case "Device":
                self._device = DeviceScene(self.watcher.state.start.get("config", {}))
                self._parts["numbers"] = ui.html().classes("wide")
                self._stream = ui.label().classes("note")
            case "Postures":
                self._parts["queue"] = ui.html()
            case "What happened":
                self._parts["log"] = ui.html()
            case _:
                self._charts[title] = ui.echart({})

    async def tick(self) -> None:
        """Ten times a second: turn the device; draw anew what has changed. A slower
        browser is waited for: it shows the present, and no ever older past."""
        self._ticks += 1
        self._follow()
        if self.watcher.version != self._version:
            self.update()
        elif self.watcher.running and self._ticks % PLOT_TICKS == 0:
            self._plot()
        with contextlib.suppress(TimeoutError):
            await ui.run_javascript("0", timeout=ANSWER_S)

    def _follow(self) -> None:
        watcher = self.watcher
        sample = watcher.samples[-1] if watcher.running and watcher.samples else {}
        now = watcher.state.present(sample, watcher.running)
        self._device.show(now["measured"], now["commanded"])
        rows = view.numbers(now, watcher.running, watcher.state.names)
        self._parts["numbers"].set_content(draw("numbers", rows=rows))
        self._stream.set_text(view.stream(sample, time.time()))

    def _plot(self) -> None:
        watcher = self.watcher
        end = time.time() if watcher.running else watcher.state.time
        for title, options in charts(watcher.state, watcher.samples, end).items():
            chart = self._charts[title]
            chart.options.clear()
            chart.options.update(options)
            chart.update()

    def update(self) -> None:
        """Draw everything that follows from the journal."""
        watcher, state = self.watcher, self.watcher.state
        self._version = watcher.version
        head = json.dumps(_head(watcher))
        ui.run_javascript(f"live.head({head}, {json.dumps(watcher.here)})")
        tone = view.headline(state, watcher.running)[0]
        lines = view.trouble(state, watcher.running, str(watcher.folder))
        result = view.verdict(state, watcher.summary)
        postures, count = view.queue(state), len(state.postures)
        for name, content in {
            "trouble": draw("trouble", lines=lines),
            "verdict": draw("verdict", lines=result, report=watcher.report),
            "queue": draw("queue", postures=postures, count=count),
            "log": draw("log", lines=state.log),
        }.items():
            part = self._parts[name]
            part.set_content(content)
            if name in ("trouble", "verdict"):
                part.set_visibility(bool(content.strip()))
                part.classes(tone, remove="run good warn bad")
        self._plot()


def _head(watcher: Watcher) -> str:
    state = watcher.state
    now, said = view.headline(state, watcher.running), view.progress(state)
    return draw("head", state=state, now=now, said=said, folder=watcher.folder.name)


def make_page(watcher: Watcher) -> Any:
    """The function that builds the page for a browser."""

    async def page() -> None:
        ui.add_head_html(HEAD)
        # Stands before anything is connected: STOP works from the first moment.
        ui.add_body_html(draw("body", head=_head(watcher), here=watcher.here))
        await ui.context.client.connected()
        while not watcher.state.start:  # the device's axes are drawn from it
            await asyncio.sleep(TICK_S)
        ui.timer(TICK_S, LivePage(watcher).tick)

    return page
