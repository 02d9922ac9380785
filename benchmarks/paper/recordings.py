"""Datasets 4 and 5 of the paper: recordings, drawn from by seed.

Each is the ``pairs.csv`` of ``jaxcal-rig collect``, one posture per line: commands
``u_deg_pitch, u_deg_yaw, u_deg_roll``, readings of the phone ``y_deg_...``. The paper
recorded 550 postures and speaks of 100 x 50 and 1 x 50: so dataset4 is drawn from its
pool, 50 of 500 per episode; dataset5 is the first 50 of its own session.
"""

from __future__ import annotations

import hashlib
import json
import os
import pathlib

import numpy as np

import jaxcal.paper
from jaxcal.candidates import JointRanges
from jaxcal.checks import Array
from jaxcal.evaluation.dataset import Dataset
from jaxcal.paper.datasets import AXES, EPISODES, NUM_CANDIDATES, RANGES
from jaxcal.tables import parse

RECORDED = ("dataset4", "dataset5")
SHIPPED = pathlib.Path(jaxcal.paper.__file__).parent / "data"


def recorded(name: str, seed: int, folder: pathlib.Path | str | None) -> Dataset:
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
