"""Results as a picture, ``.plot()``, and as notebooks show them, ``_repr_html_``."""

from __future__ import annotations

import html
from typing import Any

import numpy as np

from jaxcal.extras import MissingExtraError, needs


def _drawing(axes: Any, solid: bool = False) -> tuple[Any, Any]:
    """Axes to draw on, those given or of a new figure, and what draws there."""
    with needs("plots", "plot()"):
        from matplotlib.figure import Figure

        from jaxcal.reports import plots
    if axes is None:
        figure = Figure(figsize=(5.0, 4.0), layout="constrained")
        axes = figure.add_subplot(projection="3d" if solid else None)
    return axes, plots


def plot_selection(selection: Any, axes: Any = None) -> Any:
    """Candidates and the chosen ones.

    Two or three inputs are drawn as they are; one against the row; of more each input
    has a place, its range the height, and a chosen candidate is a line. Without
    commands, as of blocks, the share of det S that is left without each chosen one.

    Args:
        axes: matplotlib axes; those of a new figure if not given.

    Returns:
        The axes; ``axes.figure.savefig(path)`` writes a file.
    """
    candidates, chosen = selection.problem.candidates, selection.indices
    count = 0 if candidates is None else candidates.shape[1]
    axes, plots = _drawing(axes, solid=count == 3)
    if count == 0:
        axes.bar(selection.labels, selection.left_without)
        axes.set(xlabel="chosen", ylabel="share of det S left without it")
        return axes
    names = selection._axes()
    if count in (2, 3):
        return plots.selection(axes, candidates, chosen, names)
    if count == 1:
        rows = np.arange(len(candidates))
        both = np.column_stack([rows, candidates])
        axes.plot(*both.T, ".", color="#7F7F7F", label="candidates")
        axes.plot(*both[chosen].T, "o", label="selected")
        axes.set(xlabel="row", ylabel=names[0])
        return axes
    low, span = candidates.min(axis=0), np.ptp(candidates, axis=0)
    height = (candidates - low) / np.where(span > 0.0, span, 1.0)
    places = np.arange(count)
    axes.plot(places, height.T, ".", color="#7F7F7F", markersize=3)
    axes.plot(places, height[chosen].T, "o-", linewidth=0.8)
    axes.set_xticks(places, names)
    axes.set_ylabel("share of the candidates' range")
    return axes


def plot_calibration(calibration: Any, axes: Any = None) -> Any:
    """Residuals, measured less fitted, in the order of measurement; arguments and
    answer as of ``Selection.plot``."""
    axes, plots = _drawing(axes)
    names, unit = calibration.output_names, calibration.measured_unit
    return plots.residuals(axes, calibration.residuals, names, unit)


def plot_plan(plan: Any, axes: Any = None) -> Any:
    """Accuracy against the number of measurements, and the target; arguments and answer
    as of ``Selection.plot``."""
    axes, plots = _drawing(axes)
    return plots.plan(axes, plan)


def as_html(result: Any) -> str:
    """The text of a result, and its picture where matplotlib is installed."""
    text = f"<pre>{html.escape(str(result))}</pre>"
    if not hasattr(result, "plot"):
        return text
    try:
        axes = result.plot()
    except MissingExtraError:
        return text
    from jaxcal.reports.plots import as_bytes

    picture = as_bytes(axes.figure, "svg").decode()
    return text + picture[picture.index("<svg") :]
