"""The page: what is where, and when it is drawn anew."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from typing import Any

from nicegui import ui

from rig_workbench.live import draw
from rig_workbench.live.charts import charts
from rig_workbench.live.scene import DeviceScene
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
    "Commands": "Candidates and postures.",
    "Drift": "The zero posture, measured again; it should read zero.",
    "What happened": "",
}


OF_NUMBERS = {"Device": "", "Angles": "Solid: sensor. Dashed: drives."}


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
                    axes = watcher.state.names[0]
                    if title == "Commands" and len(axes) > 2:
                        note += f" The larger the mark, the larger the {axes[2]}."
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
