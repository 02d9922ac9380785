"""Figures of an evaluation, for print: axes, units, legends.

Functions return a matplotlib ``Figure`` and touch no file and no global state.
"""

from __future__ import annotations

import itertools
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator
from numpy.typing import NDArray

from jaxcal.evaluation.parameters import parameter_names
from jaxcal.evaluation.results import Evaluation, MethodResult, log_mean
from jaxcal.plots import BLACK, COLOURS, GREY, MARKERS, STYLES, plain_axes

__all__ = [
    "best_so_far",
    "det_distributions",
    "det_means",
    "det_per_episode",
    "evaluation_figures",
    "gap_to_optimum",
    "parameter_variance",
    "variances",
]

Array = NDArray[np.float64]

_CURVE_POINTS = 600  # draw any step curve
_SHOWN_EPISODES = 200  # more than these points side by side cannot be told apart
_FIXED: dict[str, dict[str, Any]] = {  # the style of random and exact in every figure
    "random": {"color": GREY, "linestyle": ":", "marker": "x"},
    "exact": {"color": BLACK, "linestyle": "-", "marker": "*"},
}


def evaluation_figures(evaluation: Evaluation) -> dict[str, Figure]:
    """Every figure the evaluation holds data for, by file name without suffix."""
    figures = {
        "det_per_episode": det_per_episode(evaluation),
        "det_means": det_means(evaluation),
        "det_distributions": det_distributions(evaluation),
        "gap_to_optimum": gap_to_optimum(evaluation),
        "best_so_far": best_so_far(evaluation),
    }
    if evaluation.dataset.measured is not None:
        figures["parameter_variance"] = parameter_variance(evaluation)
    return figures


def det_per_episode(evaluation: Evaluation) -> Figure:
    """det S in each episode: the main method, the optimum and one random draw."""
    figure, axes = _figure(evaluation, "det S per episode", 3.8)
    total = evaluation.dataset.num_episodes
    shown = min(total, _SHOWN_EPISODES)
    episodes = np.arange(1, shown + 1)

    def draw(log_det: Array, label: str, **look: Any) -> None:
        axes.plot(episodes, _log10(log_det[:shown]), label=label, **look)

    random = evaluation.random_log_det[:, 0]
    draw(random, "random, one draw", ls="none", marker="x", ms=4, color=GREY)
    draw(evaluation.reference, _reference_name(evaluation), lw=0.8, color=BLACK)
    main = _main(evaluation)
    if main is not None:
        look = {"ls": "none", "marker": "o", "ms": 3.5, "color": COLOURS[0]}
        draw(main.log_det[:, 0], _label(evaluation, main), **look)
    part = "" if shown == total else f", first {shown} of {total:,}"
    axes.set_xlabel(f"episode{part}")
    axes.set_ylabel(_det_label(evaluation))
    _powers_of_ten(axes.yaxis)
    _legend(axes)
    return figure


def det_means(evaluation: Evaluation) -> Figure:
    """Mean det S by method with its 95 % interval, and how many times random it is."""
    results = _with_random(evaluation)
    height = 0.9 + 0.42 * len(results)
    figure, axes = _figure(evaluation, "Mean det S by method", height)
    for row, (name, log_det, style) in enumerate(results):
        values = np.exp(log_det - log_det.max()).mean(axis=1)
        mean = values.mean()
        half = 1.96 * values.std() / np.sqrt(len(values))
        ends = np.array([max(mean - half, 0.1 * mean), mean, mean + half])
        low, centre, high = np.log10(ends) + _log10(log_det.max())
        axes.errorbar(
            centre,
            row,
            xerr=[[centre - low], [high - centre]],
            fmt=style["marker"],
            color=style["color"],
            capsize=3,
        )
        if name != "random":
            times = np.exp(log_mean(log_det) - log_mean(evaluation.random_log_det))
            axes.annotate(
                f"{times:,.0f} x random",
                (centre, row),
                xytext=(0, 7),
                textcoords="offset points",
                ha="center",
                fontsize=8,
            )
    axes.set_yticks(range(len(results)), [name for name, _, _ in results])
    axes.set_ylim(len(results) - 0.5, -0.7)
    axes.margins(x=0.12)
    axes.set_xlabel(f"mean {_det_label(evaluation)}, with its 95 % interval")
    _powers_of_ten(axes.xaxis)
    return figure


