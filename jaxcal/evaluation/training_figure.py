"""The paper's Figure 2: how training went, from what the trainer recorded."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.signal import lfilter

from jaxcal.checks import Array
from jaxcal.reports.plots.style import COLOURS, panels
from jaxcal.tables import read_table


def training_curves(runs: Mapping[str, pathlib.Path]) -> Figure:
    """The paper's Figure 2 of training runs by name, from their ``metrics.csv``.

    (a) reward with its moving average, and of a single run its spread; (b) distribution
    of the reward over the last 1,000 episodes (``last_rewards.npy``; without it, of the
    mean rewards of the last updates); (c) smoothed curve, with the share of the optimum
    reached.
    """
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
        bins = min(50, max(5, len(last) // 10))
        spread.hist(
            last, bins=bins, color=colour, histtype="step", density=True, label=text
        )
        # An exponential moving average, unbiased at the beginning.
        sums, weights = (
            lfilter([0.05], [1.0, -0.95], column)
            for column in (reward, np.ones(len(x)))
        )
        smooth.plot(x, sums / weights, color=colour, label=name)
        finite = np.isfinite(ratio := metrics.get("ratio_to_exact", np.nan * x))
        if finite.any():
            twin = smooth.twinx() if twin is None else twin
            twin.plot(x[finite], ratio[finite], color=colour, linestyle="--")
            twin.set(ylabel="dashed: mean det S / det S*", ylim=(0.0, 1.02))
    curve.set_title("(a) reward", fontsize=10)
    spread.set_title(f"(b) {what}", fontsize=10)
    smooth.set_title("(c) smoothed curve", fontsize=10)
    unit = "reward (log det S, scaled)"
    curve.set(xlabel="training episodes (thousands)", ylabel=unit)
    spread.set(xlabel=unit, ylabel="density")
    smooth.set(xlabel="training episodes (thousands)", ylabel=unit)
    curve.legend(fontsize=8, frameon=False)
    spread.margins(y=0.1 + 0.08 * len(runs))  # room for the legend
    spread.legend(fontsize=7, framealpha=1.0, edgecolor="none")  # over the lines
    place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.2)}
    smooth.legend(fontsize=8, frameon=False, ncols=3, **place)
    return figure


def read_metrics(path: pathlib.Path) -> dict[str, Array]:
    """Columns of a ``metrics.csv``; NaN where a cell is empty."""
    table = read_table(str(path))
    for name in ("episodes", "reward_mean", *table.labels):
        if name not in table.names:
            table.columns([name])  # says that it is missing, or no number
    return dict(zip(table.names, table.values.T, strict=True))


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
