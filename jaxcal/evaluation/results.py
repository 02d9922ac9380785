"""What an evaluation found: one method on one dataset, and all of them together."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxcal.evaluation.dataset import Dataset

__all__ = [
    "Evaluation",
    "MethodResult",
    "StreamedData",
    "StreamedEvaluation",
    "StreamedResult",
]

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

HIT_TOLERANCE = 1e-9  # of log det(Z.T Z): the same determinant to a billionth


@dataclasses.dataclass(frozen=True, eq=False)
class MethodResult:
    """What one method chose in every episode of a dataset; R draws, 1 unless random."""

    method: str  # as asked for: "greedy", "policy:first", ...
    label: str  # in words
    checkpoint: str | None  # of a policy; None for the shipped one and for baselines
    indices: Indices  # (E, R, k)
    log_det: Array  # (E, R) natural log det S
    seconds: float  # a selection, averaged over the batch, compilation left out
    parameters: Array | None  # (E, R, m (n + 1)) identified from the chosen postures

    @property
    def is_policy(self) -> bool:
        """True where a checkpoint chose."""
        return self.method.startswith("policy")


@dataclasses.dataclass(frozen=True, eq=False)
class Evaluation:
    """All methods on one dataset."""

    dataset: Dataset
    k: int  # postures chosen
    seed: int  # of random draws, exchange starts and policy samples
    results: tuple[MethodResult, ...]  # in the order asked for
    reference: Array  # (E,) log det S* where proven, else an upper bound on it
    proven: NDArray[np.bool_]  # (E,)
    random_log_det: Array  # (E, R) the baseline behind ratio_to_random

    @property
    def num_proven(self) -> int:
        """Episodes whose optimum is proven."""
        return int(self.proven.sum())

    @property
    def num_parameters(self) -> int:
        """m (n + 1), 12 for three inputs and three outputs."""
        return self.dataset.num_outputs * (self.dataset.num_inputs + 1)

    def summary(self, result: MethodResult) -> dict[str, Any]:
        """The numbers of one method, as documented in docs/evaluation.md."""
        log_det = result.log_det
        behind = log_det - self.reference[:, None]
        hits = self.proven[:, None] & (
            behind >= -HIT_TOLERANCE * self.dataset.num_outputs
        )
        with np.errstate(over="ignore"):
            det = np.exp(log_det)
        row: dict[str, Any] = {
            "label": result.label,
            "det_s": _moments(det),
            "log_det_s": _moments(log_det),
            "ratio_to_exact": float(np.exp(np.minimum(behind, 0.0)).mean()),
            "hit_rate": float(hits.mean()),
            "d_efficiency": float(
                np.exp(np.minimum(behind, 0.0) / self.num_parameters).mean()
            ),
            "ratio_to_random": _finite(
                np.exp(_log_mean(log_det) - _log_mean(self.random_log_det))
            ),
            "seconds_per_selection": result.seconds,
            "draws_per_episode": log_det.shape[1],
        }
        if result.parameters is not None:
            row["parameter_variance"] = self.parameter_variance(result).tolist()
        return row

    def parameter_variance(self, result: MethodResult) -> Array:
        """(m (n + 1),) variance over the episodes of each identified parameter.

        Of several draws an episode the median variance: that of random has so heavy a
        tail that a mean over draws says nothing but the worst of them.
        """
        if result.parameters is None:
            raise ValueError(f"{self.dataset.name} holds no measured outputs")
        return np.median(result.parameters.var(axis=0), axis=0)


@dataclasses.dataclass(frozen=True)
class StreamedData:
    """What is known of episodes that were never held all at once."""

    name: str
    num_episodes: int
    num_candidates: int
    num_inputs: int
    num_outputs: int
    seed: int
    sha256: None = None
    measured: None = None


@dataclasses.dataclass(frozen=True, eq=False)
class StreamedResult:
    """One method on a stream: its numbers, and no episode by itself."""

    method: str
    label: str
    checkpoint: str | None
    numbers: dict[str, Any]  # as in ``Evaluation.summary``

    @property
    def is_policy(self) -> bool:
        """True where a checkpoint chose."""
        return self.method.startswith("policy")


@dataclasses.dataclass(frozen=True, eq=False)
class StreamedEvaluation:
    """All methods on a stream of episodes, as ``jaxcal.evaluation.report`` shows them."""

    dataset: StreamedData
    k: int
    seed: int
    results: tuple[StreamedResult, ...]
    num_proven: int

    @property
    def num_parameters(self) -> int:
        """m (n + 1)."""
        return self.dataset.num_outputs * (self.dataset.num_inputs + 1)

    def summary(self, result: StreamedResult) -> dict[str, Any]:
        """The numbers of one method."""
        return {"label": result.label, **result.numbers}


def _moments(values: Array) -> dict[str, float | None]:
    with np.errstate(invalid="ignore", over="ignore"):
        return {
            "mean": _finite(values.mean()),
            "std": _finite(values.std()),
            "median": _finite(np.median(values)),
        }


def _finite(value: Any) -> float | None:
    """A float, or None where it is too large for one."""
    return float(value) if np.isfinite(value) else None


def _log_mean(log_values: Array) -> float:
    """Log of the mean of exp, without overflow."""
    top = float(log_values.max())
    return top + float(np.log(np.exp(log_values - top).mean()))
