"""The plots as options of ECharts: pure functions of the state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rig.config import AXIS_NAMES
from rig.workbench.outputs.state import ACTIVE, Record, RunState

AXIS_COLORS = ["#3b9de0", "#e39a12", "#1fae85"]  # pitch, yaw, roll; on light and dark
MARK_COLORS = ["#8c98a655", "#e39a12", "#3b9de0", "#1fae85"]  # of `_commands`
TEXT, GRID = "#7b8794", "#8793a055"  # on both, too: style sheets do not reach a canvas
SHOWN_S = 30.0  # of telemetry
POINTS = 300  # of a line, at most

Points = list[list[Any]]  # (x, y) of one axis


def charts(
    state: RunState, samples: Sequence[Record], end: float
) -> dict[str, dict[str, Any]]:
    """The plots by their titles.

    Args:
        state: of the run.
        samples: of telemetry.
        end: Unix time at the right edge of those over time.
    """
    step = max(1, -(-len(samples) // POINTS))
    shown = [s for s in list(samples)[::step] if s["time"] > end - SHOWN_S]

    def over_time(key: str, least: float = -math.inf) -> list[Points]:
        told = [(round(s["time"] - end, 2), s[key]) for s in shown if s.get(key)]
        return [
            [[t, v[i] if v[i] is None else max(least, v[i])] for t, v in told]
            for i in range(3)
        ]

    recent = {"name": "seconds", "min": -SHOWN_S, "max": 0}
    angles = _lines(over_time("deg"))
    angles += _lines(
        over_time("drives"), ", drive", lineStyle={"width": 1, "type": [3, 3]}
    )
    settling = _lines(over_time("std", 0.001))
    if limit := state.setting("settle", "std_deg", None):
        settling[0]["markLine"] = {
            "silent": True,
            "symbol": "none",
            "lineStyle": {"color": "#d1453b", "type": "dashed"},
            "label": {"formatter": f"limit {limit:g}°", "position": "insideStartTop"},
            "data": [{"yAxis": limit}],
        }
    begin = state.drift[0][0] if state.drift else 0.0
    visits: list[Points] = [
        [[(when - begin) / 60, deg[i]] for when, deg in state.drift] for i in range(3)
    ]
    since = {"name": "minutes since the zero", "min": 0}
    drift = _lines(visits, showSymbol=True, symbolSize=7)
    return {
        "Angles": _chart(recent, angles),
        "Settling": _chart(recent, settling, type="log", min=0.001, max=100),
        "Commands": _commands(state),
        "Drift": _chart(since, drift),
    }


def _commands(state: RunState) -> dict[str, Any]:
    """Where the commands lie: pitch to the right, yaw upwards, roll as the size."""
    postures = [p for p in state.postures.values() if p.commanded]
    groups: dict[str, list[Any]] = {
        "candidate": state.candidates,
        "to come": [p.commanded for p in postures],
        "now": [p.commanded for p in postures if p.state in ACTIVE],
        "measured": [p.commanded for p in state.done],
    }
    low, high = state.setting("session", "ranges", [[-1.0, 1.0]] * 3)[2]

    def mark(pitch: float, yaw: float, roll: float) -> Record:
        share = (roll - low) / (high - low)
        return {"value": [pitch, yaw], "symbolSize": 5 + 8 * share}

    series = [
        {"type": "scatter", "name": name, "data": [mark(*point) for point in points]}
        for name, points in groups.items()
    ]
    pitch = {"name": "pitch, degrees", "scale": True}
    chart = _chart(pitch, series, name="yaw, degrees")
    chart["legend"] |= {"data": list(groups)}
    return chart | {"color": MARK_COLORS}


def _chart(x: Record, series: list[Record], **y: Any) -> dict[str, Any]:
    """Degrees of the three axes, unless ``y`` says otherwise."""
    label = {"color": TEXT, "fontSize": 11}
    rules = {"lineStyle": {"color": GRID}, "onZero": False}
    axis = {"type": "value", "axisLabel": label, "axisLine": rules, "splitLine": rules}
    below = {"nameLocation": "middle", "nameGap": 24, "nameTextStyle": label}
    above = {**label, "align": "left", "padding": [0, 0, 0, -40]}
    box = {"itemWidth": 14, "itemHeight": 8, "textStyle": label}
    return {
        "animation": False,
        "color": AXIS_COLORS,  # again from the first, where there are more lines
        "grid": {"left": 52, "right": 14, "top": 34, "bottom": 40},
        "legend": {"top": 0, "right": 8, "icon": "roundRect", **box}
        | {"data": list(AXIS_NAMES)},
        "xAxis": {**axis, **below, **x},
        "yAxis": {**axis, "name": "degrees", "scale": True, "nameTextStyle": above} | y,
        "series": series,
    }


def _lines(lines: list[Points], suffix: str = "", **look: Any) -> list[Record]:
    line = {"type": "line", "showSymbol": False, "symbol": "circle"}
    return [
        {**line, **look, "name": name + suffix, "data": data}
        for name, data in zip(AXIS_NAMES, lines, strict=True)
    ]
