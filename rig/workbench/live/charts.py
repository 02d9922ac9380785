"""The plots as options of ECharts: pure functions of the state."""

from __future__ import annotations

import dataclasses
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


def _frame(palette: Palette, x: str, y: str, **more: Any) -> dict[str, Any]:
    label = {"color": palette.text, "fontSize": 11}
    lines = {"lineStyle": {"color": palette.grid}, "onZero": False}
    axis = {"axisLabel": label, "axisLine": lines, "splitLine": lines}
    name = {"nameTextStyle": label}
    return {
        "animation": False,
        "grid": {"left": 52, "right": 14, "top": 34, "bottom": 40},
        "legend": {
            "top": 0,
            "right": 8,
            "icon": "roundRect",
            "itemWidth": 14,
            "itemHeight": 8,
            "textStyle": label,
            "data": list(AXIS_NAMES),
        },
        "xAxis": {
            "type": "value",
            "name": x,
            "nameLocation": "middle",
            "nameGap": 24,
            **axis,
            **name,
        },
        "yAxis": {
            "type": "value",
            "name": y,
            "scale": True,
            **axis,
            "nameTextStyle": {**label, "align": "left", "padding": [0, 0, 0, -40]},
        },
        "series": [],
        **more,
    }


def _line(name: str, color: str, data: Sequence[Any], **more: Any) -> dict[str, Any]:
    return {
        "type": "line",
        "name": name,
        "data": data,
        "showSymbol": False,
        "itemStyle": {"color": color},
        "lineStyle": {"color": color, "width": 1.8},
        **more,
    }


def _limit(value: float, palette: Palette) -> dict[str, Any]:
    return {
        "silent": True,
        "symbol": "none",
        "lineStyle": {"color": "#d1453b", "type": "dashed"},
        "label": {
            "formatter": f"limit {value:g}°",
            "position": "insideStartTop",
            "color": palette.text,
            "fontSize": 10,
        },
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


def _over_time(samples: Sequence[Record], key: str, axis: int, end: float) -> list[Any]:
    step = max(1, -(-len(samples) // POINTS))
    return [
        [round(sample["time"] - end, 2), sample[key][axis]]
        for sample in list(samples)[::step]
        if sample.get(key) and sample["time"] > end - SHOWN_S
    ]


def attitude(
    state: RunState, samples: Sequence[Record], end: float, palette: Palette
) -> dict[str, Any]:
    """Measured (solid) and drive (dashed) angles; bands where it was measured."""
    options = _frame(palette, "seconds", "degrees")
    options["xAxis"] |= {"min": -SHOWN_S, "max": 0}
    for axis, (name, color) in enumerate(zip(AXIS_NAMES, AXIS_COLORS, strict=True)):
        data = _over_time(samples, "deg", axis, end)
        more = {} if axis else {"markArea": _measuring(state, end, palette)}
        options["series"].append(_line(name, color, data, **more))
        drive = _line(f"{name}, drive", color, _over_time(samples, "drives", axis, end))
        drive["lineStyle"] = {"color": color, "width": 1, "type": [3, 3]}
        options["series"].append(drive)
    return options


def settling(
    state: RunState, samples: Sequence[Record], end: float, palette: Palette
) -> dict[str, Any]:
    """Scatter over the settle window against its limit, logarithmic."""
    options = _frame(palette, "seconds", "degrees")
    options["xAxis"] |= {"min": -SHOWN_S, "max": 0}
    options["yAxis"] |= {"type": "log", "min": 0.001, "max": 100}
    limit = state.setting("settle", "std_deg")
    for axis, (name, color) in enumerate(zip(AXIS_NAMES, AXIS_COLORS, strict=True)):
        data = [
            [when, max(0.001, value)]
            for when, value in _over_time(samples, "std", axis, end)
        ]
        more = {}
        if not axis:
            more = {"markArea": _measuring(state, end, palette)}
            if limit == limit:
                more["markLine"] = _limit(limit, palette)
        options["series"].append(_line(name, color, data, **more))
    return options


def noise(state: RunState, palette: Palette) -> dict[str, Any]:
    """Scatter of the readings of every posture."""
    options = _frame(palette, "posture", "degrees")
    done = [posture for posture in state.done if posture.std][-POINTS:]
    options["xAxis"] |= {"min": 0, "max": max(5, len(done)) + 1, "minInterval": 1}
    options["yAxis"]["min"] = 0
    for axis, (name, color) in enumerate(zip(AXIS_NAMES, AXIS_COLORS, strict=True)):
        data = [[i + 1, (p.std or [0] * 3)[axis]] for i, p in enumerate(done)]
        more = {"showSymbol": True, "symbolSize": 6, "symbol": "circle"}
        options["series"].append(_line(name, color, data, **more))
        options["series"][-1]["lineStyle"]["width"] = 1
    return options


def drift(state: RunState, palette: Palette) -> dict[str, Any]:
    """The zero posture, read again, against the minutes since the zero was taken."""
    options = _frame(palette, "minutes since the zero", "degrees")
    begin = state.drift[0][0] if state.drift else 0.0
    options["xAxis"]["min"] = 0
    for axis, (name, color) in enumerate(zip(AXIS_NAMES, AXIS_COLORS, strict=True)):
        data = [[(when - begin) / 60, deg[axis]] for when, deg in state.drift]
        more = {"showSymbol": True, "symbolSize": 8, "symbol": "circle"}
        options["series"].append(_line(name, color, data, **more))
    return options
