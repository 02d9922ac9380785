"""Figures of sessions of deciders."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from jaxcal.adaptive.evaluation import DeciderEvaluation
from jaxcal.evaluation.figures import intervals, styles_of
from jaxcal.reports.plots.style import GREY, panels


def decider_figures(evaluation: DeciderEvaluation) -> dict[str, Figure]:
    """Mean nats by method, and less those of the rival in pairs, 95 % intervals."""
    results, rival = evaluation.results, evaluation.rival
    names = [result.method for result in results]
    size = (9.0, 0.9 + 0.42 * len(names))
    figure, axes_pair = panels(size, shape=(1, 2))
    nats_of = [result.values[:, 0] for result in results]
    less = [evaluation.less(result)[:, 0] for result in results]
    for axes, samples in zip(axes_pair, (nats_of, less), strict=True):
        ends = []
        for values in samples:
            half = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
            ends.append(values.mean() + np.array([-half, 0.0, half]))
        intervals(axes, names, ends, styles_of(results))
    axes_pair[0].set_xlabel("information gained in a session (nats)")
    axes_pair[1].set_xlabel(f"paired difference to {rival} (nats)")
    axes_pair[1].axvline(0.0, color=GREY, linestyle="--", zorder=0)
    return {"sequential": figure}
