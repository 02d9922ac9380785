"""What a written dataset is, beside it: a JSON card for programs, a page for people."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import json
import pathlib
import platform
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.candidates import JointRanges
from jaxcal.evaluation.dataset import Dataset
from jaxcal.paper.constants import (
    AXES,
    BIAS_DEG,
    NOISE_STD_DEG,
    NUM_CANDIDATES,
    RECORDED,
    SCALE,
)
from jaxcal.paper.datasets.datasets import dataset0_robot
from jaxcal.paper.datasets.recordings import SHIPPED

__all__ = ["card_of", "digest_of", "page_of", "ranges_of"]

_WHAT = {
    "dataset0": "the ideal robot of Table 1 driven open loop in MuJoCo, 50 postures of "
    "one second per group, read at the end of each second",
    "dataset1": "commands for training",
    "dataset2": "commands for evaluation",
    "dataset3": "y = diag(scale) u + bias of Table 1, with noise",
    "dataset4": "drawn from a pool of recorded postures, without repeats in an episode",
    "dataset5": "one recorded session",
}
_PAGE = """\
# Datasets

Commands (`u_x`, `u_y`, `u_z`: pitch, yaw, roll) are normalised to [0, 1]; readings \
(`y_x`, `y_y`, `y_z`) are in degrees. `NAME.npz` holds `candidates`, `measured`, \
`low` and `high`; `NAME.csv` the same, one posture per line; `NAME.json` every number \
of this page.

| name | episodes | postures | numbers each | noise | seed | what |
|---|---|---|---|---|---|---|
{rows}

Ranges in degrees, what 0 and 1 stand for:

{ranges}

Commands that make them:

```bash
{commands}
```
"""


def card_of(
    dataset: Dataset,
    files: Mapping[str, str],
    *,
    recordings: pathlib.Path | str | None = None,
) -> dict[str, Any]:
    """Everything a reader of the files needs, without jaxcal.

    Args:
        dataset: one of the paper's.
        files: SHA-256 of each file by its name.
        recordings: folder that the recorded ones come from, when not the shipped one.
    """
    name = dataset.name
    assert dataset.ranges is not None
    normalised = "1; command in degrees = low + value * (high - low)"
    arrays = {"candidates": _array(dataset.candidates, normalised, "u")}
    if dataset.measured is not None:
        arrays["measured"] = _array(dataset.measured, "degrees", "y")
    packages = ("jaxcal", "numpy", "mujoco")
    card: dict[str, Any] = {
        "schema": 1,
        "name": name,
        "what": _WHAT[name],
        "episodes": dataset.num_episodes,
        "candidates_per_episode": dataset.num_candidates,
        "arrays": arrays,
        "ranges_deg": ranges_of(dataset.ranges),
        "distribution": "uniform within the ranges, independent",
        "seed": dataset.seed,
        "files": dict(files),
        "command": f"python -m jaxcal.paper.datasets --out DIR --seed {dataset.seed} "
        f"{name}",
        "made_with": {p: importlib.metadata.version(p) for p in packages}
        | {"python": platform.python_version()},
    }
    if name in ("dataset0", "dataset3"):
        kind = "white Gaussian on every output"
        card["noise"] = {"kind": kind, "std_deg": NOISE_STD_DEG}
        card["truth"] = {
            "scale": dict(zip(AXES, SCALE.tolist(), strict=True)),
            "bias_deg": dict(zip(AXES, BIAS_DEG.tolist(), strict=True)),
        }
    if name == "dataset0":
        from jaxcal.paper.twin.robot_model import HOLD_S, timestep_of

        robot = dataset0_robot()
        card["simulation"] = {
            "engine": "mujoco",
            "sample_rate_hz": 1.0 / HOLD_S,
            "seconds_per_episode": NUM_CANDIDATES * HOLD_S,
            "timestep_s": timestep_of(robot),
            "robot": dataclasses.asdict(robot),
        }
    if name in RECORDED:
        folder = SHIPPED if recordings is None else pathlib.Path(recordings)
        place = "shipped with jaxcal" if recordings is None else str(folder)
        card["recording"] = {"file": place, "sha256": dataset.sha256}
        held = folder / f"{name}.json"
        if held.is_file():
            card["recording"]["card"] = json.loads(held.read_text(encoding="utf-8"))
    return card


def ranges_of(ranges: JointRanges) -> dict[str, list[float]]:
    """[low, high] of each axis."""
    ends = np.stack([ranges.low, ranges.high], axis=1).tolist()
    return dict(zip(AXES, ends, strict=True))


def _array(values: NDArray[np.float64], unit: str, letter: str) -> dict[str, Any]:
    return {
        "shape": list(values.shape),
        "dtype": "float64",
        "unit": unit,
        "axes": list(AXES),
        "csv_columns": [f"{letter}_{axis}" for axis in "xyz"],
    }


def digest_of(path: pathlib.Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def page_of(cards: list[dict[str, Any]]) -> str:
    """The cards as one Markdown page."""
    rows, ranges = [], []
    for card in cards:
        level = f"{card['noise']['std_deg']:g} deg" if "noise" in card else "-"
        cells = (
            *(card["name"], f"{card['episodes']:,}", card["candidates_per_episode"]),
            *(3 * len(card["arrays"]), "as recorded" if "recording" in card else level),
            *(card["seed"], card["what"]),
        )
        rows.append(f"| {' | '.join(map(str, cells))} |")
        named = card["ranges_deg"].items()
        ends = ", ".join(f"{axis} {low:g} to {high:g}" for axis, (low, high) in named)
        ranges.append(f"- {card['name']}: {ends}")
    commands = [card["command"] for card in cards]
    parts = {"rows": rows, "ranges": ranges, "commands": commands}
    return _PAGE.format(**{name: "\n".join(lines) for name, lines in parts.items()})
