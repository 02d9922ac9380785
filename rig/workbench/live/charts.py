"""The plots as options of ECharts: pure functions of the state."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from rig.config import AXIS_NAMES
from rig.workbench.live.state import Record, RunState

AXIS_COLORS = ("#3b9de0", "#e39a12", "#1fae85")  # pitch, yaw, roll; on light and dark
SHOWN_S = 30.0  # of telemetry
POINTS = 300  # of a line, at most


@dataclasses.dataclass(frozen=True)
class Palette:
    """Colours of canvases, which style sheets do not reach."""

    text: str
    grid: str
    scene: str
    metal: str
    plate: str


LIGHT = Palette("#5b6673", "#e3e7ec", "#f4f6f8", "#8c98a6", "#33475b")
DARK = Palette("#9aa7b5", "#2a323c", "#12171d", "#7d8a99", "#c4d0dc")

Axes = list[list[Any]]  # points (x, y) of pitch, yaw and roll


def charts(
    state: RunState, samples: Sequence[Record], end: float, palette: Palette
) -> dict[str, dict[str, Any]]:
    """The three plots by their titles.

    Args:
        state: of the run.
        samples: of telemetry.
        end: Unix time at the right edge of those over time.
        palette: of the browser.
    """
    step = max(1, -(-len(samples) // POINTS))
    shown = [s for s in list(samples)[::step] if s["time"] > end - SHOWN_S]

    def over_time(key: str, least: float = -math.inf) -> Axes:
        return [
            [
                [round(s["time"] - end, 2), v if v is None else max(least, v)]
                for s in shown
                if s.get(key)
                for v in [s[key][axis]]
            ]
            for axis in range(3)
        ]

    recent = {"name": "seconds", "min": -SHOWN_S, "max": 0}
    angles = _plot(palette, recent, over_time("deg"))
    dashed = {"width": 1, "type": [3, 3]}
    angles["series"] += _series(over_time("drives"), dashed, ", drive")
    settling = _plot(palette, recent, over_time("std", 0.001))
    settling["yAxis"] |= {"type": "log", "min": 0.001, "max": 100}
    if limit := state.setting("settle", "std_deg", None):
        settling["series"][0]["markLine"] = {
            "silent": True,
            "symbol": "none",
            "lineStyle": {"color": "#d1453b", "type": "dashed"},
            "label": {
                "formatter": f"limit {limit:g}°", "position": "insideStartTop",
                "color": palette.text, "fontSize": 10,
            },
            "data": [{"yAxis": limit}],
        }  # fmt: skip
    begin = state.drift[0][0] if state.drift else 0.0
    visits: Axes = [
        [[(when - begin) / 60, deg[axis]] for when, deg in state.drift]
        for axis in range(3)
    ]
    since = {"name": "minutes since the zero", "min": 0}
    drift = _plot(palette, since, visits, showSymbol=True, symbolSize=7)
    return {"Angles": angles, "Settling": settling, "Drift": drift}


def _plot(palette: Palette, x: Record, lines: Axes, **look: Any) -> dict[str, Any]:
    """Degrees of the three axes; ``look`` is of each line."""
    label = {"color": palette.text, "fontSize": 11}
    rules = {"lineStyle": {"color": palette.grid}, "onZero": False}
    axis = {"type": "value", "axisLabel": label, "axisLine": rules, "splitLine": rules}
    above = {**label, "align": "left", "padding": [0, 0, 0, -40]}
    legend = {"top": 0, "right": 8, "icon": "roundRect", "data": list(AXIS_NAMES)}
    return {
        "animation": False,
        "grid": {"left": 52, "right": 14, "top": 34, "bottom": 40},
        "legend": {**legend, "itemWidth": 14, "itemHeight": 8, "textStyle": label},
        "xAxis": {
            **axis,
            "nameLocation": "middle",
            "nameGap": 24,
            "nameTextStyle": label,
            **x,
        },
        "yAxis": {**axis, "name": "degrees", "scale": True, "nameTextStyle": above},
        "series": _series(lines, {"width": 1.8}, **look),
    }


def _series(lines: Axes, style: Record, suffix: str = "", **look: Any) -> list[Record]:
    shared = {"type": "line", "showSymbol": False, "symbol": "circle", **look}
    return [
        {
            **shared,
            "name": name + suffix,
            "data": data,
            "itemStyle": {"color": color},
            "lineStyle": {"color": color, **style},
        }
        for name, color, data in zip(AXIS_NAMES, AXIS_COLORS, lines, strict=True)
    ]
