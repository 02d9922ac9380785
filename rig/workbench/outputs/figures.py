"""Figures of the reports; each draws its data onto a matplotlib figure."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxcal.pages import Figure, Text
from rig.config import AXIS_NAMES
from rig.core.attitude import Array
from rig.journal import Record

MARKERS = {
    "select": "o", "before": "^", "after": "v", "reference": "s", "collect": ".",
    "goto": "*",
}  # fmt: skip
PLANES = ((0, 1), (0, 2), (1, 2))


def drawn(
    draw: Callable[[Any, Any], None], data: Any, size: tuple[float, float], alt: str
) -> Any:
    """A block of a page: the figure, or words where matplotlib is not installed."""
    try:
        import matplotlib.figure

        from jaxcal.plots import as_bytes
    except ModuleNotFoundError:
        missing = "no figure: matplotlib is not installed (pip install 'jaxcal[study]')"
        return Text(f"{alt}: {missing}", "note")
    figure = matplotlib.figure.Figure(figsize=size, layout="constrained")
    draw(figure, data)
    return Figure(as_bytes(figure, "png"), alt)


def errors(figure: Any, summary: Record) -> None:
    """Errors at held-out targets, raw beside compensated."""
    from jaxcal import plots

    axes = figure.subplots(1, 2)
    shown = (("raw", "before", "#D55E00"), ("compensated", "after", "#0072B2"))
    for axis, (title, key, colour) in zip(axes, shown, strict=True):
        each = {title: summary[key]["each"]}
        plots.before_after(axis, each, AXIS_NAMES, "deg", color=colour)


def postures(figure: Any, records: list[Record]) -> None:
    """Commands in the three planes, by role."""
    axes = figure.subplots(1, 3)
    for axis, (a, b) in zip(axes, PLANES, strict=True):
        for role, marker in MARKERS.items():
            points = [r["commanded_deg"] for r in records if r.get("role") == role]
            if points:
                u = np.array(points)
                axis.plot(u[:, a], u[:, b], marker, label=role)
        axis.set_xlabel(f"{AXIS_NAMES[a]} [deg]")
        axis.set_ylabel(f"{AXIS_NAMES[b]} [deg]")
    axes[0].legend(fontsize=8)


def readings(figure: Any, off: list[Array]) -> None:
    """(samples, 3) of each posture about its mean, one after another."""
    from jaxcal import plots

    axes = figure.subplots(3, 1, sharex=True)
    for axis, name, column in zip(axes, AXIS_NAMES, np.vstack(off).T, strict=True):
        plots.residuals(axis, column, markersize=2)
        axis.set(ylabel=f"{name} [deg]", xlabel="")
        for end in np.cumsum([len(values) for values in off])[:-1]:
            axis.axvline(end + 0.5, color="#E6E6E6", linewidth=0.8)
    axes[-1].set_xlabel("reading, posture by posture, less the posture's mean")


def parameters(figure: Any, runs: list[Record]) -> None:
    """A and b with their intervals, calibration after calibration."""
    axes = figure.subplots(3, 4, sharex=True)
    values = np.array([np.column_stack([r["A"], r["b"]]) for r in runs])
    wide = np.array([r["ci95"] for r in runs])
    days = np.array([r["time"] for r in runs]) / 86400.0
    for row, name in enumerate(AXIS_NAMES):
        for column, source in enumerate((*(f"u {each}" for each in AXIS_NAMES), "b")):
            axis = axes[row, column]
            y, e = values[:, row, column], wide[:, row, column]
            axis.errorbar(days - days[0], y, e, fmt="o-", capsize=3, markersize=4)
            axis.set_title(f"{name}: {source}", fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel("days")
