"""Four against fifty, accuracy over K, error ellipses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter
from numpy.typing import NDArray
from scipy import stats

from jaxcal.paper.exhibits.figures.parts import (
    band,
    legend_below,
    numbered,
    panels,
    plain_log,
)
from jaxcal.plots import BLACK, COLOURS, GREY

__all__ = ["ellipses", "four_against_fifty", "number_of_postures"]

Array = NDArray[np.float64]

_LABELS = {
    "white noise": "white noise (° s.d.)",
    "drift": "drift of the bias (° s.d. per posture)",
    "outliers": "share of gross errors",
}


def four_against_fifty(curves: Mapping[str, Any]) -> Figure:
    """Mean error of prediction of four and fifty postures, and how often four win.

    Args:
        curves: by scenario, a list of ``strength``, ``four``, ``fifty``,
            ``four_better``.
    """
    title = "Four postures against fifty, on the same devices"
    figure, axes = panels(
        (10.0, 5.2), title, 2, len(curves), height_ratios=(3, 2), sharey="row"
    )
    for column, (scenario, curve) in enumerate(curves.items()):
        upper, lower = axes[:, column]
        x = np.arange(float(len(curve)))
        for i, (each, name, label) in enumerate(
            (
                (upper, "four", "policy's four"),
                (upper, "fifty", "all fifty"),
                (lower, "four_better", "four better"),
            )
        ):
            ends = [(e[name].value, e[name].low, e[name].high) for e in curve]
            band(each, x, *np.transpose(ends), label=label, **numbered(i))
            each.set_xticks(x, [f"{entry['strength']:g}" for entry in curve])
        upper.set_yscale("log")
        plain_log(upper.yaxis)
        upper.set_title(scenario, fontsize=10)
        lower.axhline(0.5, color=BLACK, linewidth=0.6)
        lower.set(ylim=(-0.03, 1.03), xlabel=_LABELS[scenario])
    axes[0, 0].set_ylabel("error of prediction (° rms,\nmean; band: its 95 % interval)")
    axes[1, 0].set_ylabel("share of devices\non which four win")
    axes[0, 0].legend(fontsize=8, frameon=False)
    return figure


def number_of_postures(
    table: Mapping[str, Array], noise_std_deg: float, drift_deg: float
) -> Figure:
    """Median error of prediction over K, white noise and drift side by side.

    Args:
        table: ``scenario``, ``choice``, ``K``, ``median_rms_deg``, ``low``, ``high``.
        noise_std_deg: of a reading, in both.
        drift_deg: step of the bias from a posture to the next.
    """
    titles = {
        "white noise": f"white noise, {noise_std_deg}°",
        "drift": f"white noise, {noise_std_deg}°, and drift, {drift_deg}° per posture",
    }
    figure, axes = panels(
        (9.0, 3.9), "Number of postures against accuracy", 1, 2, sharey=True
    )
    for each, (scenario, title) in zip(axes, titles.items(), strict=True):
        for i, choice in enumerate(("D-optimal", "random")):
            keep = (table["scenario"] == scenario) & (table["choice"] == choice)
            columns = [table[c][keep] for c in ("K", "median_rms_deg", "low", "high")]
            band(each, *columns, label=choice, **numbered(i))
        each.set(xscale="log", yscale="log", xlabel="postures measured, K")
        each.xaxis.set_major_locator(FixedLocator([4, 6, 8, 12, 20, 30, 50]))
        each.xaxis.set_minor_locator(NullLocator())
        each.xaxis.set_major_formatter(ScalarFormatter())
        plain_log(each.yaxis)
        each.set_title(title, fontsize=10)
        each.legend(fontsize=8, frameon=False)
    axes[0].set_ylabel("error of prediction\n(° rms, median; band: its 95 % interval)")
    return figure


def ellipses(
    covariance: Mapping[str, Array], centre: Array, estimates: Array
) -> Figure:
    """95 % ellipses of pairs of a11, a12, a13, bx.

    Args:
        covariance: (4, 4) of those four, by choice of postures.
        centre: (4,) true values.
        estimates: (R, 4) simulated ones, of the policy.
    """
    names = ("a11", "a12", "a13", "bx (°)")
    title = "95 % error ellipses of the pitch row of A and b (+: set values)"
    figure, axes = panels((10.0, 3.6), title, 1, 3)
    looks = {
        "random, median draw": (GREY, ":"),
        "policy": (COLOURS[0], "-"),
        "all 50": (COLOURS[2], "--"),
    }
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    circle = np.sqrt(stats.chi2.ppf(0.95, 2)) * np.stack([np.cos(turn), np.sin(turn)])
    dots = {"linestyle": "none", "marker": ".", "markersize": 2.5, "color": COLOURS[5]}
    for each, pair in zip(axes, ([0, 1], [1, 2], [0, 3]), strict=True):
        each.plot(*estimates[:, pair].T, label="simulated, policy", **dots)
        for label, matrix in covariance.items():
            colour, line = looks[label]
            root = np.linalg.cholesky(matrix[np.ix_(pair, pair)])
            ring = centre[pair, None] + root @ circle
            each.plot(*ring, color=colour, linestyle=line, label=label)
        each.plot(*centre[pair], marker="+", color=BLACK, markersize=8)
        each.set(xlabel=names[pair[0]], ylabel=names[pair[1]])
        each.locator_params(nbins=5)
    legend_below(figure, axes[0])
    return figure
