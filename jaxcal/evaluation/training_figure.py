"""The paper's Figure 2: how a training run went, from what the trainer recorded."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import lfilter

from jaxcal.evaluation.csv_rows import read_rows
from jaxcal.plots.style import COLOURS, panels

__all__ = ["last_rewards", "read_metrics", "training_curves"]

Array = NDArray[np.float64]


def training_curves(folder: pathlib.Path | str) -> Figure:
    """The paper's Figure 2 of a training run, from its ``metrics.csv``.

    (a) reward with its moving average and spread; (b) distribution of the reward over
    the last 1,000 episodes (``last_rewards.npy``; without it, of the mean rewards of
    the last updates); (c) smoothed curve, with the share of the optimum reached.

    Raises:
        OSError: there is no metrics.csv in the folder.
        ValueError: it cannot be understood, naming the line or column.
    """
    folder = pathlib.Path(folder)
    metrics = read_metrics(folder / "metrics.csv")
    episodes, reward = metrics["episodes"], metrics["reward_mean"]
    x = episodes / 1000.0
    window = max(1, min(len(reward) // 10, 50))
    span = window * (episodes[-1] - episodes[0]) / max(len(episodes) - 1, 1)
    figure, (left, middle, right) = panels((12.0, 3.6), shape=(1, 3))
    unit = "reward (log det S, scaled)"

    left.plot(x, reward, color=COLOURS[5], linewidth=0.8, label="mean reward")
    if "reward_std" in metrics:
        ends = reward - metrics["reward_std"], reward + metrics["reward_std"]
        look: dict[str, Any] = {"color": COLOURS[5], "alpha": 0.2, "linewidth": 0}
        left.fill_between(x, *ends, label="± 1 s.d. of episodes", **look)
    # The mean of the last ``window`` values, of fewer at the beginning.
    count = np.minimum(np.arange(1, len(reward) + 1), window)
    mean = np.convolve(reward, np.ones(window))[: len(reward)] / count
    label = f"moving average, {span:,.0f} episodes"
    left.plot(x, mean, color=COLOURS[0], label=label)
    left.set_title("(a) reward", fontsize=10)
    left.set_ylabel(unit)
    left.legend(fontsize=8, frameon=False)

    last, what = last_rewards(folder, metrics)
    bins = min(50, max(5, len(last) // 10))
    middle.hist(last, bins=bins, color=COLOURS[0], alpha=0.8)
    label = f"mean {np.mean(last):.3g}, s.d. {np.std(last):.2g}"
    middle.axvline(float(np.mean(last)), color=COLOURS[1], linestyle="--", label=label)
    middle.set_title(f"(b) {what}", fontsize=10)
    middle.set(xlabel=unit, ylabel="count")
    middle.margins(y=0.2)  # room for the legend
    middle.legend(fontsize=8, framealpha=1.0, edgecolor="none")  # over the line

    # An exponential moving average, unbiased at the beginning.
    sums, weights = (
        lfilter([0.05], [1.0, -0.95], column) for column in (reward, np.ones(len(x)))
    )
    lines = right.plot(x, sums / weights, color=COLOURS[0], label="reward, smoothed")
    right.set_title("(c) smoothed curve", fontsize=10)
    right.set_ylabel(unit)
    ratio = metrics.get("ratio_to_exact", np.array([np.nan]))
    known = np.isfinite(ratio)
    if known.any():
        twin = right.twinx()
        label = "det S / det S* (validation, right axis)"
        look = {"color": COLOURS[1], "linestyle": "--", "label": label}
        lines += twin.plot(x[known], ratio[known], **look)
        twin.set(ylabel="mean det S / det S*", ylim=(0.0, 1.02))
    place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.2)}
    names = [line.get_label() for line in lines]  # below: two curves leave no corner
    right.legend(lines, names, fontsize=8, frameon=False, **place)
    for axes in (left, right):
        axes.set_xlabel("training episodes (thousands)")
    return figure


def read_metrics(path: pathlib.Path) -> dict[str, Array]:
    """Columns of a ``metrics.csv``; NaN where a cell is empty.

    Raises:
        OSError: it cannot be read.
        ValueError: it cannot be understood, naming the line or column.
    """
    try:
        header, rows = read_rows(path.read_bytes())
        if not rows:
            raise ValueError("no update is recorded yet")
        for name in ("episodes", "reward_mean"):
            if name not in header:
                raise ValueError(f'column "{name}" is missing')
        values = []
        for line, row in rows:
            try:
                values.append([float(cell) if cell.strip() else np.nan for cell in row])
            except ValueError:
                raise ValueError(f"line {line}: not a number") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return dict(zip(header, np.array(values).T, strict=True))


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
