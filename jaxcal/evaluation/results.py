"""What an evaluation found: every selection of every method, and the numbers shown."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from jaxcal.evaluation.dataset import Dataset
from jaxcal.models import Affine

__all__ = [
    "HIT_TOLERANCE",
    "Evaluation",
    "MethodResult",
    "Row",
    "Summary",
    "finite",
    "log_mean",
]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

HIT_TOLERANCE = 1e-9  # of log det(Z.T Z): the same determinant to a billionth


@dataclasses.dataclass(frozen=True)
class _Named:
    """Name and checkpoint of a method."""

    method: str  # as asked for: "greedy", "policy:first", ...
    checkpoint: str | None  # of a policy; None for the shipped one and for baselines

    @property
    def is_policy(self) -> bool:
        """True where a checkpoint chose."""
        return self.method.startswith("policy")


@dataclasses.dataclass(frozen=True)
class Row(_Named):
    """One method in the numbers that the table, the JSON and the page show."""

    numbers: dict[str, Any]  # as documented in docs/evaluation.md; "label": in words


@dataclasses.dataclass(frozen=True)
class Summary:
    """All methods on one dataset, in the numbers that reports show."""

    dataset: dict[str, Any]  # its entry in the JSON document: name, episodes, ...
    k: int
    seed: int
    num_proven: int
    rows: tuple[Row, ...]
    parameter_names: tuple[str, ...] | None = None  # where outputs were measured
    criterion: str = "D"

    @property
    def num_parameters(self) -> int:
        """m (n + 1), 12 for three inputs and three outputs."""
        return self.dataset["num_outputs"] * (self.dataset["num_inputs"] + 1)


@dataclasses.dataclass(frozen=True, eq=False)
class MethodResult(_Named):
    """What one method chose in every episode of a dataset; R draws, 1 unless random."""

    label: str  # in words
    indices: Indices  # (E, R, k)
    log_det: Array  # (E, R) log det S; by another criterion what stands for it
    seconds: float  # a selection, averaged over the batch, compilation left out
    parameters: Array | None  # (E, R, m (n + 1)) identified from the chosen postures


@dataclasses.dataclass(frozen=True, eq=False)
class Evaluation:
    """All methods on one dataset, selection by selection.

    By another criterion than D ``log_worth`` times the outputs stands for log det S.
    """

    dataset: Dataset
    k: int  # postures chosen
    seed: int  # of random draws, exchange starts and policy samples
    results: tuple[MethodResult, ...]  # in the order asked for
    reference: Array  # (E,) log det S* where proven, else an upper bound on it
    proven: NDArray[np.bool_]  # (E,)
    random_log_det: Array  # (E, R) the baseline behind ratio_to_random
    criterion: str = "D"

    def summarise(self, *, indices: bool = False) -> Summary:
        """The numbers of every method.

        With ``indices`` also what each chose in every episode (random: its first draw).
        """
        rows, data = [], self.dataset
        for result in self.results:
            numbers = self.summary(result)
            if indices:
                numbers["indices"] = result.indices[:, 0].tolist()
            rows.append(Row(result.method, result.checkpoint, numbers))
        names = None
        if data.measured is not None:
            names = Affine(data.num_inputs, data.num_outputs).names
        proven = int(self.proven.sum())
        return Summary(
            data.facts(), self.k, self.seed, proven, tuple(rows), names, self.criterion
        )

    def summary(self, result: MethodResult) -> dict[str, Any]:
        """The numbers of one method, as documented in docs/evaluation.md."""
        m = self.dataset.num_outputs
        log_det = result.log_det
        behind = log_det - self.reference[:, None]
        hits = self.proven[:, None] & (behind >= -HIT_TOLERANCE * m)
        behind = np.minimum(behind, 0.0)
        num_parameters = m * (self.dataset.num_inputs + 1)
        efficiency = np.exp(behind / num_parameters)
        row: dict[str, Any] = {"label": result.label}
        if self.criterion != "D":
            return row | {
                "efficiency": _moments(efficiency),
                "least_efficiency": float(efficiency.min()),
                "hit_rate": float(hits.mean()),
                "seconds_per_selection": result.seconds,
                "draws_per_episode": log_det.shape[1],
            }
        with np.errstate(over="ignore"):
            det = np.exp(log_det)
            times = np.exp(log_mean(log_det) - log_mean(self.random_log_det))
        row |= {
            "det_s": _moments(det),
            "log_det_s": _moments(log_det),
            "ratio_to_exact": float(np.exp(behind).mean()),
            "hit_rate": float(hits.mean()),
            "d_efficiency": float(efficiency.mean()),
            "ratio_to_random": finite(times),
            "seconds_per_selection": result.seconds,
            "draws_per_episode": log_det.shape[1],
        }
        if result.parameters is not None:
            row["parameter_variance"] = self.parameter_variance(result).tolist()
        return row

    def parameter_variance(self, result: MethodResult) -> Array:
        """(m (n + 1),) variance over the episodes of each identified parameter.

        Of several draws an episode the median variance: that of random has so heavy a
        tail that a mean over draws shows the worst of them only.
        """
        if result.parameters is None:
            raise ValueError(f"{self.dataset.name} holds no measured outputs")
        return np.median(result.parameters.var(axis=0), axis=0)


def log_mean(log_values: Array) -> float:
    """Log of the mean of exp, without overflow."""
    return float(logsumexp(log_values) - np.log(log_values.size))


def _moments(values: Array) -> dict[str, float | None]:
    with np.errstate(invalid="ignore", over="ignore"):
        return {
            "mean": finite(values.mean()),
            "std": finite(values.std()),
            "median": finite(np.median(values)),
        }


def finite(value: Any) -> float | None:
    """A float, or None where it is too large for one."""
    return float(value) if np.isfinite(value) else None
