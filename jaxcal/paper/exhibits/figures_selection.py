"""The gap to the optimum, episode by episode."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxcal.plots import BLACK, COLOURS, plain_axes

__all__ = ["gap_per_episode"]

_SHOWN = 200


def gap_per_episode(columns: dict[str, Any], name: str) -> Figure:
    """det S / det S* of policy and greedy in each episode.

    Args:
        columns: ``episode``, ``ratio_policy`` and ``ratio_greedy``, (E,) each.
        name: of the dataset.
    """
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.subplots()
    plain_axes(axes)
    shown = slice(min(len(columns["episode"]), _SHOWN))
    episodes = np.asarray(columns["episode"])[shown]
    axes.axhline(1.0, color=BLACK, linewidth=0.8, label="proven optimum")
    for method, colour, marker, size in (  # where both are optimal, a dot in a square
        ("policy", COLOURS[0], "o", 3.0),
        ("greedy", COLOURS[1], "s", 6.0),
    ):
        axes.plot(
            episodes,
            np.asarray(columns[f"ratio_{method}"])[shown],
            linestyle="none",
            marker=marker,
            markersize=size,
            markerfacecolor="none" if method == "greedy" else colour,
            markeredgewidth=0.8,
            color=colour,
            label=method,
        )
    total = len(columns["episode"])
    part = "" if total <= _SHOWN else f", first {_SHOWN} of {total:,}"
    axes.set_xlabel(f"episode{part}")
    axes.set_ylabel("det S / det S*")
    axes.set_ylim(0.0, 1.05)
    axes.set_title(
        f"Gap to the proven optimum, episode by episode: {name}, 4 of 50", fontsize=10
    )
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure
