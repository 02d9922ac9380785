"""An evaluation of ways to choose postures: against the optimum, set by set."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from jaxcal.checks import Array
from jaxcal.evaluation.dataset import Dataset
from jaxcal.evaluation.report import (
    Column,
    Evaluation,
    MethodNumbers,
    MethodResult,
    Summary,
    finite,
    moments,
)
from jaxcal.models.affine import Affine

Indices = NDArray[np.int64]

HIT_TOLERANCE = 1e-9  # of log det(Z.T Z): the same determinant to a billionth


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PostureResult(MethodResult):
    """What one method chose in every episode of a dataset."""

    indices: Indices  # (E, R, k)
    parameters: Array | None  # (E, R, m (n + 1)) identified from the chosen postures

    @property
    def log_det(self) -> Array:  # (E, R)
        return self.values


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class PostureEvaluation(Evaluation):
    """All methods on one dataset, selection by selection.

    ``reference`` (E,) is log det S* where proven, else an upper bound on it.
    """

    title: ClassVar[str] = "Posture selection compared with the proven optimum"
    about: ClassVar[str] = (
        "det S is in the unit of the dataset's commands. S is the information matrix "
        "AᵀA of the chosen postures, S* that of the best choice. Hit rate: share of "
        "selections whose determinant equals the optimum's within 1e-9. D-eff.: mean "
        "of (det S / det S*)^(1/p), p parameters. x random: mean det S divided by that "
        "of random selection. Time: per selection, averaged over the batch."
    )

    dataset: Dataset
    k: int  # postures chosen
    results: tuple[PostureResult, ...]
    proven: NDArray[np.bool_]  # (E,)
    random_log_det: Array  # (E, R) the baseline behind ratio_to_random

    def summarise(self, *, indices: bool = False) -> Summary:
        """The numbers of every method; with ``indices`` also what each chose in every
        episode (random: its first draw)."""
        rows, data = self.rows(), self.dataset
        if indices:
            for row, result in zip(rows, self.results, strict=True):
                row.numbers["indices"] = result.indices[:, 0].tolist()
        facts: dict[str, Any] = {"dataset": data.facts(), "k": self.k}
        facts |= {"seed": self.seed, "criterion": "D"}
        if data.measured is not None:
            names = Affine(data.num_inputs, data.num_outputs).names
            facts["parameter_names"] = list(names)
        return summary_of(facts, rows, int(self.proven.sum()))

    def summary(self, result: PostureResult) -> dict[str, Any]:
        """The numbers of one method, as documented in docs/evaluation.md."""
        m = self.dataset.num_outputs
        behind = self.less(result)
        hits = self.proven[:, None] & (behind >= -HIT_TOLERANCE * m)
        behind = np.minimum(behind, 0.0)
        efficiency = np.exp(behind / (m * (self.dataset.num_inputs + 1)))
        with np.errstate(over="ignore"):
            det = np.exp(result.log_det)
            times = np.exp(log_mean(result.log_det) - log_mean(self.random_log_det))
        row: dict[str, Any] = {
            "label": result.label,
            "det_s": moments(det),
            "log_det_s": moments(result.log_det),
            "ratio_to_exact": float(np.exp(behind).mean()),
            "hit_rate": float(hits.mean()),
            "d_efficiency": float(efficiency.mean()),
            "ratio_to_random": finite(times),
            "seconds_per_selection": result.seconds,
            "draws_per_episode": result.log_det.shape[1],
        }
        if result.parameters is not None:
            row["parameter_variance"] = self.parameter_variance(result).tolist()
        return row

    def parameter_variance(self, result: PostureResult) -> Array:
        """(m (n + 1),) variance over the episodes of each identified parameter.

        Of several draws an episode the median variance: that of random has so heavy a
        tail that a mean over draws shows the worst of them only.
        """
        if result.parameters is None:
            raise ValueError(f"{self.dataset.name} holds no measured outputs")
        return np.median(result.parameters.var(axis=0), axis=0)


def summary_of(
    facts: dict[str, Any], rows: tuple[MethodNumbers, ...], proven: int
) -> Summary:
    """The summary of one dataset, of which so many episodes' optima are ``proven``;
    ``facts`` for the JSON: dataset, k, seed, criterion."""
    data, k = facts["dataset"], facts["k"]
    seed = "" if data["seed"] is None else f", seed {data['seed']}"
    heading = (
        f"{data['name']}{seed}: {data['episodes']:,} episodes, "
        f"{k} of {data['num_candidates']} postures, "
        f"{data['num_inputs']} inputs, {data['num_outputs']} outputs"
    )
    notes = []
    if proven < data["episodes"]:
        notes.append(
            f"{data['episodes'] - proven} of {data['episodes']} optima are not proven. "
            "There an upper bound replaces det S*: true ratios and efficiencies are "
            "at least those shown, and no selection counts as a hit"
        )
    if k == data["num_inputs"] + 1:
        notes.append(
            f"k = {k} fits {k * data['num_outputs']} parameters with as many "
            "equations: no residual, so the noise cannot be estimated; use a larger k"
        )
    facts = facts | {"proven": proven / data["episodes"], "notes": notes}
    return Summary(data["name"], heading, _COLUMNS, rows, facts, tuple(notes))


def log_mean(log_values: Array) -> float:
    """Log of the mean of exp, without overflow."""
    return float(logsumexp(log_values) - np.log(log_values.size))


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _share(value: float) -> str:
    """Four decimals, and never 1.0000 for what is below it."""
    text = f"{value:.4f}"
    return "0.9999+" if text == "1.0000" and value < 1.0 - 1e-12 else text


def _time(seconds: float) -> str:
    units = {"s": 1.0, "ms": 1e-3, "µs": 1e-6}
    unit = next((unit for unit, size in units.items() if seconds >= size), "µs")
    return f"{seconds / units[unit]:.3g} {unit}"


_COLUMNS: tuple[Column, ...] = (
    ("method", lambda row: row.numbers["label"]),
    ("mean det S", lambda row: _or_dash(row.numbers["det_s"]["mean"], ".4g")),
    ("median det S", lambda row: _or_dash(row.numbers["det_s"]["median"], ".4g")),
    ("det S/det S*", lambda row: _share(row.numbers["ratio_to_exact"])),
    ("hit rate", lambda row: _share(row.numbers["hit_rate"])),
    ("D-eff.", lambda row: _share(row.numbers["d_efficiency"])),
    ("x random", lambda row: _or_dash(row.numbers["ratio_to_random"], ",.0f")),
    ("time each", lambda row: _time(row.numbers["seconds_per_selection"])),
)


def estimate_parameters(dataset: Dataset, indices: Indices) -> Array | None:
    """Least-squares parameters of every selection; the batched ``jaxcal.identify``.

    ``indices`` (E, R, k) -> (E, R, m (n + 1)) A row by row, then b; in the unit of
    ``dataset.ranges`` where it has one, else in that of the candidates. None where
    nothing was measured.
    """
    if dataset.measured is None:
        return None
    commands = dataset.candidates
    if dataset.ranges is not None:
        commands = dataset.ranges.denormalise(commands)
    gather = indices[..., None]
    u = np.take_along_axis(commands[:, None], gather, axis=2)
    y = np.take_along_axis(dataset.measured[:, None], gather, axis=2)
    return least_squares(u, y)


def least_squares(commands: Array, measured: Array) -> Array:
    """(..., m (n + 1)) A row by row, then b, of many sets of postures at once.

    ``commands`` are (..., N, n), N > n and of full rank, ``measured`` (..., N, m).
    """
    mean_u = commands.mean(axis=-2, keepdims=True)
    mean_y = measured.mean(axis=-2, keepdims=True)
    q, r = np.linalg.qr(commands - mean_u)
    slopes = np.linalg.solve(r, np.matrix_transpose(q) @ (measured - mean_y))
    biases = (mean_y - mean_u @ slopes)[..., 0, :]
    matrix = np.matrix_transpose(slopes)
    return np.concatenate([matrix.reshape(*biases.shape[:-1], -1), biases], axis=-1)


def predict(parameters: Array, commands: Array) -> Array:
    """(..., N, m) outputs at (..., N, n) commands: the batched ``Calibration.predict``.

    ``parameters`` are (..., m (n + 1)), as those of ``least_squares``.
    """
    n = commands.shape[-1]
    m = parameters.shape[-1] // (n + 1)
    matrix = parameters[..., : m * n].reshape(*parameters.shape[:-1], m, n)
    return commands @ np.matrix_transpose(matrix) + parameters[..., None, m * n :]
