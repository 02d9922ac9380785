"""Four against fifty, accuracy over K, error ellipses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import (
    FixedLocator,
    FuncFormatter,
    LogLocator,
    NullLocator,
    ScalarFormatter,
)
from numpy.typing import NDArray

from jaxcal.plots import (
    BLACK,
    COLOURS,
    GREY,
    MARKERS,
    STYLES,
    plain_axes,
)

__all__ = ["ellipses", "four_against_fifty", "number_of_postures"]

Array = NDArray[np.float64]

_LABELS = {
    "white noise": "white noise (° s.d.)",
    "drift": "drift of the bias (° s.d. a posture)",
    "outliers": "share of gross errors",
}


def four_against_fifty(curves: Mapping[str, Any]) -> Figure:
    """Mean error of prediction of four and fifty postures, and how often four win.

    Args:
        curves: by scenario, a list of ``strength``, ``four``, ``fifty``,
            ``four_better``.
    """
    figure = Figure(figsize=(10.0, 5.2), layout="constrained")
    panels = figure.subplots(2, len(curves), height_ratios=(3, 2), sharey="row")
    for column, (scenario, curve) in enumerate(curves.items()):
        upper, lower = panels[0, column], panels[1, column]
        x = np.arange(float(len(curve)))
        for i, (name, label) in enumerate(
            (("four", "policy's four"), ("fifty", "all fifty"))
        ):
            values = [entry[name] for entry in curve]
            _band(upper, x, values, label, i)
        upper.set_yscale("log")
        _plain_log(upper.yaxis)
        upper.set_title(scenario, fontsize=10)
        better = [entry["four_better"] for entry in curve]
        _band(lower, x, better, "four better", 2)
        lower.axhline(0.5, color=BLACK, linewidth=0.6)
        lower.set_ylim(-0.03, 1.03)
        lower.set_xlabel(_LABELS[scenario])
        for axes in (upper, lower):
            plain_axes(axes)
            axes.set_xticks(x, [f"{entry['strength']:g}" for entry in curve])
    panels[0, 0].set_ylabel(
        "error of prediction (° rms,\nmean; band: its 95 % interval)"
    )
    panels[1, 0].set_ylabel("share of devices\non which four win")
    panels[0, 0].legend(fontsize=8, frameon=False)
    figure.suptitle("Four postures against fifty, on the same devices", fontsize=10)
    return figure


def _band(axes: Any, x: Array, intervals: list[Any], label: str, i: int) -> None:
    axes.fill_between(
        x,
        [v.low for v in intervals],
        [v.high for v in intervals],
        color=COLOURS[i],
        alpha=0.25,
        linewidth=0,
    )
    axes.plot(
        x,
        [v.value for v in intervals],
        color=COLOURS[i],
        linestyle=STYLES[i],
        marker=MARKERS[i],
        markersize=4,
        label=label,
    )


def _plain_log(axis: Any) -> None:
    """1, 2, 5 of each decade, written out."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())


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
        "drift": f"white noise, {noise_std_deg}°, and drift, {drift_deg}° a posture",
    }
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, scenario in zip(panels, ("white noise", "drift"), strict=True):
        for i, choice in enumerate(("D-optimal", "random")):
            keep = (table["scenario"] == scenario) & (table["choice"] == choice)
            k = table["K"][keep]
            axes.fill_between(
                k,
                table["low"][keep],
                table["high"][keep],
                color=COLOURS[i],
                alpha=0.25,
                linewidth=0,
            )
            axes.plot(
                k,
                table["median_rms_deg"][keep],
                color=COLOURS[i],
                linestyle=STYLES[i],
                marker=MARKERS[i],
                markersize=4,
                label=choice,
            )
        plain_axes(axes)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.xaxis.set_major_locator(FixedLocator([4, 6, 8, 12, 20, 30, 50]))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(ScalarFormatter())
        _plain_log(axes.yaxis)
        axes.set_xlabel("postures measured, K")
        axes.set_title(titles[scenario], fontsize=10)
        axes.legend(fontsize=8, frameon=False)
    panels[0].set_ylabel(
        "error of prediction\n(° rms, median; band: its 95 % interval)"
    )
    figure.suptitle("Number of postures against accuracy", fontsize=10)
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
    figure = Figure(figsize=(10.0, 3.6), layout="constrained")
    panels = figure.subplots(1, 3)
    looks = {
        "random, median draw": (GREY, ":"),
        "policy": (COLOURS[0], "-"),
        "all 50": (COLOURS[2], "--"),
    }
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    circle = np.sqrt(5.991464547) * np.stack([np.cos(turn), np.sin(turn)])
    for axes, pair in zip(panels, ([0, 1], [1, 2], [0, 3]), strict=True):
        axes.plot(
            *estimates[:, pair].T,
            linestyle="none",
            marker=".",
            markersize=2.5,
            color=COLOURS[5],
            label="simulated, policy",
        )
        for label, matrix in covariance.items():
            colour, line = looks[label]
            root = np.linalg.cholesky(matrix[np.ix_(pair, pair)])
            axes.plot(
                *(centre[pair, None] + root @ circle),
                color=colour,
                linestyle=line,
                label=label,
            )
        axes.plot(*centre[pair], marker="+", color=BLACK, markersize=8)
        axes.set_xlabel(names[pair[0]])
        axes.set_ylabel(names[pair[1]])
        axes.locator_params(nbins=5)
        plain_axes(axes)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False
    )
    figure.suptitle(
        "95 % error ellipses of the pitch row of A and b (+: set values)", fontsize=10
    )
    return figure
