"""Curves against the number of measurements, and against time."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator

from jaxcal.reports.plots.style import (
    BLACK,
    COLOURS,
    GREY,
    MARKERS,
    numbered,
    plain_axes,
)


def pareto(axes: Any, fronts: dict[str, Any]) -> Any:
    """Time against efficiency.

    Args:
        axes: matplotlib axes.
        fronts: ``ParetoFront`` by the name to show.

    Returns:
        ``axes``.
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
        axes: matplotlib axes.
        report: ``Selection.in_scenarios``, of a selection over scenarios.

    Returns:
        ``axes``.
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
        axes: matplotlib axes.
        plan: a ``Plan``; the output that is furthest from its target is drawn.

    Returns:
        ``axes``.
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


def _finished(axes: Any, xlabel: str) -> Any:
    axes.set_xlabel(xlabel)
    axes.legend(frameon=False)
    plain_axes(axes)
    return axes
