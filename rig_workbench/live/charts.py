"""The plots as options of ECharts: pure functions of the state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rig.outputs.run_state import Record, RunState

# Of axes and of what is measured, in their order; on light and dark.
AXIS_COLORS = ["#3b9de0", "#e39a12", "#1fae85", "#b07ce8", "#e0568f", "#8c98a6"]
TEXT, GRID = "#7b8794", "#8793a055"  # on both, too: style sheets do not reach a canvas
SHOWN_S = 30.0  # of telemetry
POINTS = 300  # of a line, at most

Points = list[list[Any]]  # (x, y) of one axis


def charts(
    state: RunState, samples: Sequence[Record], end: float
) -> dict[str, dict[str, Any]]:
    """The plots by their titles; ``end`` is the Unix time at their right edge."""
    step = max(1, -(-len(samples) // POINTS))
    shown = [s for s in list(samples)[::step] if s["time"] > end - SHOWN_S]

    axes, outputs = state.names
    mark = "°" if state.unit == "deg" else f" {state.unit}"

    def over_time(key: str, count: int, least: float = -math.inf) -> list[Points]:
        told = [(round(s["time"] - end, 2), s[key]) for s in shown if s.get(key)]
        return [
            [[t, v[i] if v[i] is None else max(least, v[i])] for t, v in told]
            for i in range(count)
        ]

    recent = {"name": "seconds", "min": -SHOWN_S, "max": 0}
    angles = _lines(outputs, over_time("deg", len(outputs)))
    dashed = {"width": 1, "type": [3, 3]}
    drives = over_time("drives", len(axes))
    angles += _lines(axes, drives, ", drive", lineStyle=dashed)
    settling = _lines(outputs, over_time("std", len(outputs), 0.001))
    limit = state.setting("settle", "std_deg", None)
    if limit and settling:
        text = {"formatter": f"limit {limit:g}{mark}", "position": "insideStartTop"}
        look = {"color": "#d1453b", "type": "dashed"}
        line = {"silent": True, "symbol": "none", "lineStyle": look, "label": text}
        settling[0]["markLine"] = line | {"data": [{"yAxis": limit}]}
    begin = state.drift[0][0] if state.drift else 0.0
    visits: list[Points] = [
        [[(when - begin) / 60, deg[i]] for when, deg in state.drift]
        for i in range(len(outputs))
    ]
    since = {"name": "minutes since the zero", "min": 0}
    drift = _lines(outputs, visits, showSymbol=True, symbolSize=7)
    return {
        "Angles": _chart(state, recent, angles),
        "Settling": _chart(state, recent, settling, type="log", min=0.001, max=100),
        "Drift": _chart(state, since, drift),
    }


def _chart(
    state: RunState, x: Record, series: list[Record], **y: Any
) -> dict[str, Any]:
    """What is measured, unless ``y`` says otherwise."""
    unit = "degrees" if state.unit == "deg" else state.unit
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
        | {"data": state.names[1]},
        "xAxis": {**axis, **below, **x},
        "yAxis": {**axis, "name": unit, "scale": True, "nameTextStyle": above} | y,
        "series": series,
    }


def _lines(
    names: Sequence[str], lines: list[Points], suffix: str = "", **look: Any
) -> list[Record]:
    line = {"type": "line", "showSymbol": False, "symbol": "circle"}
    return [
        {**line, **look, "name": name + suffix, "data": data}
        for name, data in zip(names, lines, strict=True)
    ]
