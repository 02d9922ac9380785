"""The paper's Figure 2: how a training run went, from what the trainer recorded."""

from __future__ import annotations

import csv
import pathlib

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import lfilter

from jaxcal.plots import COLOURS, plain_axes

__all__ = ["last_rewards", "read_metrics", "training_curves"]

Array = NDArray[np.float64]

_BINS = 50


def training_curves(folder: pathlib.Path | str) -> Figure:
    """The paper's Figure 2 of a training run, from its ``metrics.csv``.

    (a) reward with its moving average and spread; (b) distribution of the reward over
    the last 1,000 episodes (``last_rewards.npy``; without it, of the mean rewards of
    the last updates); (c) smoothed curve, with the share of the optimum reached.

    Args:
        folder: of a run.

    Raises:
        OSError: there is no metrics.csv.
        ValueError: it cannot be understood, naming the line or column.
    """
    folder = pathlib.Path(folder)
    metrics = read_metrics(folder / "metrics.csv")
    episodes, reward = metrics["episodes"], metrics["reward_mean"]
    thousands = episodes / 1000.0
    window = max(1, min(len(reward) // 10, 50))
    span = window * (episodes[-1] - episodes[0]) / max(len(episodes) - 1, 1)
    figure = Figure(figsize=(12.0, 3.6), layout="constrained")
    left, middle, right = figure.subplots(1, 3)

    left.plot(thousands, reward, color=COLOURS[5], linewidth=0.8, label="mean reward")
    if "reward_std" in metrics:
        spread = metrics["reward_std"]
        left.fill_between(
            thousands,
            reward - spread,
            reward + spread,
            color=COLOURS[5],
            alpha=0.2,
            linewidth=0,
            label="± 1 s.d. of episodes",
        )
    left.plot(
        thousands,
        _moving_average(reward, window),
        color=COLOURS[0],
        label=f"moving average, {span:,.0f} episodes",
    )
    left.set_title("(a) reward", fontsize=10)
    left.set_ylabel("reward (log det S, scaled)")
    left.legend(fontsize=8, frameon=False)

    last, what = last_rewards(folder, metrics)
    middle.hist(
        last, bins=min(_BINS, max(5, len(last) // 10)), color=COLOURS[0], alpha=0.8
    )
    middle.axvline(
        float(np.mean(last)),
        color=COLOURS[1],
        linestyle="--",
        label=f"mean {np.mean(last):.3g}, s.d. {np.std(last):.2g}",
    )
    middle.set_title(f"(b) {what}", fontsize=10)
    middle.set_xlabel("reward (log det S, scaled)")
    middle.set_ylabel("count")
    middle.margins(y=0.2)  # room for the legend
    middle.legend(fontsize=8, framealpha=1.0, edgecolor="none")  # over the line

    lines = right.plot(
        thousands, _exponential(reward), color=COLOURS[0], label="reward, smoothed"
    )
    right.set_title("(c) smoothed curve", fontsize=10)
    right.set_ylabel("reward (log det S, scaled)")
    ratio = metrics.get("ratio_to_exact")
    known = None if ratio is None else np.isfinite(ratio)
    if ratio is not None and known is not None and known.any():
        twin = right.twinx()
        lines += twin.plot(
            thousands[known],
            ratio[known],
            color=COLOURS[1],
            linestyle="--",
            label="det S / det S* (validation, right axis)",
        )
        twin.set_ylabel("mean det S / det S*")
        twin.set_ylim(0.0, 1.02)
    right.legend(
        lines,
        [line.get_label() for line in lines],
        fontsize=8,
        frameon=False,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.2),  # below: two curves leave no corner free
    )
    for axes in (left, right):
        axes.set_xlabel("training episodes (thousands)")
    for axes in (left, middle, right):
        plain_axes(axes)
    return figure


def read_metrics(path: pathlib.Path) -> dict[str, Array]:
    """Columns of a ``metrics.csv``; NaN where a cell is empty.

    Raises:
        OSError: it cannot be read.
        ValueError: it cannot be understood, naming the line or column.
    """
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    if len(rows) < 2:
        raise ValueError(f"{path}: no update is recorded yet")
    header = rows[0]
    for name in ("episodes", "reward_mean"):
        if name not in header:
            raise ValueError(f'{path}: column "{name}" is missing')
    values = []
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(header):
            raise ValueError(
                f"{path}: line {number}: {len(row)} cells, {len(header)} in the header"
            )
        try:
            values.append([float(cell) if cell.strip() else np.nan for cell in row])
        except ValueError:
            raise ValueError(f"{path}: line {number}: not a number") from None
    table = np.array(values)
    return {name: table[:, i] for i, name in enumerate(header)}


def last_rewards(folder: pathlib.Path, metrics: dict[str, Array]) -> tuple[Array, str]:
    """Rewards to draw as a histogram, and what they are."""
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


def _moving_average(values: Array, window: int) -> Array:
    """Mean of the last ``window`` values, of fewer at the beginning."""
    count = len(values)
    sums = np.convolve(values, np.ones(window))[:count]
    return sums / np.minimum(np.arange(1, count + 1), window)


def _exponential(values: Array, keep: float = 0.95) -> Array:
    """Exponential moving average, unbiased at the beginning."""
    sums, weights = (
        lfilter([1.0 - keep], [1.0, -keep], column)
        for column in (values, np.ones(len(values)))
    )
    return sums / weights
