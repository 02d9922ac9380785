"""``python -m benchmarks.paper.datasets``: the paper's datasets with data cards."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import importlib.metadata
import io
import json
import os
import pathlib
import platform
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np

from benchmarks.paper.recordings import RECORDED, SHIPPED, recorded
from benchmarks.paper.twin import HOLD_S, RobotConfig, simulate
from jaxcal.arguments import Parser, exit_code, several, values_of
from jaxcal.checks import axis_letter
from jaxcal.evaluation.dataset import LABELS, MASK, Dataset, save_npz
from jaxcal.files import atomic_write, require_writable_folder, write_text
from jaxcal.paper.datasets import (
    AXES,
    BIAS_DEG,
    EPISODES,
    NAMES,
    NOISE_STD_DEG,
    NUM_CANDIDATES,
    RANGES,
    SCALE,
    checked_size,
    streams,
)
from jaxcal.paper.datasets import make_dataset as drawn
from jaxcal.progress import Progress

__all__ = ["dataset0_robot", "main", "make_dataset", "save_csv", "write_datasets"]

_PROGRAM = "python -m benchmarks.paper.datasets"
_DESCRIPTION = """\
Write the paper's Datasets 0 to 5 to a folder: NAME.npz, NAME.csv and the data card
NAME.json of each. dataset0 is simulated in MuJoCo (some seconds), dataset1 takes
240 MB as .npz and 670 MB as .csv, dataset4 and dataset5 are made from recordings.
"""
_WHAT = {
    "dataset0": "the ideal robot of Table 1 driven open loop in MuJoCo, 50 postures of "
    "one second per group, read at the end of each second",
    "dataset1": "commands for training",
    "dataset2": "commands for evaluation",
    "dataset3": "y = diag(scale) u + bias of Table 1, with noise",
    "dataset4": "drawn from a pool of recorded postures, without repeats in an episode",
    "dataset5": "one recorded session",
}


def dataset0_robot() -> RobotConfig:
    """The ideal robot of Table 1."""
    return RobotConfig(tuple(SCALE), tuple(BIAS_DEG))


def make_dataset(
    name: str,
    seed: int = 0,
    episodes: int | None = None,
    *,
    recordings: pathlib.Path | str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Dataset:
    """One of the paper's datasets, whole: the simulated and the recorded too.

    Args:
        name: dataset0, of which every group of postures has a random stream of its
            own, dataset4, dataset5, or what ``jaxcal.paper.datasets`` makes.
        seed: of the streams, 0 or greater.
        episodes: the first so many; all when not given.
        recordings: folder of dataset4.csv and dataset5.csv; the shipped one when not
            given.
        progress: told how much of dataset0 is simulated.
    """
    total = checked_size(name, seed, episodes)
    if name in RECORDED:
        return recorded(name, seed, recordings).part(0, total)
    if name != "dataset0":
        return drawn(name, seed, total)
    shape = (NUM_CANDIDATES, 3)
    pairs = [streams(name, seed, group) for group in range(total)]
    unit = np.stack([draw.random(shape) for draw, _ in pairs])
    noise = np.stack([rng.normal(0.0, NOISE_STD_DEG, shape) for _, rng in pairs])
    read = simulate(dataset0_robot(), RANGES.denormalise(unit), progress=progress)
    return Dataset(name, unit, read + noise, ranges=RANGES, seed=seed)


def write_datasets(
    folder: pathlib.Path,
    names: Sequence[str] = NAMES,
    seed: int = 0,
    *,
    episodes: int | None = None,
    formats: Sequence[str] = ("npz", "csv"),
    recordings: pathlib.Path | None = None,
    progress: Progress | None = None,
) -> list[pathlib.Path]:
    """Write datasets, one whole file after the other; the files.

    Args:
        folder: made when missing.
        names: of ``NAMES``.
        seed: of all of them.
        episodes: at most the first so many of each.
        formats: npz, csv or both.
        recordings: folder of dataset4.csv and dataset5.csv; the shipped one when None.
        progress: told how far each is.

    Raises:
        OSError: the folder cannot be written, or a recording not be read.
        ValueError: of an argument or a recording.
    """
    for what, chosen, allowed in (
        ("names", names, NAMES),
        ("formats", formats, ("npz", "csv")),
    ):
        if unknown := set(chosen) - set(allowed):
            raise ValueError(
                f"{what} must be of {', '.join(allowed)}, got {min(unknown)}"
            )
    report = progress or Progress(quiet=True)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name in dict.fromkeys(names):
        total = EPISODES[name] if episodes is None else min(episodes, EPISODES[name])
        data = make_dataset(name, seed, total, recordings=recordings, progress=report)
        files = [folder / f"{name}.{kind}" for kind in dict.fromkeys(formats)]
        for path in files:
            if path.suffix == ".npz":
                save_npz(data, path)
            else:
                save_csv(data, path, report)
        card = folder / f"{name}.json"
        write_text(card, json.dumps(_card(data, files, recordings), indent=2) + "\n")
        written += [*files, card]
    report.clear()
    return written


def save_csv(
    dataset: Dataset,
    path: str | os.PathLike[str],
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> None:
    """Write a .csv atomically, every number with all its digits; ranges are not kept.
    ``progress`` is told how many episodes of how many are written."""
    n, m, mask = dataset.num_inputs, dataset.num_outputs, dataset.available
    header = [*LABELS, *(f"u_{axis_letter(i, n)}" for i in range(n))]
    values = [dataset.candidates]
    if dataset.measured is not None:
        header += [f"y_{axis_letter(i, m)}" for i in range(m)]
        values.append(dataset.measured)
    header += [] if mask is None else [MASK]
    with atomic_write(path) as file:
        text = io.TextIOWrapper(file, "utf-8", newline="")
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(header)
        for e, episode in enumerate(zip(*values, strict=True)):
            if e % 1000 == 0:
                progress(f"write {os.path.basename(path)}", e, dataset.num_episodes)
            for i, row in enumerate(np.concatenate(episode, axis=1).tolist()):
                last = [] if mask is None else [int(mask[e, i])]
                writer.writerow([e, i, *row, *last])
        text.detach()


def _card(
    dataset: Dataset, files: Sequence[pathlib.Path], recordings: pathlib.Path | None
) -> dict[str, Any]:
    """Everything a reader of the files needs, without jaxcal."""
    name, ranges = dataset.name, dataset.ranges
    assert ranges is not None  # all of the paper's have them
    normalised = "1; command in degrees = low + value * (high - low)"
    units = {"candidates": ("u", normalised), "measured": ("y", "degrees")}
    arrays = {
        key: {
            "shape": list(getattr(dataset, key).shape),
            "dtype": "float64",
            "unit": unit,
            "axes": list(AXES),
            "csv_columns": [f"{letter}_{axis}" for axis in "xyz"],
        }
        for key, (letter, unit) in units.items()
        if getattr(dataset, key) is not None
    }
    ends = np.stack([ranges.low, ranges.high], axis=1).tolist()
    digests = {}
    for path in files:
        with path.open("rb") as file:
            digests[path.name] = hashlib.file_digest(file, "sha256").hexdigest()
    card: dict[str, Any] = {
        "schema": 1,
        "name": name,
        "what": _WHAT[name],
        "episodes": dataset.num_episodes,
        "candidates_per_episode": dataset.num_candidates,
        "arrays": arrays,
        "ranges_deg": dict(zip(AXES, ends, strict=True)),
        "distribution": "uniform within the ranges, independent",
        "seed": dataset.seed,
        "files": digests,
        "command": f"{_PROGRAM} --out DIR --seed {dataset.seed} {name}",
        "made_with": {p: importlib.metadata.version(p) for p in ("jaxcal", "numpy")}
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
        card["made_with"]["mujoco"] = importlib.metadata.version("mujoco")
        card["simulation"] = {
            "seconds_per_posture": HOLD_S,
            "timestep_s": dataset0_robot().timestep_s,
            "robot": dataclasses.asdict(dataset0_robot()),
        }
    if name in RECORDED:
        place = "shipped with jaxcal" if recordings is None else str(recordings)
        card["recording"] = {"file": place, "sha256": dataset.sha256}
        held = (recordings or SHIPPED) / f"{name}.json"
        if held.is_file():
            card["recording"]["card"] = json.loads(held.read_text(encoding="utf-8"))
    return card


def _write(
    names: Annotated[tuple[str, ...], f"{', '.join(NAMES)}; all"] = (),
    *,
    out: Annotated[pathlib.Path, "folder to write to", "DIR"],
    seed: Annotated[int, "of every dataset", "S", (0,)] = 0,
    episodes: Annotated[int | None, "at most the first N of each", (1,)] = None,
    formats: Annotated[
        list[str] | None, "npz,csv", "LIST", several(str, "npz and csv")
    ] = None,
    recordings: Annotated[
        pathlib.Path | None,
        "folder of dataset4.csv and dataset5.csv, your own; the shipped ones",
        "DIR",
    ] = None,
    quiet: Annotated[bool, "no progress"] = False,
) -> None:
    require_writable_folder(out)
    progress = Progress(quiet=quiet)
    try:
        files = write_datasets(
            out,
            names or NAMES,
            seed,
            episodes=episodes,
            formats=formats or ("npz", "csv"),
            recordings=recordings,
            progress=progress,
        )
    finally:
        progress.clear()
    for file in files:
        print(f"saved: {file}")


def main(arguments: list[str] | None = None) -> int:
    """Write; the exit code."""
    parser = Parser(prog=_PROGRAM, description=_DESCRIPTION)
    given = parser.of(_write).parse_args(arguments)
    kept = "each file in the folder is complete"
    return exit_code(lambda: _write(**values_of(given)), "datasets", kept)


if __name__ == "__main__":
    sys.exit(main())
