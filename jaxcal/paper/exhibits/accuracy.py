"""Four postures against fifty, how many are enough, and how well parameters are known.

Every episode is one device of Table 1 with its own candidate set. A calibration is
judged by the root mean square of its prediction error over all candidates of the
episode, against the device as it is right after the last measurement.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from jaxcal.evaluation.parameters import least_squares, parameter_names, predict
from jaxcal.information.regression import regressors
from jaxcal.paper.datasets import BIAS_DEG, NOISE_STD_DEG, SCALE
from jaxcal.paper.exhibits.columns import from_rows
from jaxcal.paper.exhibits.devices import Device, pick, rms
from jaxcal.paper.exhibits.exhibit import Exhibit, Verdict
from jaxcal.paper.exhibits.figures.accuracy import (
    ellipses,
    four_against_fifty,
    number_of_postures,
)
from jaxcal.paper.exhibits.intervals import (
    mean_interval,
    median_interval,
    paired,
    share_interval,
)
from jaxcal.paper.exhibits.material import Material, commands_deg
from jaxcal.selection import exchange_batch

__all__ = ["exhibits"]

Array = NDArray[np.float64]

DRIFT_DEG = 0.05  # per posture, in the scenario with drift
OUTLIER_SHARE = 0.05
SWEEPS: dict[str, tuple[str, tuple[float, ...]]] = {
    "white noise": ("noise_std_deg", (0.02, 0.05, 0.1, 0.2, 0.4)),
    "drift": ("drift_std_deg", (0.0, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2)),
    "outliers": ("outlier_share", (0.0, 0.01, 0.02, 0.05, 0.1, 0.2)),
}
MAIN = {"white noise": 0.1, "drift": DRIFT_DEG, "outliers": OUTLIER_SHARE}
POSTURES = (4, 5, 6, 8, 10, 12, 16, 20, 25, 30, 40, 50)


def exhibits(material: Material) -> list[Exhibit]:
    """Four against fifty, number of postures, error ellipsoids."""
    return [_four_or_fifty(material), _postures(material), _ellipsoids(material)]


# -- four against fifty ----------------------------------------------------------------


def _four_or_fifty(material: Material) -> Exhibit:
    settings = material.settings
    count = min(settings.repeats, settings.episodes)
    commands = commands_deg(material.dataset("dataset2"))[:count]
    chosen = material.result("dataset2", "policy").indices[:count, 0]
    names = ("scenario", "strength", "episode", "rms_four_deg", "rms_fifty_deg")
    rows: list[tuple[Any, ...]] = []
    numbers: dict[str, Any] = {}
    curves: dict[str, Any] = {}
    for which, (scenario, (field, strengths)) in enumerate(SWEEPS.items()):
        curves[scenario] = []
        for step, strength in enumerate(strengths):
            device = dataclasses.replace(Device(), **{field: strength})
            rng = settings.rng(7, which, step)
            four = _judge(device, commands, pick(commands, chosen), rng)
            fifty = _judge(device, commands, commands, rng)
            pairs = zip(four.tolist(), fifty.tolist(), strict=True)
            rows += [(scenario, strength, i, *p) for i, p in enumerate(pairs, 1)]
            entry = {
                "strength": strength,
                "four": mean_interval(four),
                "fifty": mean_interval(fifty),
                "four_better": share_interval(four < fifty),
            }
            curves[scenario].append(entry)
            if strength == MAIN[scenario]:
                pair = paired(four, fifty, settings.rng(8, which), settings.resamples)
                numbers[scenario] = entry | {
                    "median_four_deg": float(np.median(four)),
                    "median_fifty_deg": float(np.median(fifty)),
                    "paired": pair.as_dict(),
                    "ratio_of_means": pair.ratio_of_means,
                }
    z = regressors(commands)
    numbers["mean_prediction_variance"] = {
        "four": mean_interval(_mean_variance(pick(z, chosen), z)),
        "fifty": mean_interval(_mean_variance(z, z)),
    }
    numbers["recorded"] = _recorded(material)
    white, drift, gross = (numbers[name]["four_better"] for name in SWEEPS)
    verdict: Verdict = "agrees in part"
    if white.low > 0.5:
        verdict = "agrees"
    elif max(drift.high, gross.high) < 0.5:
        verdict = "disagrees"
    return Exhibit.from_texts(
        "four_or_fifty",
        {"count": count, "drift_deg": DRIFT_DEG, "outlier_share": OUTLIER_SHARE},
        verdict=verdict,
        figures={"four_or_fifty": four_against_fifty(curves)},
        data={"four_or_fifty": from_rows(names, rows)},
        numbers=numbers,
    )


def _judge(
    device: Device, region: Array, commands: Array, rng: np.random.Generator
) -> Array:
    """(E,) degrees rms over the region of a calibration from ``commands``."""
    measured, off = device.record(commands, rng)
    found = least_squares(commands, measured)
    return rms(predict(found, region) - device.true_outputs(region, off))


def _mean_variance(chosen: Array, region: Array) -> Array:
    """(E,) mean over the region of the prediction variance, for unit noise."""
    inverse = np.linalg.inv(np.matrix_transpose(chosen) @ chosen)
    return np.einsum("eni,eij,enj->en", region, inverse, region).mean(axis=1)


def _recorded(material: Material) -> dict[str, Any]:
    """Four of fifty recorded together, predicting every other episode of dataset4."""
    recorded = material.measured("dataset4")
    four_parameters = material.result("dataset4", "policy").parameters
    assert four_parameters is not None
    four = _across(four_parameters[:, 0], *recorded)
    fifty = _across(material.all_parameters("dataset4"), *recorded)
    pair = paired(four, fifty, material.settings.rng(8, 9), material.settings.resamples)
    return {
        "four": mean_interval(four),
        "fifty": mean_interval(fifty),
        "four_better": pair.a_lower,
        "ratio_of_means": pair.ratio_of_means,
    }


def _across(parameters: Array, commands: Array, measured: Array) -> Array:
    """(E,) rms of each episode's calibration over all other episodes, degrees."""
    errors = predict(parameters[:, None], commands[None]) - measured[None]
    square = (errors**2).mean(axis=(-2, -1))
    count = len(square)
    return np.sqrt((square.sum(axis=1) - np.diag(square)) / (count - 1))


