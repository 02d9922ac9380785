"""``train.py --candidates``: training on the user's own postures."""

from __future__ import annotations

import dataclasses
import hashlib
import pathlib
from typing import Any

import numpy as np

from jaxcal.commands.tables import read_table
from jaxcal.learning.environments.task import GivenCandidates
from jaxcal.learning.training import presets
from jaxcal.learning.training.config import TrainConfig

__all__ = ["candidates_of", "trained_on"]


def candidates_of(path: str) -> GivenCandidates:
    """The user's own candidates, each axis mapped to [0, 1] over the whole file.

    The best postures do not depend on the unit; float32 and the paper's network do.
    """
    from jaxcal.evaluation.dataset_files import load_dataset

    if _holds_sets(path):
        dataset = load_dataset(path)
        values, available = dataset.candidates, dataset.available
    else:
        table = read_table(path)
        values, mask = table.columns(table.inputs(None))[None], table.available()
        available = None if mask is None else mask[None]
    used = values if available is None else values[available]
    used = used.reshape(-1, used.shape[-1])
    low, high = used.min(axis=0), used.max(axis=0)
    for axis in np.flatnonzero(~(low < high)):  # also where a cell is empty
        raise ValueError(
            f"{path}: every column must hold numbers that differ, got {low[axis]:g} to "
            f"{high[axis]:g} in input {axis + 1}: leave it out"
        )
    return GivenCandidates(
        name=pathlib.Path(path).name,
        sha256=hashlib.sha256(pathlib.Path(path).read_bytes()).hexdigest(),
        values=((values - low) / (high - low)).astype(np.float32),
        available=available,
    )


def _holds_sets(path: str) -> bool:
    """Whether a file holds episodes of candidates, in the format of datasets."""
    if path.lower().endswith(".npz"):
        return True
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        return "episode" in [cell.strip() for cell in file.readline().split(",")]


def trained_on(
    config: TrainConfig, candidates: GivenCandidates, given: dict[str, Any]
) -> TrainConfig:
    """A preset of one task, on the user's candidates."""
    assert candidates.values is not None  # it was just read
    num_sets, m, n = candidates.values.shape
    if len(config.tasks) > 1:
        raise ValueError(
            f"--candidates goes with a preset of one task, such as compact; "
            f"{config.preset} has {len(config.tasks)}"
        )
    sizes = {"num_inputs": n, "num_outputs": n, "num_selected": n + 1}
    fixed = {"num_inputs": n} | ({"num_candidates": m} if num_sets > 1 else {})
    for name, value in fixed.items():
        if given.get(name, value) != value:
            raise ValueError(
                f"--{name.replace('_', '-')} must be {value}, as in "
                f"{candidates.name}, got {given[name]}: leave it out"
            )
    config = presets.with_values(config, sizes | fixed | given)
    candidates.source(config.tasks[0].environment)  # refuses a pool that is too small
    task = dataclasses.replace(config.tasks[0], given=candidates)
    return dataclasses.replace(config, tasks=(task,))
