"""Errors before and after a calibration, and residuals."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from jaxcal.reports.plots.style import BLACK, plain_axes, points


def before_after(
    axes: Any,
    errors: dict[str, ArrayLike],
    names: Sequence[str] = (),
    unit: str = "",
    **look: Any,
) -> Any:
    """Errors of each output side by side, such as raw and calibrated.

    Args:
        axes: matplotlib axes.
        errors: label to (N, q) measured less desired.
        names: q names of the outputs.
        unit: of the errors.
        look: passed on to ``plot``.

    Returns:
        ``axes``; the legend gives each root mean square.
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
        axes.plot(
            at.ravel(), rows.ravel(), label=f"{label}: {shown} rms", **points(i) | look
        )
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
    **look: Any,
) -> Any:
    """Measured less fitted, in the order of measurement.

    Args:
        axes: matplotlib axes.
        values: (N, q) residuals, such as ``Calibration.residuals``.
        names: q names of the outputs.
        unit: of the residuals.
        look: passed on to ``plot``.

    Returns:
        ``axes``.
    """
    table = np.asarray(values, dtype=np.float64)
    table = table[:, None] if table.ndim == 1 else table
    axes.axhline(0.0, color=BLACK, linewidth=0.8)
    for i, column in enumerate(table.T):
        label = names[i] if names else f"output {i + 1}"
        places = np.arange(1, len(column) + 1)
        axes.plot(places, column, label=label, **points(i) | look)
    axes.set_xlabel("measurement")
    axes.set_ylabel(f"measured - fitted ({unit})" if unit else "measured - fitted")
    if table.shape[1] > 1:
        axes.legend(frameon=False)
    plain_axes(axes)
    return axes
