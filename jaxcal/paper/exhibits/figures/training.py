"""Training curves with a band over seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from jaxcal.paper.exhibits.figures.parts import band, boxes, panels
from jaxcal.plots import COLOURS, GREY

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
    figure, (left, middle, right) = panels(
        (12.0, 3.8), "Training of the compact preset", 1, 3
    )
    for i, run in enumerate(runs):
        left.plot(
            run.metrics["episodes"] / 1e3,
            run.metrics["reward_mean"],
            color=GREY,
            linewidth=0.6,
            alpha=0.7,
            label="one seed" if i == 0 else None,
        )
    band(
        left,
        np.asarray(columns["episodes"]) / 1e3,
        columns["reward_mean"],
        columns["reward_low"],
        columns["reward_high"],
        color=COLOURS[0],
        label="mean; band: its 95 % interval",
    )
    left.set_title(f"(a) reward, {len(runs)} seeds", fontsize=10)

    colours = [COLOURS[0 if name.startswith("seed") else 1] for name in rewards]
    boxes(middle, list(rewards.values()), colours, (5, 95))
    short = [n.removeprefix("seed ").removesuffix("'s network") for n in rewards]
    middle.set_xticks(range(1, len(rewards) + 1), short)
    middle.set_xlabel("seed; box: quartiles, whiskers: 5 to 95 %")
    middle.set_title("(b) reward, last 1,000 episodes", fontsize=10)

    for i, run in enumerate(runs):
        _ratio(right, run, GREY, "compact, one seed" if i == 0 else None)
    if paper is not None:
        _ratio(right, paper, COLOURS[1], "paper's network")
    right.set_ylim(0.0, 1.02)
    right.set_title("(c) share of the optimum, validation", fontsize=10)
    right.set_ylabel("mean det S / det S*")
    for axes in (left, middle):
        axes.set_ylabel("reward (log det S / 10)")
    for axes in (left, right):
        axes.set_xlabel("training episodes (thousands)")
        axes.legend(fontsize=8, frameon=False, loc="lower right")
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
