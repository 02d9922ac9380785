"""Every figure of the site, drawn anew: from committed data, or computed in seconds."""

from __future__ import annotations

import io
import itertools
import json
import pathlib
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

ROOT = pathlib.Path(__file__).parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "examples")]

import common

import jaxcal
from benchmarks import report
from jaxcal.models import SerialChain
from jaxcal.reports import plots
from jaxcal.reports.plots import COLOURS, GREY, as_bytes, numbered, panels


def four_of_fifty() -> Figure:
    """Fifty postures in grey, the four to measure, and the volume that they span."""
    candidates, chosen = _ankle()
    figure = Figure(figsize=(4.8, 4.4), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    points = candidates[chosen]
    faces = [points[list(face)] for face in itertools.combinations(range(4), 3)]
    solid = Poly3DCollection(faces, facecolor=COLOURS[0], edgecolor=COLOURS[0])
    solid.set_alpha(0.18)
    axes.add_collection3d(solid)
    rest = np.delete(candidates, chosen, axis=0)
    axes.scatter(*rest.T, color=GREY, s=9, depthshade=False)
    axes.scatter(*points.T, color=COLOURS[0], s=60, marker="D", depthshade=False)
    axes.set(xlabel="pitch (°)", ylabel="yaw (°)", zlabel="roll (°)")
    ticks = [-20, -10, 0, 10, 20]
    axes.set(xticks=ticks, yticks=ticks, zticks=ticks)
    axes.set_title("50 candidates: the 4 of largest volume", fontsize=12)
    return figure


def before_and_after() -> Figure:
    """Errors of the ankle robot at the other 46 postures, with and without the four."""
    candidates, chosen = _ankle()
    scale, bias = np.array([0.43, 0.71, 0.87]), np.array([3.1, -5.8, 2.41])  # Table 1
    reached = candidates * scale + bias
    noise = np.random.default_rng(1).normal(0.0, 0.1, (4, 3))  # degrees
    fitted = jaxcal.identify(candidates[chosen], reached[chosen] + noise)
    rest = np.delete(np.arange(50), chosen)
    errors = {
        "before": (reached - candidates)[rest],
        "after": (reached - fitted.predict(candidates))[rest],
    }
    figure, axes = panels((4.8, 4.4))
    plots.before_after(axes, errors, ("pitch", "yaw", "roll"), "°")
    axes.set_title("Error at the other 46, from these 4", fontsize=12, pad=42)
    return figure


def _ankle() -> tuple[np.ndarray, np.ndarray]:
    """Fifty postures of three axes, degrees, and the best four of them."""
    candidates = np.random.default_rng(0).uniform(-20.0, 20.0, (50, 3))
    return candidates, jaxcal.select(candidates, k=4).indices


def a_table() -> Figure:
    """Rows of a table, those to measure marked."""
    candidates, chosen = _ankle()
    first = np.sort(np.concatenate([chosen[:3], [0, 1, 5, 6]]))
    cells = [
        [str(row), *(f"{value:.1f}" for value in candidates[row])] for row in first
    ]
    figure, axes = panels((3.6, 2.4))
    axes.axis("off")
    drawn = axes.table(cells, colLabels=["", "pitch", "yaw", "roll"], loc="center")
    drawn.scale(1.0, 1.35)
    for (line, _), cell in drawn.get_celld().items():
        cell.set(edgecolor=GREY, linewidth=0.4, facecolor="none")
        if line and first[line - 1] in chosen:
            cell.set(facecolor=COLOURS[0], alpha=0.35)
            cell.get_text().set_weight("bold")
    return figure


def an_arm() -> Figure:
    """An arm of three joints in grey, and in the poses to measure."""
    table = [(0, 90, 90, 0), (-425, 0, 0, 0), (-390, 0, 0, 0)]  # mm, degrees
    links = [SerialChain.from_dh(table[:count]) for count in (1, 2, 3)]
    low, high = [-150.0, -130.0, -120.0], [150.0, -20.0, 120.0]
    poses = np.random.default_rng(2).uniform(low, high, (200, 3))
    above = [link.predict(poses[:, : i + 1])[:, 2] for i, link in enumerate(links)]
    poses = poses[np.min(above, axis=0) > 0.0]
    chosen = jaxcal.select(poses, k=6, model=links[2]).indices
    figure = Figure(figsize=(3.6, 2.4), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    for number in (*range(14), *chosen):
        pose = poses[number]
        joints = [link.predict(pose[None, : i + 1])[0] for i, link in enumerate(links)]
        line = np.stack([np.zeros(3), *joints])
        look = {"color": COLOURS[0], "linewidth": 2.2, "marker": "o", "markersize": 3}
        grey = {"color": GREY, "linewidth": 0.7, "alpha": 0.6}
        axes.plot(*line.T, **(look if number in chosen else grey))
    axes.set_axis_off()
    axes.set_box_aspect((1, 1, 0.8), zoom=1.9)
    return figure


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
    axes.set_box_aspect((4, 4, 3), zoom=0.88)  # the label of the upright axis fits
    axes.legend(frameon=False)
    return figure


def by_count() -> Figure:
    """D-efficiency per measurement of greedy, exchange and random against K."""
    candidates = np.random.default_rng(0).uniform(-20.0, 20.0, (50, 3))
    counts = range(4, 13)
    figure, axes = panels((6.4, 4.0))
    for i, method in enumerate(("exact", "exchange", "greedy", "random")):
        log_dets = [jaxcal.select(candidates, k, method).log_det for k in counts]
        values = np.array(log_dets) - 12.0 * np.log(counts)
        axes.plot(counts, values, label=method, markersize=4, **numbered(i))
    axes.set_xlabel("number of measurements K")
    axes.set_ylabel("log det of the information per reading")
    axes.legend(frameon=False)
    return figure


FIGURES: dict[str, Callable[[], Figure]] = {
    "assets/four_of_fifty.svg": four_of_fifty,
    "assets/before_and_after.svg": before_and_after,
    "assets/a_table.svg": a_table,
    "assets/an_arm.svg": an_arm,
    "explanations/two_selections.svg": two_selections,
    "explanations/in_space.svg": in_space,
    "explanations/by_count.svg": by_count,
}


def thumbnail(name: str) -> bytes:
    """The picture of an example, small."""
    image = io.BytesIO()
    common.picture(name).savefig(image, format="webp", dpi=72)
    return image.getvalue()


def benchmarks() -> dict[str, Any]:
    """What `make benchmark` found, as committed."""
    return json.loads((ROOT / "docs" / "benchmarks" / "results.json").read_text())


def draw_all() -> dict[str, bytes]:
    """Path on the site to image."""
    found = {path: as_bytes(draw(), "svg") for path, draw in FIGURES.items()}
    for name in common.NAMES:
        found[f"examples/{name}.png"] = as_bytes(common.picture(name), "png")
        found[f"assets/gallery/{name}.webp"] = thumbnail(name)
    results = benchmarks()
    found["benchmarks/benchmark.svg"] = as_bytes(report.overview(results), "svg")
    scaling = report.scaling(results["scaling"]["series"])
    found["benchmarks/scaling.svg"] = as_bytes(scaling, "svg")
    return found


if __name__ == "__main__":  # those that README and the gallery show on GitHub
    (ROOT / "docs" / "assets" / "gallery").mkdir(exist_ok=True)
    for path, image in draw_all().items():
        if path.startswith("assets/"):
            (ROOT / "docs" / path).write_bytes(image)
