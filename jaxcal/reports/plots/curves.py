"""Curves against the number of measurements and time; errors and residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from jaxcal.reports.plots.style import (
    BLACK,
    COLOURS,
    GREY,
    MARKERS,
    numbered,
    plain_axes,
    points,
)


def pareto(axes: Any, fronts: dict[str, Any]) -> Any:
    """Time against efficiency.

    Args:
        fronts: ``ParetoFront`` by the name to show.
    """
    for i, (name, front) in enumerate(fronts.items()):
        colour = COLOURS[i % len(COLOURS)]
        axes.plot(
            [point.efficiency for point in front.points],
            [point.seconds for point in front.points],
            drawstyle="steps-pre",
            color=colour,
            linewidth=1.0,
            marker=MARKERS[i % len(MARKERS)],
            markersize=5,
            label=name,
        )
    axes.set_ylabel("run time (s): travel and settling")
    return _finished(axes, "D-efficiency against the optimum")


def scenarios(axes: Any, report: Any) -> Any:
    """Efficiency in each scenario, the worst first, beside that of the nominal's own.

    Args:
        report: ``Selection.in_scenarios``, of a selection over scenarios.
    """
    count = np.arange(1, len(report.weights) + 1)
    curves = {"this design": report.efficiencies}
    if report.nominal_efficiencies is not None:
        curves["made at the nominal"] = report.nominal_efficiencies
    for i, (name, shares) in enumerate(curves.items()):
        axes.plot(count, np.sort(shares), label=name, markersize=4, **numbered(i))
    axes.set(ylabel="efficiency", ylim=(0.0, 1.05))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    return _finished(axes, "scenarios, the worst first")


def plan(axes: Any, plan: Any) -> Any:
    """Accuracy against K: the designs, what no design beats, and the target.

    Args:
        plan: a ``Plan``; the output that is furthest from its target is drawn.
    """
    series = (
        ("standard_error", "design found", MARKERS[0], "-", COLOURS[0]),
        ("least_error", "lower bound", "", ":", GREY),
    )
    ks = [row.k for row in plan.rows]
    for field, label, marker, style, colour in series:
        values = [plan.worst(getattr(row, field)) for row in plan.rows]
        axes.plot(ks, values, marker=marker, linestyle=style, color=colour, label=label)
    target = plan.accuracy[plan.hardest_output]
    axes.axhline(target, color=BLACK, linewidth=0.8, label="target")
    axes.axvline(plan.k, color=BLACK, linewidth=0.8, linestyle=":")
    axes.set_ylabel(f"{plan.summary} standard error of a prediction (measured unit)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylim(bottom=0.0)
    return _finished(axes, "number of measurements K")


def before_after(
    axes: Any,
    errors: dict[str, ArrayLike],
    names: Sequence[str] = (),
    unit: str = "",
) -> Any:
    """Errors of each output side by side, such as raw and calibrated.

    The legend gives each root mean square.

    Args:
        errors: label to (N, q) measured less desired.
        names: q names of the outputs.
        unit: of the errors.
    """
    axes.axhline(0.0, color=BLACK, linewidth=0.8)
    places = np.linspace(-0.2, 0.2, len(errors)) if len(errors) > 1 else [0.0]
    count = 0
    for i, (label, values) in enumerate(errors.items()):
        rows = np.atleast_2d(np.asarray(values, dtype=np.float64))
        count = rows.shape[1]
        spread = np.linspace(-0.07, 0.07, len(rows))[:, None]
        at = np.arange(count) + places[i] + spread
        rms = np.sqrt(np.mean(rows**2))
        shown = f"{rms:.3g}{unit}" if unit == "°" else f"{rms:.3g} {unit}".rstrip()
        axes.plot(at.ravel(), rows.ravel(), label=f"{label}: {shown} rms", **points(i))
    axes.set_xticks(range(count), names or [str(i + 1) for i in range(count)])
    axes.set_ylabel(f"error ({unit})" if unit else "error")
    above = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0)}  # clear of the points
    axes.legend(frameon=False, **above)
    plain_axes(axes)
    return axes


def residuals(
    axes: Any,
    values: ArrayLike,
    names: Sequence[str] = (),
    unit: str = "",
) -> Any:
    """Measured less fitted, in the order of measurement.

    Args:
        values: (N, q) residuals, such as ``Calibration.residuals``.
        names: q names of the outputs.
        unit: of the residuals.
    """
    table = np.asarray(values, dtype=np.float64)
    table = table[:, None] if table.ndim == 1 else table
    axes.axhline(0.0, color=BLACK, linewidth=0.8)
    for i, column in enumerate(table.T):
        label = names[i] if names else f"output {i + 1}"
        places = np.arange(1, len(column) + 1)
        axes.plot(places, column, label=label, **points(i))
    axes.set_xlabel("measurement")
    axes.set_ylabel(f"measured - fitted ({unit})" if unit else "measured - fitted")
    if table.shape[1] > 1:
        axes.legend(frameon=False)
    plain_axes(axes)
    return axes


def _finished(axes: Any, xlabel: str) -> Any:
    axes.set_xlabel(xlabel)
    axes.legend(frameon=False)
    plain_axes(axes)
    return axes
