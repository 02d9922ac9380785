"""The plots as options of ECharts: pure functions of the state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rig.config import AXIS_NAMES
from rig.workbench.outputs.state import ACTIVE, Record, RunState

AXIS_COLORS = ("#3b9de0", "#e39a12", "#1fae85")  # pitch, yaw, roll; on light and dark
TEXT, GRID = "#7b8794", "#8793a055"  # on both, too: style sheets do not reach a canvas
SHOWN_S = 30.0  # of telemetry
POINTS = 300  # of a line, at most

Axes = list[list[Any]]  # points (x, y) of pitch, yaw and roll


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
    angles = _plot(recent, over_time("deg"))
    dashed = {"width": 1, "type": [3, 3]}
    angles["series"] += _lines(over_time("drives"), dashed, ", drive")
    settling = _plot(recent, over_time("std", 0.001))
    settling["yAxis"] |= {"type": "log", "min": 0.001, "max": 100}
    if limit := state.setting("settle", "std_deg", None):
        settling["series"][0]["markLine"] = {
            "silent": True,
            "symbol": "none",
            "lineStyle": {"color": "#d1453b", "type": "dashed"},
            "label": {"formatter": f"limit {limit:g}°", "position": "insideStartTop"},
            "data": [{"yAxis": limit}],
        }
    begin = state.drift[0][0] if state.drift else 0.0
    visits: Axes = [
        [[(when - begin) / 60, deg[axis]] for when, deg in state.drift]
        for axis in range(3)
    ]
    since = {"name": "minutes since the zero", "min": 0}
    drift = _plot(since, visits, showSymbol=True, symbolSize=7)
    return {
        "Angles": angles,
        "Settling": settling,
        "Commands": _commands(state),
        "Drift": drift,
    }


def _commands(state: RunState) -> dict[str, Any]:
    """Where the commands lie: pitch to the right, yaw upwards, roll as the size."""
    postures = [p for p in state.postures.values() if p.commanded]
    groups: dict[str, tuple[str, list[Any]]] = {
        "candidate": ("#8c98a655", state.candidates),
        "to come": (AXIS_COLORS[1], [p.commanded for p in postures]),
        "now": ("#3b9de0", [p.commanded for p in postures if p.state in ACTIVE]),
        "measured": ("#1fae85", [p.commanded for p in state.done]),
    }
    low, high = state.setting("session", "ranges", [[-1.0, 1.0]] * 3)[2]

    def mark(pitch: float, yaw: float, roll: float) -> Record:
        share = (roll - low) / (high - low)
        return {"value": [pitch, yaw], "symbolSize": 5 + 8 * share}

    chart = _axes({"name": "pitch, degrees", "scale": True}, list(groups))
    chart["yAxis"]["name"] = "yaw, degrees"
    chart["series"] = [
        {
            "type": "scatter",
            "name": name,
            "itemStyle": {"color": color},
            "data": [mark(*point) for point in points],
        }
        for name, (color, points) in groups.items()
    ]
    return chart


def _axes(x: Record, legend: list[str]) -> dict[str, Any]:
    label = {"color": TEXT, "fontSize": 11}
    rules = {"lineStyle": {"color": GRID}, "onZero": False}
    axis = {"type": "value", "axisLabel": label, "axisLine": rules, "splitLine": rules}
    below = {"nameLocation": "middle", "nameGap": 24, "nameTextStyle": label}
    above = {**label, "align": "left", "padding": [0, 0, 0, -40]}
    box = {"itemWidth": 14, "itemHeight": 8, "textStyle": label}
    return {
        "animation": False,
        "grid": {"left": 52, "right": 14, "top": 34, "bottom": 40},
        "legend": {"top": 0, "right": 8, "icon": "roundRect", "data": legend, **box},
        "xAxis": {**axis, **below, **x},
        "yAxis": {**axis, "name": "degrees", "scale": True, "nameTextStyle": above},
    }


def _plot(x: Record, lines: Axes, **look: Any) -> dict[str, Any]:
    """Degrees of the three axes; ``look`` is of each line."""
    drawn = _lines(lines, {"width": 1.8}, **look)
    return {**_axes(x, list(AXIS_NAMES)), "series": drawn}


def _lines(lines: Axes, style: Record, suffix: str = "", **look: Any) -> list[Record]:
    return [
        {
            "type": "line", "showSymbol": False, "symbol": "circle", **look,
            "name": name + suffix,
            "data": data,
            "itemStyle": {"color": color},
            "lineStyle": {"color": color, **style},
        }
        for name, color, data in zip(AXIS_NAMES, AXIS_COLORS, lines, strict=True)
    ]  # fmt: skip
