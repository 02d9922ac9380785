"""How much a report computes, from what, and what several exhibits draw on."""

from __future__ import annotations

import dataclasses
import pathlib

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.datasets import make_dataset
from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.methods import (
    PostureEvaluation,
    PostureResult,
    Progress,
    evaluate,
    least_squares,
)

Array = NDArray[np.float64]

METHODS = ("policy", "default", "random", "greedy", "exact")
PPO = pathlib.Path(__file__).resolve().parents[3] / "checkpoints" / "paper.npz"
"""The policy of every exhibit: PPO alone trained it, on the paper's 210 numbers"""
_LABELS = {"policy": "PPO", "default": "default, by imitation"}
STUDIES = pathlib.Path(__file__).resolve().parents[1] / "kept"
"""Where the repository keeps training runs"""


@dataclasses.dataclass(frozen=True)
class Settings:
    """How much to compute; everything random depends on ``seed``."""

    seed: int = 0
    quick: bool = False
    data: pathlib.Path | None = None  # real recordings in place of Datasets 4 and 5
    studies: pathlib.Path = STUDIES  # kept training runs

    def size(self, what: str) -> int:
        """How much of it, see ``_SIZES``."""
        return _SIZES[what][self.quick]

    @property
    def recorded(self) -> str:
        """What Datasets 4 and 5 are, for titles."""
        return "rig's simulator" if self.data is None else "rig recordings"

    @property
    def about_recordings(self) -> str:
        """Where Datasets 4 and 5 come from, in a sentence."""
        if self.data is not None:
            return f"Datasets 4 and 5: recordings given as --data {self.data}."
        return (
            "Datasets 4 and 5: shipped recordings, made by the rig's own code against "
            "its simulator (play, noise, a heading that drifts), not on a device."
        )

    @property
    def command(self) -> str:
        """What makes the same report again."""
        words = ["python -m benchmarks.paper"]
        words += [f"--seed {self.seed}"] if self.seed else []
        words += ["--quick"] if self.quick else []
        words += [f"--data {self.data}"] if self.data is not None else []
        return " ".join(words)

    def rng(self, *stream: int) -> np.random.Generator:
        """A stream of its own for each use."""
        sequence = np.random.SeedSequence(self.seed, spawn_key=stream)
        return np.random.default_rng(sequence)


_SIZES = {  # of a whole report, of a quick one
    "episodes": (1_000, 200),  # of dataset2
    "groups": (200, 40),  # of dataset0
    "random_draws": (100, 30),  # per episode
    "resamples": (2_000, 400),  # of a bootstrap
    "repeats": (500, 100),  # simulated devices, or histories of one
}


def choose(candidates: Array) -> NDArray[np.int64]:
    """(E, 4) chosen of (E, M, 3) by the agent that PPO trained."""
    from jaxcal.selection.policy import select_batch

    chosen = select_batch(candidates, 4, checkpoint=str(PPO))
    return np.asarray(chosen, dtype=np.int64)


def commands_deg(dataset: Dataset) -> Array:
    """(E, M, n) commands in the ranges' unit: degrees, for the paper's datasets."""
    if dataset.ranges is None:
        return dataset.candidates
    return dataset.ranges.denormalise(dataset.candidates)


class Study:
    """What the exhibits share; made when first asked for."""

    def __init__(self, settings: Settings, progress: Progress | None = None) -> None:
        self.settings = settings
        self.stage = ""  # what the report is at, in front of every task
        self._progress = progress
        self._datasets: dict[str, Dataset] = {}
        self._evaluations: dict[str, PostureEvaluation] = {}

    def progress(self, task: str, done: int, total: int) -> None:
        """Tell how far a task is."""
        if self._progress is not None:
            self._progress(f"{self.stage}{task}", done, total)

    def dataset(self, name: str) -> Dataset:
        """One of the paper's datasets, at the size of these settings."""
        if name not in self._datasets:
            given = self.settings
            sized = {"dataset0": "groups", "dataset2": "episodes"}.get(name)
            self._datasets[name] = make_dataset(
                name,
                given.seed,
                None if sized is None else given.size(sized),
                recordings=given.data,
                progress=self.progress,
            )
        return self._datasets[name]

    def evaluation(self, name: str) -> PostureEvaluation:
        """Four postures by every method, judged against the proven optimum."""
        if name not in self._evaluations:
            found = evaluate(
                self.dataset(name),
                4,
                [method for method in METHODS if method != "default"],
                (str(PPO), None),
                random_draws=self.settings.size("random_draws"),
                seed=self.settings.seed,
                progress=lambda task, *n: self.progress(f"{name}: {task}", *n),
            )
            results = tuple(
                dataclasses.replace(
                    result, method=method, label=_LABELS.get(method, result.label)
                )
                for result, method in zip(found.results, METHODS, strict=True)
            )
            self._evaluations[name] = dataclasses.replace(found, results=results)
        return self._evaluations[name]

    def result(self, name: str, method: str) -> PostureResult:
        """What one method chose on a dataset."""
        found = self.evaluation(name).results
        return next(result for result in found if result.method == method)

    def parameters(self, name: str, method: str) -> Array:
        """(E, R, 12) identified from what one method chose, or from "all 50"."""
        if method == "all 50":
            return least_squares(*self.measured(name))[:, None]
        found = self.result(name, method).parameters
        assert found is not None
        return found

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


def predict(parameters: Array, commands: Array) -> Array:
    """(..., N, m) outputs at (..., N, n) commands, of the ``parameters`` (..., m (n +
    1)) of ``least_squares``."""
    n = commands.shape[-1]
    m = parameters.shape[-1] // (n + 1)
    matrix = parameters[..., : m * n].reshape(*parameters.shape[:-1], m, n)
    return commands @ np.matrix_transpose(matrix) + parameters[..., None, m * n :]
