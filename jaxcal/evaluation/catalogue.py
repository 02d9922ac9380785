"""Datasets known by name, which whoever runs an evaluation hands in."""

from __future__ import annotations

import dataclasses
import os
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.dataset_files import load_dataset
from jaxcal.extras import needs

__all__ = ["Catalogue"]


@dataclasses.dataclass(frozen=True)
class Catalogue:
    """Datasets by name, and files beside them. Worker processes get a copy."""

    sizes: Mapping[str, int]  # episodes of each
    make: Callable[..., Dataset]
    """(name, seed, episodes, recordings=folder, progress=function) -> Dataset"""
    endless: tuple[str, ...]  # those that ``draw`` continues beyond their size
    draw: Callable[[str, int, int, int], Dataset]
    """(name, seed, begin, end) -> episodes begin to end"""
    block: int  # episodes that share a random stream; ``begin`` is a multiple

    def load(
        self,
        name: str,
        seed: int = 0,
        episodes: int | None = None,
        *,
        recordings: str | os.PathLike[str] | None = None,
        progress: Any = None,
    ) -> Dataset:
        """The first episodes of a dataset by its name, or of a .npz or .csv file.

        Raises:
            OSError: a file cannot be read.
            ValueError: naming the argument, or the place in the file.
        """
        if name in self.sizes:
            size = self.sizes[name]
            count = size if episodes is None else min(episodes, size)
            with needs("study", f"--dataset {name}"):
                return self.make(
                    name, seed, count, recordings=recordings, progress=progress
                )
        if pathlib.Path(name).suffix.lower() not in (".npz", ".csv"):
            raise ValueError(
                f"--dataset must be one of {', '.join(self.sizes)} or a .npz or .csv "
                f"file, got {name!r}"
            )
        dataset = load_dataset(name)
        return dataset if episodes is None else dataset.part(0, episodes)
