"""Training curves with a band over seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jaxcal.plots import BLACK, COLOURS, GREY, plain_axes

__all__ = ["curves_over_seeds"]

Array = NDArray[np.float64]


def curves_over_seeds(
    runs: Sequence[Any],
    columns: Mapping[str, Any],
    rewards: Mapping[str, Array],
    paper: Any = None,
) -> Figure:
    """Reward with its band, last rewards by seed, and the share of the optimum.

    Args:
        runs: kept runs, one a seed.
        columns: ``episodes``, ``reward_mean``, ``reward_low``, ``reward_high``.
        rewards: of the last episodes, by run.
        paper: the run of the paper's network, if any.
    """
    figure = Figure(figsize=(12.0, 3.8), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    for i, run in enumerate(runs):
        left.plot(
            run.metrics["episodes"] / 1e3,
            run.metrics["reward_mean"],
            color=GREY,
            linewidth=0.6,
            alpha=0.7,
            label="one seed" if i == 0 else None,
        )
    thousands = np.asarray(columns["episodes"]) / 1e3
    left.fill_between(
        thousands,
        columns["reward_low"],
        columns["reward_high"],
        color=COLOURS[0],
        alpha=0.3,
        linewidth=0,
        label="95 % of the mean",
    )
    left.plot(thousands, columns["reward_mean"], color=COLOURS[0], label="mean")
    left.set_title(f"(a) reward, {len(runs)} seeds", fontsize=10)
    left.set_ylabel("reward (log det S / 10)")

    boxes = middle.boxplot(
        list(rewards.values()),
        whis=(5, 95),
        showfliers=False,
        patch_artist=True,
        widths=0.6,
        medianprops={"color": BLACK},
    )
    for patch, name in zip(boxes["boxes"], rewards, strict=True):
        patch.set_facecolor(COLOURS[0] if name.startswith("seed") else COLOURS[1])
        patch.set_alpha(0.6)
    middle.set_xticks(
        range(1, len(rewards) + 1),
        [
            name.replace("seed ", "").replace("paper's network", "paper")
            for name in rewards
        ],
    )
    middle.set_xlabel("seed; box: quartiles, whiskers: 5 to 95 %")
    middle.set_ylabel("reward (log det S / 10)")
    middle.set_title("(b) reward, last 1,000 episodes", fontsize=10)

    for i, run in enumerate(runs):
        _ratio(right, run, GREY, "compact, one seed" if i == 0 else None)
    if paper is not None:
        _ratio(right, paper, COLOURS[1], "paper's network")
    right.set_ylim(0.0, 1.02)
    right.set_title("(c) share of the optimum, validation", fontsize=10)
    right.set_ylabel("mean det S / det S*")
    for axes in (left, right):
        axes.set_xlabel("training episodes (thousands)")
        axes.legend(fontsize=8, frameon=False, loc="lower right")
    for axes in (left, middle, right):
        plain_axes(axes)
    figure.suptitle("Training of the compact preset", fontsize=10)
    return figure


def _ratio(axes: Any, run: Any, colour: str, label: str | None) -> None:
    ratio = run.metrics.get("ratio_to_exact")
    if ratio is None:
        return
    known = np.isfinite(ratio)
    axes.plot(
        run.metrics["episodes"][known] / 1e3,
        ratio[known],
        color=colour,
        linewidth=1.0 if colour == GREY else 1.6,
        linestyle="-" if colour == GREY else "--",
        label=label,
    )