# -- how many postures -----------------------------------------------------------------


def _postures(material: Material) -> Exhibit:
    settings = material.settings
    count = min(settings.repeats, 200)
    unit = material.dataset("dataset2").candidates[:count]
    commands = commands_deg(material.dataset("dataset2"))[:count]
    z = regressors(commands)
    scenarios = {
        "white noise": Device(),
        "drift": Device(drift_std_deg=DRIFT_DEG),
    }
    names = (
        *("scenario", "choice", "K", "median_rms_deg", "low", "high"),
        *("root_mean_square_deg", "theory_deg"),
    )
    rows: list[tuple[Any, ...]] = []
    for step, k in enumerate(POSTURES):
        material.progress("number of postures", step, len(POSTURES))
        draw = settings.rng(9, step)
        order = np.argsort(draw.random(unit.shape[:2]), axis=1)[:, :k]
        best = exchange_batch(unit, k=k, seed=settings.seed).indices
        for choice, indices in (("D-optimal", best), ("random", order)):
            used = pick(commands, indices)
            variance = _mean_variance(pick(z, indices), z).mean()
            for which, (scenario, device) in enumerate(scenarios.items()):
                found = _judge(device, commands, used, settings.rng(10, step, which))
                middle = median_interval(found)
                theory = NOISE_STD_DEG * float(np.sqrt(variance))
                rows.append(
                    (
                        *(scenario, choice, k, middle.value, middle.low, middle.high),
                        float(np.sqrt((found**2).mean())),
                        theory if scenario == "white noise" else np.nan,
                    )
                )
    table = from_rows(names, rows)
    white, drift, squares, theory = (
        table[column][(table["scenario"] == name) & (table["choice"] == "D-optimal")]
        for name, column in (
            ("white noise", "median_rms_deg"),
            ("drift", "median_rms_deg"),
            ("white noise", "root_mean_square_deg"),
            ("white noise", "theory_deg"),
        )
    )
    agreement = squares / theory
    half = [k for k, v in zip(POSTURES, white, strict=True) if v <= 0.5 * white[0]]
    figure = number_of_postures(table, NOISE_STD_DEG, DRIFT_DEG)
    return Exhibit.from_texts(
        "number_of_postures",
        {
            **{"count": count, "noise": NOISE_STD_DEG, "drift_deg": DRIFT_DEG},
            **{"white": white, "last_white": white[-1], "last_drift": drift[-1]},
            "half": f", to half of it at K = {half[0]}" if half else "",
            **{"least": drift.min(), "low": agreement.min(), "high": agreement.max()},
        },
        figures={"number_of_postures": figure},
        data={"number_of_postures": table},
        numbers={
            "white_noise_d_optimal_deg": _by_k(white),
            "drift_d_optimal_deg": _by_k(drift),
            "best_k_under_drift": POSTURES[int(drift.argmin())],
            "white_noise_over_theory": agreement.tolist(),
        },
    )


