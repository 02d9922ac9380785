"""Datasets and selections that several exhibits draw on, each made once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.methods import Progress, evaluate
from jaxcal.evaluation.parameters import least_squares
from jaxcal.evaluation.results import Evaluation, MethodResult
from jaxcal.paper.datasets import make_dataset
from jaxcal.paper.exhibits.exhibit import Settings

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
        self.progress: Progress = progress or (lambda *_: None)
        self._datasets: dict[str, Dataset] = {}
        self._evaluations: dict[str, Evaluation] = {}

    def dataset(self, name: str) -> Dataset:
        """One of the paper's datasets, at the size of these settings."""
        if name not in self._datasets:
            episodes = {
                "dataset0": self.settings.groups,
                "dataset2": self.settings.episodes,
            }
            self._datasets[name] = make_dataset(
                name,
                self.settings.seed,
                episodes.get(name),
                recordings=self.settings.data,
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
                progress=lambda task, done, total: self.progress(
                    f"{name}: {task}", done, total
                ),
            )
        return self._evaluations[name]

    def about_overlap(self, name: str) -> str:
        """A caution where the episodes of a dataset share postures; else nothing."""
        sets = self.dataset(name).candidates
        distinct = len(np.unique(sets.reshape(-1, sets.shape[-1]), axis=0))
        total = sets.shape[0] * sets.shape[1]
        if distinct == total:
            return ""
        return (
            f" The episodes are draws from {distinct:,} postures and overlap: "
            "intervals over them say nothing about another recording."
        )

    def about_recordings(self) -> str:
        """Where Datasets 4 and 5 come from, in a sentence."""
        if self.settings.data is not None:
            return f"Datasets 4 and 5: recordings given as --data {self.settings.data}."
        return (
            "Datasets 4 and 5: shipped recordings, made by the rig's own code against "
            "its simulator (play, noise, a heading that drifts), not on a device."
        )

    def result(self, name: str, method: str) -> MethodResult:
        """What one method chose on a dataset."""
        found = self.evaluation(name).results
        return next(result for result in found if result.method == method)

    def all_parameters(self, name: str) -> Array:
        """(E, 12) identified from every candidate of an episode."""
        data = self.dataset(name)
        assert data.measured is not None
        return least_squares(commands_deg(data), data.measured)
