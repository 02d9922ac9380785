"""Figures of an evaluation and of a training, for print: axes, units, legends."""

from __future__ import annotations

import itertools
import pathlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.signal import lfilter

from jaxcal.checks import Array
from jaxcal.evaluation.methods import PostureEvaluation, PostureResult, log_mean
from jaxcal.reports.plots import (
    BLACK,
    COLOURS,
    GREY,
    legend_right,
    numbered,
    panels,
)
from jaxcal.tables import read_table

if TYPE_CHECKING:
    from jaxcal.evaluation.report import MethodResult

_CURVE_POINTS = 600  # draw any step curve
_FIXED: dict[str, dict[str, Any]] = {  # the style of random and exact in every figure
    "random": {"color": GREY, "linestyle": ":", "marker": "x"},
    "exact": {"color": BLACK, "linestyle": "-", "marker": "*"},
}


def evaluation_figures(evaluation: PostureEvaluation) -> dict[str, Figure]:
    """Every figure the evaluation holds data for, by file name without suffix."""
    return {draw.__name__: draw(evaluation) for draw in (det_means, gap_to_optimum)}


def det_means(evaluation: PostureEvaluation) -> Figure:
    """Mean det S by method with its 95 % interval, and how many times random it is."""
    results = with_random(evaluation)
    height = 0.9 + 0.42 * len(results)
    figure, axes = titled(evaluation, "Mean det S by method", height)
    ends = []
    for row, (name, log_det, _) in enumerate(results):
        values = np.exp(log_det - log_det.max()).mean(axis=1)
        mean, half = values.mean(), 1.96 * values.std() / np.sqrt(len(values))
        interval = np.array([max(mean - half, 0.1 * mean), mean, mean + half])
        ends.append(np.log10(interval) + log_det.max() / np.log(10.0))
        if name != "random":
            times = np.exp(log_mean(log_det) - log_mean(evaluation.random_log_det))
            place = {"xytext": (0, 7), "textcoords": "offset points", "ha": "center"}
            text = f"{times:,.0f} x random"
            axes.annotate(text, (ends[-1][1], row), fontsize=8, **place)
    names, _, styles = zip(*results, strict=True)
    intervals(axes, names, ends, styles)
    axes.margins(x=0.12)
    name_det_axis(axes.xaxis, evaluation, "mean {}, with 95 % interval")
    return figure


def intervals(
    axes: Any,
    names: Sequence[str],
    ends: Sequence[Array],
    styles: Sequence[dict[str, Any]],
) -> None:
    """A marker in its interval for each name; ``ends``: (3,) lower, centre, upper."""
    for row, ((low, centre, high), style) in enumerate(zip(ends, styles, strict=True)):
        error, look = [[centre - low], [high - centre]], style["marker"]
        axes.errorbar(
            centre, row, xerr=error, fmt=look, color=style["color"], capsize=3
        )
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.7)


def gap_to_optimum(evaluation: PostureEvaluation) -> Figure:
    """Share of selections that reach at least each fraction of the optimum."""
    figure, axes = titled(evaluation, "Gap to the optimum", 4.0)
    for name, log_det, style in with_random(evaluation):
        behind = np.minimum(log_det - evaluation.reference[:, None], 0.0)
        ratio = np.exp(behind).ravel()
        # Share of selections at or above each value that occurs, ties taken together.
        values, counts = np.unique(ratio.round(9), return_counts=True)
        share = counts[::-1].cumsum()[::-1] / len(ratio)
        keep = np.unique(np.linspace(0, len(values) - 1, _CURVE_POINTS).astype(int))
        x, y = np.append(0.0, values[keep]), np.append(1.0, share[keep])
        label = f"{name} (mean {ratio.mean():.3g})"
        axes.step(x, y, where="pre", label=label, **curve_of(style))
    axes.set_xlabel(f"det S / det S* ({reference_name(evaluation)})")
    axes.set_ylabel("share of selections at least this good")
    axes.set(xlim=(0.0, 1.005), ylim=(0.0, 1.02))
    legend_right(axes)
    return figure


def titled(
    evaluation: PostureEvaluation, title: str, height: float
) -> tuple[Figure, Any]:
    """A titled figure of one panel, and its axes; height in inches."""
    figure, axes = panels((8.0, height))
    dataset, k = evaluation.dataset, evaluation.k
    whole = f"{title}: {dataset.name}, {k} of {dataset.num_candidates}"
    axes.set_title(whole, fontsize=10)
    return figure, axes