def det_distributions(evaluation: Evaluation) -> Figure:
    """Distribution of det S over the selections of each method, on a log scale."""
    results = _with_random(evaluation)
    height = 1.1 + 0.42 * len(results)
    figure, axes = _figure(evaluation, "Distribution of det S", height)
    boxes = axes.boxplot(
        [_log10(log_det.ravel()) for _, log_det, _ in results],
        orientation="horizontal",
        whis=(5, 95),
        showfliers=False,
        patch_artist=True,
        widths=0.6,
        medianprops={"color": BLACK},
    )
    for patch, (_, _, style) in zip(boxes["boxes"], results, strict=True):
        patch.set_facecolor(style["color"])
        patch.set_alpha(0.6)
    axes.set_yticks(range(1, len(results) + 1), [name for name, _, _ in results])
    axes.invert_yaxis()
    axes.set_xlabel(
        f"{_det_label(evaluation)}; box: quartiles and median, whiskers: 5 to 95 %"
    )
    _powers_of_ten(axes.xaxis)
    return figure


def gap_to_optimum(evaluation: Evaluation) -> Figure:
    """Share of selections that reach at least each fraction of the optimum."""
    figure, axes = _figure(evaluation, "Gap to the optimum", 4.0)
    for name, log_det, style in _with_random(evaluation):
        behind = np.minimum(log_det - evaluation.reference[:, None], 0.0)
        ratio = np.exp(behind).ravel()
        # Share of selections at or above each value that occurs, ties taken together.
        values, counts = np.unique(ratio.round(9), return_counts=True)
        share = counts[::-1].cumsum()[::-1] / len(ratio)
        keep = np.unique(np.linspace(0, len(values) - 1, _CURVE_POINTS).astype(int))
        axes.step(
            np.append(0.0, values[keep]),
            np.append(1.0, share[keep]),
            where="pre",
            label=f"{name} (mean {ratio.mean():.3g})",
            **_line(style),
        )
    axes.set_xlabel(f"det S / det S* ({_reference_name(evaluation)})")
    axes.set_ylabel("share of selections at least this good")
    axes.set_xlim(0.0, 1.005)
    axes.set_ylim(0.0, 1.02)
    _legend(axes)
    return figure


def best_so_far(evaluation: Evaluation) -> Figure:
    """Largest det S found up to each episode (paper, Figure 4).

    Of several draws an episode the median curve, with a band from 5 to 95 % of them.
    """
    figure, axes = _figure(evaluation, "Best det S so far", 3.8)
    episodes = np.arange(1, evaluation.dataset.num_episodes + 1)
    for name, log_det, style in _with_random(evaluation):
        best = _log10(np.maximum.accumulate(log_det, axis=0))
        low, middle, high = np.quantile(best, [0.05, 0.5, 0.95], axis=1)
        label, draws = name, best.shape[1]
        if draws > 1:
            axes.fill_between(
                episodes, low, high, step="post", color=style["color"], alpha=0.2, lw=0
            )
            label = f"{name}, median and\n5 to 95 % of {draws} draws"
        axes.step(episodes, middle, where="post", label=label, **_line(style))
    axes.set_xlabel("episode")
    axes.set_ylabel(f"best {_det_label(evaluation)} so far")
    _powers_of_ten(axes.yaxis)
    _legend(axes)
    return figure


def parameter_variance(evaluation: Evaluation) -> Figure:
    """Variance over the episodes of each identified parameter (paper, Figure 5).

    Raises:
        ValueError: the dataset holds no measured outputs.
    """
    dataset = evaluation.dataset
    if dataset.measured is None:
        raise ValueError(f"{dataset.name} holds no measured outputs")
    rows = []
    styles = _styles(evaluation)
    for result, style in zip(evaluation.results, styles, strict=True):
        label = "random, median over draws" if result.method == "random" else None
        variance = evaluation.parameter_variance(result)
        rows.append((label or _label(evaluation, result), variance, None, style))
    unit = "unit of measured and commands, squared"
    if dataset.ranges is not None:
        unit = "A: no unit, b: deg²"
    names = parameter_names(dataset.num_inputs, dataset.num_outputs)
    figure = variances(rows, names, unit)
    title = "Cross-episode variance of the identified parameters"
    _title(figure.axes[0], evaluation, title)
    return figure


def variances(
    rows: Sequence[tuple[str, Array, tuple[Array, Array] | None, dict[str, Any]]],
    names: Sequence[str],
    unit: str,
) -> Figure:
    """Variance of each parameter, a marker for each way of choosing.

    Args:
        rows: label, (P,) variances, lower and upper ends of their intervals, style.
        names: of the P parameters.
        unit: in words.
    """
    figure, axes = _axes(4.0)
    offsets = np.linspace(-0.3, 0.3, len(rows)) if len(rows) > 1 else [0.0]
    for (label, variance, ends, style), offset in zip(rows, offsets, strict=True):
        error = None
        if ends is not None:
            # A percentile interval need not hold the estimate.
            error = np.maximum([variance - ends[0], ends[1] - variance], 0.0)
        axes.errorbar(
            np.arange(len(names)) + offset,
            variance,
            yerr=error,
            linestyle="none",
            marker=style["marker"],
            markersize=4.5,
            elinewidth=0.9,
            color=style["color"],
            label=label,
        )
    for edge in np.arange(len(names) - 1) + 0.5:
        axes.axvline(edge, color="#DDDDDD", linewidth=0.6, zorder=0)
    axes.set_yscale("log")
    axes.set_xticks(range(len(names)), names)
    bars = any(ends is not None for _, _, ends, _ in rows)
    axes.set_xlabel("parameter" + (" (bars: 95 % intervals)" if bars else ""))
    axes.set_ylabel(f"variance over episodes ({unit})")
    _legend(axes)
    return figure


def _figure(evaluation: Evaluation, title: str, height: float) -> tuple[Figure, Any]:
    """A titled figure of one panel, and its axes; height in inches."""
    figure, axes = _axes(height)
    _title(axes, evaluation, title)
    return figure, axes


def _axes(height: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(8.0, height), layout="constrained")
    axes = figure.subplots()
    plain_axes(axes)
    return figure, axes


def _legend(axes: Any) -> None:
    axes.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _title(axes: Any, evaluation: Evaluation, what: str) -> None:
    dataset = evaluation.dataset
    axes.set_title(
        f"{what}: {dataset.name}, {evaluation.k} of {dataset.num_candidates}",
        fontsize=10,
    )


def _det_label(evaluation: Evaluation) -> str:
    normalised = evaluation.dataset.ranges is not None
    return f"det S (commands {'in [0, 1]' if normalised else 'as in the file'})"


def _reference_name(evaluation: Evaluation) -> str:
    return "proven optimum" if evaluation.proven.all() else "optimum or its upper bound"


def _label(evaluation: Evaluation, result: MethodResult) -> str:
    """The method in words, with its checkpoint where there are several."""
    policies = {r.checkpoint for r in evaluation.results if r.is_policy}
    if not result.is_policy or len(policies) < 2:
        return result.label
    name = "default" if result.checkpoint is None else result.checkpoint
    return f"{result.label}, {pathlib.Path(name).name}"


def _main(evaluation: Evaluation) -> MethodResult | None:
    """The first policy, else the first method that is neither random nor exact."""
    others = [r for r in evaluation.results if r.method not in ("random", "exact")]
    return next((r for r in others if r.is_policy), others[0] if others else None)


def _styles(evaluation: Evaluation) -> list[dict[str, Any]]:
    """Colour, line and marker of each; random and exact look the same everywhere."""
    looks = zip(*map(itertools.cycle, (COLOURS, STYLES, MARKERS)), strict=False)
    return [
        _FIXED.get(result.method)
        or dict(zip(("color", "linestyle", "marker"), next(looks), strict=True))
        for result in evaluation.results
    ]


def _line(style: dict[str, Any]) -> dict[str, Any]:
    """A curve; the optimum broad and pale, for others may lie on it."""
    line = {key: style[key] for key in ("color", "linestyle")}
    if style["color"] == BLACK:
        line |= {"linewidth": 4.0, "alpha": 0.3, "zorder": 1}
    return line


def _with_random(evaluation: Evaluation) -> list[tuple[str, Array, dict[str, Any]]]:
    """Name, (E, R) log det S and style of every method; random also when not asked."""
    results = evaluation.results
    rows = [
        (_label(evaluation, result), result.log_det, style)
        for result, style in zip(results, _styles(evaluation), strict=True)
    ]
    if all(result.method != "random" for result in results):
        rows.append(("random", evaluation.random_log_det, _FIXED["random"]))
    return rows


def _log10(log_values: Any) -> Any:
    return log_values / np.log(10.0)


def _powers_of_ten(axis: Any) -> None:
    """Label an axis that holds log10 values with the values themselves.

    The logs are drawn rather than a log axis, because det S of many axes in encoder
    pulses can exceed the largest float.
    """
    axis.set_major_locator(MaxNLocator(nbins=8, integer=True))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"$10^{{{x:g}}}$"))
