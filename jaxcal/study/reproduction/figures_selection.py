"""The gap to the optimum, episode by episode."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxcal.study.figure_style import BLACK, COLOURS, plain_axes

__all__ = ["gap_per_episode"]

_SHOWN = 200


def gap_per_episode(columns: dict[str, Any]) -> Figure:
    """det S / det S* of policy and greedy in each episode.

    Args:
        columns: ``episode``, ``ratio_policy`` and ``ratio_greedy``, (E,) each.
    """
    figure = Figure(figsize=(8.0, 3.6), layout="constrained")
    axes = figure.subplots()
    plain_axes(axes)
    shown = slice(min(len(columns["episode"]), _SHOWN))
    episodes = np.asarray(columns["episode"])[shown]
    axes.axhline(1.0, color=BLACK, linewidth=0.8, label="proven optimum")
    for name, colour, marker, size in (
        ("greedy", COLOURS[1], "s", 3.0),
        ("policy", COLOURS[0], "o", 3.5),
    ):
        axes.plot(
            episodes,
            np.asarray(columns[f"ratio_{name}"])[shown],
            linestyle="none",
            marker=marker,
            markersize=size,
            markerfacecolor="none" if name == "greedy" else colour,
            color=colour,
            label=name,
        )
    axes.set_xlabel("episode")
    axes.set_ylabel("det S / det S*")
    axes.set_ylim(0.0, 1.05)
    axes.set_title("Gap to the proven optimum, episode by episode", fontsize=10)
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure
