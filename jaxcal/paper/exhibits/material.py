"""Datasets and selections that several exhibits draw on, each made once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.methods import Progress, evaluate
from jaxcal.evaluation.parameters import least_squares
from jaxcal.evaluation.results import Evaluation, MethodResult
from jaxcal.paper.datasets import make_dataset
from jaxcal.paper.exhibits.settings import Settings

__all__ = ["METHODS", "Material", "commands_deg"]

Array = NDArray[np.float64]

METHODS = ("policy", "random", "greedy", "exact")


def commands_deg(dataset: Dataset) -> Array:
    """(E, M, n) commands in the ranges' unit: degrees, for the paper's datasets."""
    if dataset.ranges is None:
        return dataset.candidates
    return dataset.ranges.denormalise(dataset.candidates)


class Material:
    """What the exhibits share; made when first asked for."""

    def __init__(self, settings: Settings, progress: Progress | None = None) -> None:
        self.settings = settings
        self.stage = ""  # what the report is at, in front of every task
        self._progress = progress
        self._datasets: dict[str, Dataset] = {}
        self._evaluations: dict[str, Evaluation] = {}

    def progress(self, task: str, done: int, total: int) -> None:
        """Tell how far a task is."""
        if self._progress is not None:
            self._progress(f"{self.stage}{task}", done, total)

    def dataset(self, name: str) -> Dataset:
        """One of the paper's datasets, at the size of these settings."""
        if name not in self._datasets:
            settings = self.settings
            episodes = {"dataset0": settings.groups, "dataset2": settings.episodes}
            self._datasets[name] = make_dataset(
                name,
                settings.seed,
                episodes.get(name),
                recordings=settings.data,
                progress=self.progress,
            )
        return self._datasets[name]

    def evaluation(self, name: str) -> Evaluation:
        """Four postures by every method, judged against the proven optimum."""
        if name not in self._evaluations:
            self._evaluations[name] = evaluate(
                self.dataset(name),
                4,
                METHODS,
                random_draws=self.settings.random_draws,
                seed=self.settings.seed,
                progress=lambda task, *counts: self.progress(
                    f"{name}: {task}", *counts
                ),
            )
        return self._evaluations[name]

    def result(self, name: str, method: str) -> MethodResult:
        """What one method chose on a dataset."""
        found = self.evaluation(name).results
        return next(result for result in found if result.method == method)

    def measured(self, name: str) -> tuple[Array, Array]:
        """(E, M, 3) commands and (E, M, 3) readings of a dataset, in degrees."""
        data = self.dataset(name)
        assert data.measured is not None
        return commands_deg(data), data.measured

    def about_overlap(self, name: str) -> str:
        """A caution where the episodes of a dataset share postures; else nothing."""
        sets = self.dataset(name).candidates
        distinct = len(np.unique(sets.reshape(-1, sets.shape[-1]), axis=0))
        if distinct == sets.shape[0] * sets.shape[1]:
            return ""
        return (
            f" The episodes are draws from {distinct:,} postures and overlap: "
            "intervals over them say nothing about another recording."
        )

    def all_parameters(self, name: str) -> Array:
        """(E, 12) identified from every candidate of an episode."""
        return least_squares(*self.measured(name))
