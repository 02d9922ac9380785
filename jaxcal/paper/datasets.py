"""Datasets 1 to 5 of the paper's Table 3 (docs/datasets.md), each by seed.

Commands are uniform within ``RANGES`` and stored normalised to [0, 1], as in the paper.
Every block of 1,000 episodes has a random stream of its own, spawned from the seed, the
dataset's number and the block's: no dataset shares candidates with another, and fewer
episodes are the first of them.

Datasets 4 and 5 are the ``pairs.csv`` of ``jaxcal-rig collect``, one posture per line:
commands ``u_deg_pitch, u_deg_yaw, u_deg_roll``, readings of the phone ``y_deg_...``.
The paper recorded 550 postures and speaks of 100 x 50 and 1 x 50: so dataset4 is drawn
from its pool, 50 of 500 per episode; dataset5 is the first 50 of its own session.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import pathlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxcal.candidates import JointRanges
from jaxcal.checks import Array
from jaxcal.evaluation.dataset import Dataset
from jaxcal.tables import parse

AXES = ("pitch", "yaw", "roll")
SCALE = np.array([0.43, 0.71, 0.87])  # pitch, yaw, roll; Table 1 lists roll before yaw
BIAS_DEG = np.array([3.1, -5.8, 2.41])
NOISE_STD_DEG = 0.1  # ours; the paper gives none
RANGES = JointRanges([-20.0] * 3, [20.0] * 3)  # degrees, ours as well

EPISODES = {
    "dataset0": 200,
    "dataset1": 200_000,
    "dataset2": 1_000,
    "dataset3": 100,
    "dataset4": 100,
    "dataset5": 1,
}
NAMES = tuple(EPISODES)
RECORDED = ("dataset4", "dataset5")
NUM_CANDIDATES = 50
BLOCK = 1_000  # episodes of a drawn dataset that share a random stream
SHIPPED = pathlib.Path(__file__).parent / "data"


def make_dataset(
    name: str,
    seed: int = 0,
    episodes: int | None = None,
    *,
    recordings: pathlib.Path | str | None = None,
) -> Dataset:
    """One of the paper's datasets, whole (dataset1: 240 MB); arguments as
    ``chunks``."""
    parts = list(chunks(name, seed, episodes, recordings=recordings))
    whole: dict[str, Any] = {}
    for key in ("candidates", "measured"):
        if (arrays := [getattr(part, key) for part in parts])[0] is not None:
            whole[key] = np.concatenate(arrays)
    return dataclasses.replace(parts[0], **whole)


def chunks(
    name: str,
    seed: int = 0,
    episodes: int | None = None,
    *,
    recordings: pathlib.Path | str | None = None,
) -> Iterator[Dataset]:
    """One of the paper's datasets, at most 1,000 episodes at a time.

    Args:
        name: dataset1 to dataset5.
        seed: of the streams, 0 or greater; of the draws from the pool (dataset4).
        episodes: the first so many; all when not given.
        recordings: folder of dataset4.csv and dataset5.csv; None is the shipped one.

    Raises:
        OSError: a recording cannot be read.
        ValueError: before the first chunk is drawn; or of a line of a recording.
    """
    if name == "dataset0":
        raise ValueError(
            "dataset0 is simulated in MuJoCo. Make dataset0.npz with python -m "
            "benchmarks.paper.datasets dataset0 --out DIR, in the repository"
        )
    if name not in NAMES:
        raise ValueError(f"name must be one of {', '.join(NAMES)}, got {name!r}")
    if seed < 0:
        raise ValueError(f"seed must not be negative, got {seed}")
    total = EPISODES[name] if episodes is None else episodes
    if not 1 <= total <= EPISODES[name]:
        raise ValueError(
            f"episodes must be in [1, {EPISODES[name]}] for {name}, got {total}"
        )
    if name in RECORDED:
        return iter([_recorded(name, seed, recordings).part(0, total)])
    counts = [min(BLOCK, total - begin) for begin in range(0, total, BLOCK)]
    return (_drawn(name, seed, block, count) for block, count in enumerate(counts))


def _drawn(name: str, seed: int, block: int, count: int) -> Dataset:
    draw, noise = streams(name, seed, block)
    candidates = draw.random((count, NUM_CANDIDATES, 3))
    measured = None
    if name == "dataset3":
        measured = RANGES.denormalise(candidates) * SCALE + BIAS_DEG
        measured += noise.normal(0.0, NOISE_STD_DEG, measured.shape)
    return Dataset(name, candidates, measured, ranges=RANGES, seed=seed)


def streams(
    name: str, seed: int, block: int
) -> tuple[np.random.Generator, np.random.Generator]:
    """Random streams of the commands and of the noise in one block of a dataset."""
    key = (NAMES.index(name), block)
    draw, noise = np.random.SeedSequence(seed, spawn_key=key).spawn(2)
    return np.random.default_rng(draw), np.random.default_rng(noise)


def _recorded(name: str, seed: int, folder: pathlib.Path | str | None) -> Dataset:
    """With enough postures for every episode they are taken in the order they were
    recorded; with fewer every episode is a draw without repeats, by the seed."""
    path = (SHIPPED if folder is None else pathlib.Path(folder)) / f"{name}.csv"
    commands, measured, ranges, digest = read_pool(path)
    episodes, have = EPISODES[name], len(commands)
    if have < NUM_CANDIDATES:
        raise ValueError(
            f"{path}: an episode needs {NUM_CANDIDATES} postures, the recording has "
            f"{have}"
        )
    if have >= episodes * NUM_CANDIDATES:
        rows = np.arange(episodes * NUM_CANDIDATES).reshape(episodes, -1)
    else:
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(4,)))
        rows = np.stack(
            [rng.choice(have, NUM_CANDIDATES, replace=False) for _ in range(episodes)]
        )
    unit = ranges.normalise(commands)[rows]
    return Dataset(name, unit, measured[rows], None, ranges, seed, digest)


def read_pool(path: str | os.PathLike[str]) -> tuple[Array, Array, JointRanges, str]:
    """A recording in the order in which it was made: (N, 3) commands and (N, 3)
    readings in degrees, the ranges that [0, 1] stands for, and the SHA-256 of the
    file."""
    file = pathlib.Path(path)
    data = file.read_bytes()
    ranges = _ranges_beside(file)
    table = parse(os.fspath(path), data)
    # Not the zero posture, which a session visits again to measure its drift.
    roles = np.array(table.labels.get("role", [""] * len(table)))
    used = roles != "reference"
    columns = [f"{what}_deg_{axis}" for what in "uy" for axis in AXES]
    values = table.columns(columns, used)[used]
    unit = ranges.normalise(values[:, :3])
    for row in np.flatnonzero(((unit < 0.0) | (unit > 1.0)).any(axis=1)):
        low, high = ranges.low.tolist(), ranges.high.tolist()
        raise ValueError(
            f"{table.source}: posture {row + 1} is commanded "
            f"{values[row, :3].tolist()} deg, outside the ranges {low} to {high}. If "
            'those are too narrow, set "ranges_deg" in '
            f"{file.with_suffix('.json').name}"
        )
    return values[:, :3], values[:, 3:], ranges, hashlib.sha256(data).hexdigest()


def _ranges_beside(recording: pathlib.Path) -> JointRanges:
    """The ranges its data card names; ours where there is none."""
    card = recording.with_suffix(".json")
    if not card.exists():
        return RANGES
    try:
        named = json.loads(card.read_text(encoding="utf-8")).get("ranges_deg")
        if named is None:
            return RANGES
        return JointRanges(*zip(*(named[axis] for axis in AXES), strict=True))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(
            f'{card}: "ranges_deg" must give [low, high] of {", ".join(AXES)}: {error}'
        ) from None
