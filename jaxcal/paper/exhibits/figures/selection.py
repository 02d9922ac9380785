"""The gap to the optimum, episode by episode."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from jaxcal.paper.exhibits.figures.parts import legend_right, panels
from jaxcal.plots import BLACK, COLOURS

__all__ = ["gap_per_episode"]

_SHOWN = 200


def gap_per_episode(columns: dict[str, Any], name: str) -> Figure:
    """det S / det S* of policy and greedy in each episode.

    Args:
        columns: ``episode``, ``ratio_policy`` and ``ratio_greedy``, (E,) each.
        name: of the dataset.
    """
    title = f"Gap to the proven optimum, episode by episode: {name}, 4 of 50"
    figure, axes = panels((8.0, 3.6), title)
    axes.axhline(1.0, color=BLACK, linewidth=0.8, label="proven optimum")
    for method, colour, marker, size in (  # where both are optimal, a dot in a square
        ("policy", COLOURS[0], "o", 3.0),
        ("greedy", COLOURS[1], "s", 6.0),
    ):
        axes.plot(
            columns["episode"][:_SHOWN],
            columns[f"ratio_{method}"][:_SHOWN],
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
    axes.set(xlabel=f"episode{part}", ylabel="det S / det S*", ylim=(0.0, 1.05))
    legend_right(axes)
    return figure
