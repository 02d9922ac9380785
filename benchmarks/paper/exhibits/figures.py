"""The paper's figures of det S over the episodes and of a training, besides those of
an evaluation."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jaxcal.evaluation.figures import (
    curve_of,
    label_of,
    name_det_axis,
    read_metrics,
    reference_name,
    share_of_optimum,
    smoothed,
    titled,
    with_random,
)
from jaxcal.evaluation.methods import PostureEvaluation
from jaxcal.reports.plots import BLACK, COLOURS, GREY, boxes, legend_right, panels

Array = NDArray[np.float64]

SHOWN_EPISODES = 200  # more than these points side by side cannot be told apart


def det_per_episode(evaluation: PostureEvaluation) -> Figure:
    """det S in each episode: the main method, the optimum and one random draw."""
    figure, axes = titled(evaluation, "det S per episode", 3.8)
    total = evaluation.dataset.num_episodes
    shown = min(total, SHOWN_EPISODES)

    def draw(log_det: Array, label: str, **look: Any) -> None:
        x = np.arange(1, shown + 1)
        axes.plot(x, log_det[:shown] / np.log(10.0), label=label, **look)

    random = evaluation.random_log_det[:, 0]
    draw(random, "random, one draw", ls="none", marker="x", ms=4, color=GREY)
    draw(evaluation.reference, reference_name(evaluation), lw=0.8, color=BLACK)
    # The first policy, else the first method that is neither random nor exact.
    others = [r for r in evaluation.results if r.method not in ("random", "exact")]
    if others:
        main = next((r for r in others if r.is_policy), others[0])
        look = {"ls": "none", "marker": "o", "ms": 3.5, "color": COLOURS[0]}
        draw(main.log_det[:, 0], label_of(evaluation, main), **look)
    part = "" if shown == total else f", first {shown} of {total:,}"
    axes.set_xlabel(f"episode{part}")
    name_det_axis(axes.yaxis, evaluation)
    legend_right(axes)
    return figure


def det_distributions(evaluation: PostureEvaluation) -> Figure:
    """Distribution of det S over the selections of each method, on a log scale."""
    names, log_dets, styles = zip(*with_random(evaluation), strict=True)
    height = 1.1 + 0.42 * len(names)
    figure, axes = titled(evaluation, "Distribution of det S", height)
    samples = [log_det.ravel() / np.log(10.0) for log_det in log_dets]
    colours = [style["color"] for style in styles]
    boxes(axes, samples, colours, (5, 95), orientation="horizontal")
    axes.set_yticks(range(1, len(names) + 1), names)
    axes.invert_yaxis()
    text = "{}; box: quartiles and median, whiskers: 5 to 95 %"
    name_det_axis(axes.xaxis, evaluation, text)
    return figure


def best_so_far(evaluation: PostureEvaluation) -> Figure:
    """Largest det S found up to each episode (paper, Figure 4); of several draws the
    median curve, with a band from 5 to 95 % of them."""
    figure, axes = titled(evaluation, "Best det S so far", 3.8)
    x = np.arange(1, evaluation.dataset.num_episodes + 1)
    for name, log_det, style in with_random(evaluation):
        best = np.maximum.accumulate(log_det, axis=0) / np.log(10.0)
        low, middle, high = np.quantile(best, [0.05, 0.5, 0.95], axis=1)
        label, draws = name, best.shape[1]
        if draws > 1:
            look = {"color": style["color"], "alpha": 0.2, "lw": 0}
            axes.fill_between(x, low, high, step="post", **look)
            label = f"{name}, median and\n5 to 95 % of {draws} draws"
        axes.step(x, middle, where="post", label=label, **curve_of(style))
    axes.set_xlabel("episode")
    name_det_axis(axes.yaxis, evaluation, "best {} so far")
    legend_right(axes)
    return figure


# -- of a training ---------------------------------------------------------------------


def training_panels(runs: Mapping[str, pathlib.Path]) -> Figure:
    """The paper's Figure 2 of training runs by name: (a) reward with its moving
    average; (b) distribution of the reward over the last 1,000 episodes, else of the
    means of the last updates; (c) smoothed curve, with the share of the optimum
    reached."""
    figure, (curve, spread, smooth) = panels((12.0, 3.8), shape=(1, 3))
    twin, label, what = None, {"label": "moving average"}, ""
    for number, (name, folder) in enumerate(runs.items()):
        metrics, colour = read_metrics(folder / "metrics.csv"), COLOURS[number % 6]
        x, reward = metrics["episodes"] / 1000.0, metrics["reward_mean"]
        curve.plot(x, reward, color=colour, linewidth=0.8, alpha=0.5)
        if "reward_std" in metrics and len(runs) == 1:
            ends = reward - metrics["reward_std"], reward + metrics["reward_std"]
            look: dict[str, Any] = {"color": COLOURS[5], "alpha": 0.2, "linewidth": 0}
            curve.fill_between(x, *ends, label="± 1 s.d. of episodes", **look)
        # The mean of the last ``window`` values, of fewer at the beginning.
        window = max(1, min(len(reward) // 10, 50))
        count = np.minimum(np.arange(1, len(reward) + 1), window)
        mean = np.convolve(reward, np.ones(window))[: len(reward)] / count
        curve.plot(x, mean, color=colour, **label)
        label = {}
        last, what = last_rewards(folder, metrics)
        text = f"{name}: {np.mean(last):.3g} ± {np.std(last):.2g}"
        bars = {"histtype": "step", "density": True, "color": colour, "label": text}
        spread.hist(last, bins=min(50, max(5, len(last) // 10)), **bars)
        smooth.plot(x, smoothed(reward), color=colour, label=name)
        twin = share_of_optimum(smooth, twin, metrics, colour)
    unit = "reward (log det S, scaled)"
    for axes, title in ((curve, "(a) reward"), (smooth, "(c) smoothed curve")):
        axes.set_title(title, fontsize=10)
        axes.set(xlabel="training episodes (thousands)", ylabel=unit)
    spread.set_title(f"(b) {what}", fontsize=10)
    spread.set(xlabel=unit, ylabel="density")
    curve.legend(fontsize=8, frameon=False)
    spread.margins(y=0.1 + 0.08 * len(runs))  # room for the legend
    spread.legend(fontsize=7, framealpha=1.0, edgecolor="none")  # over the lines
    place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.2)}
    smooth.legend(fontsize=8, frameon=False, ncols=3, **place)
    return figure


def last_rewards(folder: pathlib.Path, metrics: dict[str, Array]) -> tuple[Array, str]:
    path = folder / "last_rewards.npy"
    if path.exists():
        try:
            rewards = np.load(path, allow_pickle=False).astype(np.float64).ravel()
        except (ValueError, EOFError, TypeError):
            raise ValueError(f"{path}: not an array of numbers") from None
        rewards = rewards[np.isfinite(rewards)]
        if rewards.size:
            return rewards[-1000:], f"reward, last {min(len(rewards), 1000):,} episodes"
    means = metrics["reward_mean"][-100:]
    return means[np.isfinite(means)], f"mean reward, last {len(means)} updates"
