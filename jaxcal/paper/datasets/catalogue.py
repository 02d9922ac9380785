"""Datasets by name: the paper's, and files beside them."""

from __future__ import annotations

import pathlib
from typing import Any

from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.dataset_files import load_dataset
from jaxcal.extras import needs
from jaxcal.paper.constants import EPISODES
from jaxcal.paper.datasets.datasets import make_dataset

__all__ = ["load"]


def load(
    name: str,
    seed: int = 0,
    episodes: int | None = None,
    *,
    recordings: pathlib.Path | str | None = None,
    progress: Any = None,
) -> Dataset:
    """The first episodes of a dataset by its name, or of a .npz or .csv file.

    Raises:
        OSError: a file cannot be read.
        ValueError: naming the argument, or the place in the file.
    """
    if name in EPISODES:
        count = min(episodes or EPISODES[name], EPISODES[name])
        with needs("study", f"--dataset {name}"):
            return make_dataset(
                name, seed, count, recordings=recordings, progress=progress
            )
    if pathlib.Path(name).suffix.lower() not in (".npz", ".csv"):
        raise ValueError(
            f"--dataset must be one of {', '.join(EPISODES)} or a .npz or .csv file, "
            f"got {name!r}"
        )
    dataset = load_dataset(name)
    return dataset if episodes is None else dataset.part(0, episodes)
