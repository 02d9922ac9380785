"""Figures of how many postures, and of how long they take."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jaxcal.plots.style import BLACK, COLOURS, GREY, MARKERS, plain_axes

__all__ = ["pareto_figure", "plan_figure"]


def pareto_figure(fronts: dict[str, Any]) -> Figure:
    """Time against efficiency; filled markers are proven, hollow ones are not.

    Args:
        fronts: ``ParetoFront`` by the name to show.
    """
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
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
            markerfacecolor=colour if front.proven else "white",
            label=name + ("" if front.proven else " (not proven)"),
        )
    axes.set_xlabel("D-efficiency against the optimum")
    axes.set_ylabel("time of the run (s): travel and settling")
    axes.legend(frameon=False)
    plain_axes(axes)
    return figure


def plan_figure(plan: Any) -> Figure:
    """Accuracy against K: the designs, what no design beats, and the target.

    Args:
        plan: a ``Plan``; the output that is furthest from its target is drawn.
    """
    worst = plan.hardest_output
    ks = [row.k for row in plan.rows]
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    axes = figure.add_subplot()
    series = (
        ("standard_error", "design found", MARKERS[0], "-", COLOURS[0]),
        ("d_optimal_error", "D-optimal selection", MARKERS[1], "--", COLOURS[1]),
        ("least_error", "no design below", "", ":", GREY),
    )
    for field, label, marker, style, colour in series:
        values = [plan.worst(getattr(row, field)) for row in plan.rows]
        axes.plot(ks, values, marker=marker, linestyle=style, color=colour, label=label)
    target = plan.target_accuracy[worst]
    axes.axhline(target, color=BLACK, linewidth=0.8, label="target")
    axes.axvline(plan.k, color=BLACK, linewidth=0.8, linestyle=":")
    axes.set_xlabel("number of measurements K")
    axes.set_ylabel(f"{plan.summary} standard error of a prediction (measured unit)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False)
    plain_axes(axes)
    return figure
