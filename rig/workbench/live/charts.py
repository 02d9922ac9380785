"""The plots as options of ECharts: pure functions of the state."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from rig.config import AXIS_NAMES
from rig.workbench.live.state import Record, RunState
from rig.workbench.live.watcher import SHOWN_S

AXIS_COLORS = ("#3b9de0", "#e39a12", "#1fae85")  # pitch, yaw, roll; on light and dark
POINTS = 300  # of a line, at most


@dataclasses.dataclass(frozen=True)
class Palette:
    """Colours of canvases, which style sheets do not reach."""

    text: str
    grid: str
    scene: str
    metal: str
    plate: str
    band: str


LIGHT = Palette("#5b6673", "#e3e7ec", "#f4f6f8", "#8c98a6", "#33475b", "#3b9de018")
DARK = Palette("#9aa7b5", "#2a323c", "#12171d", "#7d8a99", "#c4d0dc", "#3b9de028")


Axes = tuple[list[Any], list[Any], list[Any]]  # points (x, y) of pitch, yaw and roll


def _options(palette: Palette, x: str, lines: Axes, **look: Any) -> dict[str, Any]:
    """A plot of degrees of the three axes; ``look`` is of each line."""
    label = {"color": palette.text, "fontSize": 11}
    rules = {"lineStyle": {"color": palette.grid}, "onZero": False}
    axis = {"type": "value", "axisLabel": label, "axisLine": rules, "splitLine": rules}
    above = {**label, "align": "left", "padding": [0, 0, 0, -40]}
    legend = {"top": 0, "right": 8, "icon": "roundRect", "data": list(AXIS_NAMES)}
    return {
        "animation": False,
        "grid": {"left": 52, "right": 14, "top": 34, "bottom": 40},
        "legend": {**legend, "itemWidth": 14, "itemHeight": 8, "textStyle": label},
        "xAxis": {**axis, "name": x, "nameLocation": "middle", "nameGap": 24},
        "yAxis": {**axis, "name": "degrees", "scale": True, "nameTextStyle": above},
        "series": _series(lines, {"width": 1.8}, "", **look),
    }


def _series(
    lines: Axes, style: dict[str, Any], suffix: str, **look: Any
) -> list[dict[str, Any]]:
    return [
        {
            "type": "line",
            "name": name + suffix,
            "data": data,
            "showSymbol": False,
            "itemStyle": {"color": color},
            "lineStyle": {"color": color, **style},
            **look,
        }
        for name, color, data in zip(AXIS_NAMES, AXIS_COLORS, lines, strict=True)
    ]


def _limit(value: float, palette: Palette) -> dict[str, Any]:
    label = {"formatter": f"limit {value:g}°", "position": "insideStartTop"}
    return {
        "silent": True,
        "symbol": "none",
        "lineStyle": {"color": "#d1453b", "type": "dashed"},
        "label": {**label, "color": palette.text, "fontSize": 10},
        "data": [{"yAxis": value}],
    }


def _measuring(state: RunState, end: float, palette: Palette) -> dict[str, Any]:
    """Bands over the times at which readings were taken."""
    bands, since = [], None
    for when, phase in [*state.phases, (end, "")]:
        if since is not None and when > end - SHOWN_S:
            bands.append([{"xAxis": since - end}, {"xAxis": when - end}])
        since = max(when, end - SHOWN_S) if phase == "measuring" else None
    return {"silent": True, "itemStyle": {"color": palette.band}, "data": bands}


def _over_time(samples: Sequence[Record], key: str, end: float, least: Any) -> Axes:
    """Points of (3,) ``key`` of the samples, in seconds before ``end``."""
    step = max(1, -(-len(samples) // POINTS))
    shown = [s for s in list(samples)[::step] if s.get(key)]
    shown = [s for s in shown if s["time"] > end - SHOWN_S]

    def line(axis: int) -> list[Any]:
        values = ((s["time"] - end, s[key][axis]) for s in shown)
        return [[round(t, 2), v if v is None else max(least, v)] for t, v in values]

    return line(0), line(1), line(2)


def attitude(
    state: RunState, samples: Sequence[Record], end: float, palette: Palette
) -> dict[str, Any]:
    """Measured (solid) and drive (dashed) angles; bands where it was measured."""
    lines = _over_time(samples, "deg", end, -math.inf)
    options = _options(palette, "seconds", lines)
    options["xAxis"] |= {"min": -SHOWN_S, "max": 0}
    options["series"][0]["markArea"] = _measuring(state, end, palette)
    drives = _over_time(samples, "drives", end, -math.inf)
    dashed = {"width": 1, "type": [3, 3]}
    options["series"] += _series(drives, dashed, ", drive")
    return options


def settling(
    state: RunState, samples: Sequence[Record], end: float, palette: Palette
) -> dict[str, Any]:
    """Scatter over the settle window against its limit, logarithmic."""
    options = _options(palette, "seconds", _over_time(samples, "std", end, 0.001))
    options["xAxis"] |= {"min": -SHOWN_S, "max": 0}
    options["yAxis"] |= {"type": "log", "min": 0.001, "max": 100}
    options["series"][0]["markArea"] = _measuring(state, end, palette)
    if math.isfinite(limit := state.setting("settle", "std_deg")):
        options["series"][0]["markLine"] = _limit(limit, palette)
    return options


def _marked(
    palette: Palette, x: str, points: list[tuple[float, Any]]
) -> dict[str, Any]:
    """Marks of pairs: a place along x, and its (3,) values."""
    a, b, c = ([[at, values[axis]] for at, values in points] for axis in range(3))
    marks = {"showSymbol": True, "symbolSize": 7, "symbol": "circle"}
    options = _options(palette, x, (a, b, c), **marks)
    options["xAxis"]["min"] = 0
    return options


def noise(state: RunState, palette: Palette) -> dict[str, Any]:
    """Scatter of the readings of every posture."""
    done = [posture.std for posture in state.done if posture.std][-POINTS:]
    options = _marked(palette, "posture", [(i + 1, std) for i, std in enumerate(done)])
    options["xAxis"] |= {"max": max(5, len(done)) + 1, "minInterval": 1}
    options["yAxis"]["min"] = 0
    return options


def drift(state: RunState, palette: Palette) -> dict[str, Any]:
    """The zero posture, read again, against the minutes since the zero was taken."""
    begin = state.drift[0][0] if state.drift else 0.0
    points = [((when - begin) / 60, deg) for when, deg in state.drift]
    return _marked(palette, "minutes since the zero", points)
