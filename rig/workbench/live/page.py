"""The page: what is where, and when it is drawn anew."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from typing import Any

from nicegui import ui

from rig.workbench.live import charts, words
from rig.workbench.live.charts import DARK, LIGHT, Palette
from rig.workbench.live.scene import CommandScene, DeviceScene
from rig.workbench.live.watcher import Watcher

TICK_S = 0.1
ANSWER_S = 10.0  # for a browser to show what it was sent
PLOT_TICKS = 5  # ticks between two drawings of the plots over time
HEAD = """
<link rel="stylesheet" href="/page.css">
<script src="/page.js" defer></script>
"""
# Stands before anything is connected: STOP works from the first moment.
BODY = """
<header id="head">{head}</header>
<div id="actions" {hidden}>
  <p id="answer" role="status" aria-live="assertive"></p>
  <button id="pause" type="button">PAUSE<small>after this posture</small></button>
  <button id="stop" type="button">STOP<small>all drives, now</small></button>
</div>
"""
DARK_QUERY = "matchMedia('(prefers-color-scheme: dark)').matches"


def _card(title: str, note: str = "", kind: str = "") -> Any:
    """A titled section; what is made inside it stands below the title."""
    card = ui.element("section").classes(f"card {kind}")
    with card:
        head = f"<h2>{words.text(title)}</h2>"
        ui.html(head + (f"<p class='note'>{words.text(note)}</p>" if note else ""))
    return card


def _clock(when: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(when))


class LivePage:
    """One browser's view of a run."""

    def __init__(self, watcher: Watcher, palette: Palette) -> None:
        self.watcher, self.palette = watcher, palette
        self._version = -1
        self._ticks = 0
        with ui.element("div").classes("live"):
            self._trouble = ui.html().classes("trouble")
            self._verdict = ui.html().classes("card verdict")
            with _card("Device", kind="first"):
                ui.html(
                    "<p class='note'>Solid: as the phone measures. <b class='ghost'>"
                    "Ghost</b>: as commanded. They differ by what is calibrated.</p>"
                )
                self._device = DeviceScene(watcher.state, palette)
                self._numbers = ui.html().classes("wide")
                self._stream = ui.html(tag="p").classes("note")
            with _card("Postures", kind="tall"):
                self._queue = ui.html()
            note = "Solid: phone. Dashed: drives. Bands: readings were taken."
            with _card("Angles", note):
                self._attitude = ui.echart({})
            note = "Standard deviation over the settle window. Bands: readings."
            with _card("Settling", note):
                self._settling = ui.echart({})
            note = (
                "Cube: ranges of the commands with the candidates. Green: measured. "
                "Ellipsoid: uncertainty of the slopes on a logarithmic scale; it fills "
                "the cube along directions that no posture has measured."
            )
            with _card("What is known", note, "known"):
                self._commands = CommandScene(palette)
                self._uncertainty = ui.html()
            with _card("Noise", "Scatter of the readings of each posture."):
                self._noise = ui.echart({})
            note = "The zero posture, read again; it should read zero."
            with _card("Drift", note):
                self._drift = ui.echart({})
            with _card("What happened", kind="whole"):
                self._log = ui.html()
        self.update()

    async def tick(self) -> None:
        """Ten times a second: turn the device; draw anew what has changed.

        A browser that is slower than that is waited for, so that it shows the present
        less often and not an ever older past.
        """
        self._ticks += 1
        self._follow()
        if self.watcher.version != self._version:
            self.update()
        elif self.watcher.running and self._ticks % PLOT_TICKS == 0:
            self._plot()
        with contextlib.suppress(TimeoutError):
            await ui.run_javascript("0", timeout=ANSWER_S)

    def _follow(self) -> None:
        watcher, state = self.watcher, self.watcher.state
        sample = watcher.samples[-1] if watcher.samples else {}
        measured, commanded = sample.get("deg"), state.target
        if not watcher.running and state.done:
            measured, commanded = state.done[-1].measured, state.done[-1].commanded
        self._device.show(measured, commanded)
        table = words.numbers(state, sample, watcher.running)
        self._numbers.set_content(table)
        self._stream.set_content(words.stream(sample, watcher.running, time.time()))

    def _plot(self) -> None:
        watcher = self.watcher
        end = time.time() if watcher.running else watcher.state.time
        data = (watcher.state, watcher.samples, end, self.palette)
        _draw(self._attitude, charts.attitude(*data))
        _draw(self._settling, charts.settling(*data))

    def update(self) -> None:
        """Draw everything that follows from the journal."""
        watcher, state = self.watcher, self.watcher.state
        self._version = watcher.version
        tone = words.headline(state, watcher.running)[0]
        head = words.head(state, watcher.running, watcher.folder.name)
        ui.run_javascript(f"live.head({json.dumps(head)}, {json.dumps(watcher.here)})")
        self._show(self._trouble, words.trouble(
            state, watcher.running, str(watcher.folder)
        ))  # fmt: skip
        report = watcher.report is not None
        self._show(self._verdict, words.verdict(state, watcher.summary, report))
        for card in (self._trouble, self._verdict):
            card.classes(tone, remove="run good warn bad")
        self._queue.set_content(words.queue(state))
        self._uncertainty.set_content(words.uncertainty(state))
        self._log.set_content(words.happened(state, _clock))
        self._commands.show(state)
        _draw(self._noise, charts.noise(state, self.palette))
        _draw(self._drift, charts.drift(state, self.palette))
        self._plot()

    @staticmethod
    def _show(element: Any, content: str) -> None:
        element.set_content(content)
        element.set_visibility(bool(content))


def _draw(chart: Any, options: dict[str, Any]) -> None:
    chart.options.clear()
    chart.options.update(options)
    chart.update()


def make_page(watcher: Watcher) -> Any:
    """The function that builds the page for a browser."""

    async def page() -> None:
        ui.add_head_html(HEAD)
        state, hidden = watcher.state, "" if watcher.here else "hidden"
        head = words.head(state, watcher.running, watcher.folder.name)
        ui.add_body_html(BODY.format(head=head, hidden=hidden))
        await ui.context.client.connected()
        dark = await ui.run_javascript(DARK_QUERY, timeout=20.0)
        while not watcher.state.start:  # the device's axes are drawn from it
            await asyncio.sleep(TICK_S)
        live = LivePage(watcher, DARK if dark else LIGHT)
        ui.timer(TICK_S, live.tick)

    return page
