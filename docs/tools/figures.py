"""Every figure of the site, drawn anew: from committed data, or computed in seconds."""

from __future__ import annotations

import json
import pathlib
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "examples")]

import common

import jaxcal
from benchmarks import report
from jaxcal import plots
from jaxcal.plots.style import as_bytes, panels


def two_selections() -> Figure:
    """Candidates in two dimensions: random and D-optimal, with their ellipses."""
    candidates = np.random.default_rng(4).uniform(-20.0, 20.0, (40, 2))
    figure, both = panels((8.0, 4.0), shape=(1, 2), sharex=True, sharey=True)
    for axes, method in zip(both, ("random", "exact"), strict=True):
        chosen = jaxcal.select(candidates, 3, method, seed=1)
        plots.selection(axes, candidates, chosen.indices, ("pitch (°)", "yaw (°)"))
        axes.set_title(f"{method}: log det = {chosen.log_det:.1f}", fontsize=10)
        axes.set_aspect("equal")
    return figure


def in_space() -> Figure:
    """Four of 50 postures in three dimensions."""
    candidates = np.random.default_rng(0).uniform(-20.0, 20.0, (50, 3))
    figure = Figure(figsize=(5.5, 5.0), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    chosen = jaxcal.select(candidates, 4)
    plots.selection(axes, candidates, chosen.indices, ("pitch", "yaw", "roll"))
    axes.legend(frameon=False)
    return figure


def by_count() -> Figure:
    """D-efficiency per measurement of greedy, exchange and random against K."""
    candidates = np.random.default_rng(0).uniform(-20.0, 20.0, (50, 3))
    counts = range(4, 13)
    values = {}
    for method in ("exact", "exchange", "greedy", "random"):
        log_dets = [jaxcal.select(candidates, k, method).log_det for k in counts]
        values[method] = np.array(log_dets) - 12.0 * np.log(counts)
    figure, axes = panels((6.4, 4.0))
    plots.against_count(axes, counts, values, "log det of the information per reading")
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "explanations/two_selections.png": two_selections,
    "explanations/in_space.png": in_space,
    "explanations/by_count.png": by_count,
}


def benchmarks() -> dict[str, Any]:
    """What `make benchmark` found, as committed."""
    return json.loads((ROOT / "docs" / "benchmarks" / "results.json").read_text())


def draw_all() -> dict[str, bytes]:
    """Path on the site to image."""
    found = {path: as_bytes(draw(), "png") for path, draw in FIGURES.items()}
    for name in common.NAMES:
        found[f"examples/{name}.png"] = as_bytes(common.picture(name), "png")
    results = benchmarks()
    found["benchmarks/benchmark.png"] = as_bytes(report.overview(results), "png")
    scaling = report.scaling(results["scaling"]["series"])
    found["benchmarks/scaling.png"] = as_bytes(scaling, "png")
    return found