def name_det_axis(axis: Any, evaluation: PostureEvaluation, text: str = "{}") -> None:
    """Name an axis that holds log10 det S, which can exceed the largest float, and
    label it with powers of ten."""
    unit = "as in the file" if evaluation.dataset.ranges is None else "in [0, 1]"
    axis.set_label_text(text.format(f"det S (commands {unit})"))
    axis.set_major_locator(MaxNLocator(nbins=8, integer=True))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"$10^{{{x:g}}}$"))


def reference_name(evaluation: PostureEvaluation) -> str:
    return "proven optimum" if evaluation.proven.all() else "optimum or its upper bound"


def label_of(evaluation: PostureEvaluation, result: PostureResult) -> str:
    """The method in words, with its checkpoint where there are several."""
    policies = {r.checkpoint for r in evaluation.results if r.is_policy}
    if not result.is_policy or len(policies) < 2:
        return result.label
    name = "default" if result.checkpoint is None else result.checkpoint
    return f"{result.label}, {pathlib.Path(name).name}"


def styles_of(results: Sequence[MethodResult]) -> list[dict[str, Any]]:
    """Colour, line and marker of each; random and exact look the same everywhere."""
    number = itertools.count()
    return [_FIXED.get(result.method) or numbered(next(number)) for result in results]


def curve_of(style: dict[str, Any]) -> dict[str, Any]:
    """A curve; the optimum broad and pale, for others may lie on it."""
    line = {key: style[key] for key in ("color", "linestyle")}
    if style["color"] == BLACK:
        line |= {"linewidth": 4.0, "alpha": 0.3, "zorder": 1}
    return line


def with_random(
    evaluation: PostureEvaluation,
) -> list[tuple[str, Array, dict[str, Any]]]:
    """Name, (E, R) log det S and style of every method; random also when not asked."""
    results = evaluation.results
    rows = [
        (label_of(evaluation, result), result.log_det, style)
        for result, style in zip(results, styles_of(results), strict=True)
    ]
    if all(result.method != "random" for result in results):
        rows.append(("random", evaluation.random_log_det, _FIXED["random"]))
    return rows


# -- of a training ---------------------------------------------------------------------


def training_curves(runs: Mapping[str, pathlib.Path]) -> Figure:
    """Reward of training runs by name, its moving average, and where it was validated
    the share of the optimum reached."""
    figure, axes = panels((8.0, 3.8))
    twin = None
    for number, (name, folder) in enumerate(runs.items()):
        metrics, colour = read_metrics(folder / "metrics.csv"), COLOURS[number % 6]
        x, reward = metrics["episodes"] / 1000.0, metrics["reward_mean"]
        axes.plot(x, reward, color=colour, linewidth=0.8, alpha=0.3)
        axes.plot(x, smoothed(reward), color=colour, label=name)
        twin = share_of_optimum(axes, twin, metrics, colour)
    unit = "reward (log det S, scaled)"
    axes.set(xlabel="training episodes (thousands)", ylabel=unit)
    place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.2)}
    axes.legend(fontsize=8, frameon=False, ncols=3, **place)
    return figure


def share_of_optimum(
    axes: Axes, twin: Axes | None, metrics: Mapping[str, Array], colour: str
) -> Axes | None:
    """Draw a run's share of the optimum, dashed, on ``twin``, or on an axis beside that
    of ``axes``; the axis that it is on, ``twin`` where the run was not validated."""
    x = metrics["episodes"] / 1000.0
    finite = np.isfinite(ratio := metrics.get("ratio_to_exact", np.nan * x))
    if finite.any():
        twin = axes.twinx() if twin is None else twin
        twin.plot(x[finite], ratio[finite], color=colour, linestyle="--")
        twin.set(ylabel="dashed: mean det S / det S*", ylim=(0.0, 1.02))
    return twin


def smoothed(values: Array) -> Array:
    """An exponential moving average, unbiased at the beginning."""
    columns = np.stack([values, np.ones(len(values))])
    sums, weights = lfilter([0.05], [1.0, -0.95], columns)
    return np.asarray(sums / weights)


def read_metrics(path: pathlib.Path) -> dict[str, Array]:
    """Columns of a ``metrics.csv``; NaN where a cell is empty."""
    table = read_table(str(path))
    for name in ("episodes", "reward_mean", *table.labels):
        if name not in table.names:
            table.columns([name])  # says that it is missing, or no number
    return dict(zip(table.names, table.values.T, strict=True))
