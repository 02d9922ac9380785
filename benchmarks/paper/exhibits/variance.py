"""Figures 5 and 9: variance over the episodes of the twelve identified parameters."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.paper.exhibits.exhibit import Exhibit, judge
from benchmarks.paper.exhibits.selection import STREAM, words_of
from benchmarks.paper.exhibits.study import METHODS, Study
from jaxcal.models import Affine
from jaxcal.reports.plots import BLACK, COLOURS, GREY, legend_right, panels

Array = NDArray[np.float64]


def exhibits(study: Study) -> list[Exhibit]:
    """Figures 5 and 9."""
    return [
        _variance(study, "dataset3", "figure_5", "Figure 5"),
        _variance(study, "dataset4", "figure_9", "Figure 9"),
    ]


def variance_table(
    parameters: dict[str, Array], rng: np.random.Generator, resamples: int
) -> dict[str, tuple[Array, Array, Array]]:
    """Variance over episodes of each parameter, with an interval.

    Of several draws per episode: the median variance, between 5 and 95 % of the draws.
    Else the variance and its bootstrap interval, the same episodes for every method.

    Args:
        parameters: (E, R, P) by method, the policy among them.
        rng: of the bootstrap.
        resamples: of it.

    Returns:
        By method: (P,) variance, lower and upper end; and under ``method/policy`` each
        method's variance over the policy's: paired, or, of several draws, between the
        5 % draw over the policy's upper end and the 95 % draw over its lower.
    """
    count = len(parameters["policy"])
    weight = rng.multinomial(count, np.full(count, 1.0 / count), resamples) / count
    out: dict[str, tuple[Array, Array, Array]] = {}
    again = {}  # (resamples, P) of the methods with one draw
    for method, sample in parameters.items():
        value = sample.var(axis=0)  # (R, P)
        if len(value) > 1:
            low, middle, high = np.quantile(value, [0.05, 0.5, 0.95], axis=0)
            out[method] = (middle, low, high)
            continue
        one = sample[:, 0] - sample[:, 0].mean(axis=0)
        again[method] = weight @ one**2 - (weight @ one) ** 2
        low, high = np.quantile(again[method], [0.025, 0.975], axis=0)
        out[method] = (value[0], low, high)
    policy, policy_low, policy_high = out["policy"]
    for method in [m for m in parameters if m != "policy"]:
        value, low, high = out[method]
        if method in again:
            ratio = again[method] / again["policy"]
            low, high = np.quantile(ratio, [0.025, 0.975], axis=0)
        else:
            low, high = low / policy_high, high / policy_low
        out[f"{method}/policy"] = (value / policy, low, high)
    return out


def _variance(study: Study, name: str, key: str, title: str) -> Exhibit:
    settings = study.settings
    parameters = {m: study.parameters(name, m) for m in (*METHODS, "all 50")}
    table = variance_table(
        parameters, settings.rng(STREAM[name], 1), settings.size("resamples")
    )
    names = Affine(3, 3).names
    columns: dict[str, Any] = {"parameter": list(names)}
    for method, (value, low, high) in table.items():
        plain = method.replace(" ", "_").replace("/", "_over_")
        columns |= {plain: value, f"{plain}_low": low, f"{plain}_high": high}
    rows = [
        (label, table[m][0], table[m][1:], {"color": colour, "marker": marker})
        for m, label, colour, marker in (
            ("random", "random", GREY, "x"),
            ("greedy", "greedy", COLOURS[1], "s"),
            ("policy", "PPO", COLOURS[0], "o"),
            ("default", "default, by imitation", COLOURS[3], "D"),
            ("exact", "exact", BLACK, "*"),
            ("all 50", "all 50 postures", COLOURS[2], "^"),
        )
    ]
    figure = _drawn(rows, names, "A: no unit, b: deg²")
    text = f"Cross-episode variance of the identified parameters: {name}"
    figure.axes[0].set_title(text, fontsize=10)
    (ratio, low, _), fifty = table["random/policy"], table["all 50/policy"]
    lower = int((low > 1.0).sum())
    words: dict[str, float] = {
        "middle": np.median(ratio), "least": ratio.min(), "most": ratio.max(),
        "lower": lower, "fifty": np.median(fifty[0]),
        "imitated": np.median(table["default/policy"][0]),
    }  # fmt: skip
    return Exhibit.from_texts(
        "variance",
        words_of(study, name, title) | words,
        key=key,
        verdict=judge(lower and (fifty[1] > 1.0).all(), lower),
        figures={f"{key}_parameter_variance": figure},
        data={
            "variance": columns,
            "parameters": _parameter_columns(parameters, names),
        },
        numbers={
            method: dict(zip(("value", "low", "high"), values, strict=True))
            for method, values in table.items()
        },
    )


def _parameter_columns(
    parameters: dict[str, Array], names: tuple[str, ...]
) -> dict[str, Any]:
    """Every identified parameter, a row per episode and draw of each method."""
    places = [
        (method, episode + 1, draw + 1)
        for method, sample in parameters.items()
        for episode, draw in np.ndindex(sample.shape[:2])
    ]
    values = np.concatenate([p.reshape(-1, len(names)) for p in parameters.values()])
    heads = zip(("method", "episode", "draw"), zip(*places, strict=True), strict=True)
    return dict(heads) | dict(zip(names, values.T, strict=True))


def _drawn(
    rows: Sequence[tuple[str, Array, tuple[Array, Array], dict[str, Any]]],
    names: Sequence[str],
    unit: str,
) -> Figure:
    """Variance of each parameter; ``rows``: label, (P,) variances, lower and upper
    ends of their 95 % intervals, colour and marker."""
    figure, axes = panels((8.0, 4.0))
    look = {"linestyle": "none", "markersize": 4.5, "elinewidth": 0.9}
    offsets = np.linspace(-0.3, 0.3, len(rows))
    for (label, variance, (low, high), style), offset in zip(
        rows, offsets, strict=True
    ):
        x = np.arange(len(names)) + offset
        # A percentile interval need not hold the estimate.
        error = np.maximum([variance - low, high - variance], 0.0)
        axes.errorbar(x, variance, yerr=error, label=label, **style, **look)
    for edge in np.arange(len(names) - 1) + 0.5:
        axes.axvline(edge, color="#DDDDDD", linewidth=0.6, zorder=0)
    axes.set_yscale("log")
    axes.set_xticks(range(len(names)), names)
    axes.set_xlabel("parameter (bars: 95 % intervals)")
    axes.set_ylabel(f"variance over episodes ({unit})")
    legend_right(axes)
    return figure
