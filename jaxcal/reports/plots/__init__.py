"""Pictures of selections and calibrations: matplotlib axes in, the same axes out.

``figure, axes = matplotlib.pyplot.subplots()``, then ``plots.selection(axes, ...)``.
"""

from jaxcal.extras import needs

with needs("plots", "jaxcal.reports.plots"):
    from jaxcal.reports.plots.drawings import (
        before_after,
        ellipsoid,
        pareto,
        plan,
        postures,
        residuals,
        scenarios,
        selection,
    )
    from jaxcal.reports.plots.style import as_bytes

__all__ = [
    "as_bytes",
    "before_after",
    "ellipsoid",
    "pareto",
    "plan",
    "postures",
    "residuals",
    "scenarios",
    "selection",
]