def _by_k(values: Array) -> dict[str, float]:
    return dict(zip(map(str, POSTURES), values.tolist(), strict=True))


# -- error ellipsoids ------------------------------------------------------------------


def _ellipsoids(material: Material) -> Exhibit:
    settings = material.settings
    evaluation = material.evaluation("dataset3")
    commands = commands_deg(evaluation.dataset)[0]
    draws = evaluation.random_log_det[0]
    middle = int(np.argsort(draws)[len(draws) // 2])
    chosen = {
        "random, median draw": material.result("dataset3", "random").indices[0, middle],
        "policy": material.result("dataset3", "policy").indices[0, 0],
        "all 50": np.arange(len(commands)),
    }
    pitch = (
        "a11",
        "a12",
        "a13",
        "bx",
    )  # all three rows have this covariance
    covariance: dict[str, Any] = {}
    rows: list[tuple[Any, ...]] = []
    for label, indices in chosen.items():
        z = regressors(commands[indices])
        covariance[label] = NOISE_STD_DEG**2 * np.linalg.inv(z.T @ z)
        for name, values in zip(pitch, covariance[label], strict=True):
            rows.append((label, name, *values))
    repeats = 2_000 if settings.quick else 10_000
    used = np.broadcast_to(commands[chosen["policy"]], (repeats, 4, 3))
    found = least_squares(used, Device().record(used, settings.rng(11))[0])
    truth = np.concatenate([np.diag(SCALE).ravel(), BIAS_DEG])
    numbers_of_rows = [0, 1, 2, 9], [3, 4, 5, 10], [6, 7, 8, 11]
    inverse = np.linalg.inv(covariance["policy"])
    square = sum(
        np.einsum("ei,ij,ej->e", off, inverse, off)
        for off in (found[:, row] - truth[row] for row in numbers_of_rows)
    )
    deviation = {c: np.sqrt(np.diag(value)).tolist() for c, value in covariance.items()}
    wider = np.array(deviation["random, median draw"]) / deviation["policy"]
    shown, row = found[:200], numbers_of_rows[0]
    return Exhibit.from_texts(
        "ellipsoids",
        {
            **{"noise": NOISE_STD_DEG, "least": wider.min(), "most": wider.max()},
            "count": repeats,
        },
        figures={"ellipsoids": ellipses(covariance, truth[row], shown[:, row])},
        data={
            "covariance": from_rows(
                ("choice", "row", *(f"covariance_{name}" for name in pitch)), rows
            ),
            "calibrations": dict(zip(parameter_names(3, 3), shown.T, strict=True)),
        },
        numbers={
            "share_inside_95": share_interval(square <= stats.chi2.ppf(0.95, 12)),
            "standard_deviations": deviation,
        },
    )
