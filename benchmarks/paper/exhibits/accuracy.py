"""Four postures against fifty, and how many are enough.

Every episode is one device of Table 1 with its own candidate set. A calibration is
judged by the root mean square of its prediction error over all candidates of the
episode, against the device as it is right after the last measurement.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, ScalarFormatter
from numpy.typing import NDArray

from benchmarks.paper.exhibits.devices import Device, pick, rms
from benchmarks.paper.exhibits.exhibit import Exhibit, from_rows, judge
from benchmarks.paper.exhibits.intervals import (
    band,
    mean_interval,
    median_interval,
    ratio_interval,
    share_interval,
)
from benchmarks.paper.exhibits.study import Study, commands_deg, predict
from jaxcal.evaluation.methods import least_squares
from jaxcal.information.regression import regressors
from jaxcal.paper.datasets import NOISE_STD_DEG
from jaxcal.reports.plots import BLACK, numbered, panels, plain_log
from jaxcal.selection import exchange_batch

Array = NDArray[np.float64]

SWEEPS: dict[str, tuple[str, str, float, tuple[float, ...]]] = {
    # by scenario: field of a device, in words, its main strength, all of them
    "white noise": (
        *("noise_std_deg", "white noise (° s.d.)"),
        *(0.1, (0.02, 0.05, 0.1, 0.2, 0.4)),
    ),
    "drift": (
        *("drift_std_deg", "drift of the bias (° s.d. per posture)"),
        *(0.05, (0.0, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2)),
    ),
    "outliers": (
        *("outlier_share", "share of gross errors"),
        *(0.05, (0.0, 0.01, 0.02, 0.05, 0.1, 0.2)),
    ),
}
DRIFT_DEG, OUTLIER_SHARE = SWEEPS["drift"][2], SWEEPS["outliers"][2]
POSTURES = (4, 5, 6, 8, 10, 12, 16, 20, 25, 30, 40, 50)


def exhibits(study: Study) -> list[Exhibit]:
    """Four against fifty, and the number of postures."""
    return [_four_or_fifty(study), _postures(study)]


def _four_or_fifty(study: Study) -> Exhibit:
    settings = study.settings
    count = min(settings.size("repeats"), settings.size("episodes"))
    commands = commands_deg(study.dataset("dataset2"))[:count]
    chosen = study.result("dataset2", "policy").indices[:count, 0]
    rows: list[tuple[Any, ...]] = []
    numbers: dict[str, Any] = {}
    curves: dict[str, list[dict[str, Any]]] = {name: [] for name in SWEEPS}
    for which, (scenario, (field, _, main, strengths)) in enumerate(SWEEPS.items()):
        for step, strength in enumerate(strengths):
            device = Device(**{field: strength})
            rng = settings.rng(7, which, step)
            four = _error(device, commands, pick(commands, chosen), rng)
            fifty = _error(device, commands, commands, rng)
            pairs = zip(four.tolist(), fifty.tolist(), strict=True)
            rows += [(scenario, strength, i, *p) for i, p in enumerate(pairs, 1)]
            entry = {"strength": strength, **_means(four, fifty)}
            curves[scenario].append(entry)
            if strength == main:
                resamples = settings.size("resamples")
                rng = settings.rng(8, which)
                ratio = ratio_interval(np.mean, four, fifty, rng, resamples)
                numbers[scenario] = entry | {
                    "median_four_deg": float(np.median(four)),
                    "median_fifty_deg": float(np.median(fifty)),
                    "ratio_of_means": ratio,
                }
    z = regressors(commands)
    numbers["mean_prediction_variance"] = {
        "four": mean_interval(_mean_variance(pick(z, chosen), z)),
        "fifty": mean_interval(_mean_variance(z, z)),
    }
    numbers["recorded"] = _recorded(study)
    white, drift, gross = (numbers[name]["four_better"] for name in SWEEPS)
    names = ("scenario", "strength", "episode", "rms_four_deg", "rms_fifty_deg")
    return Exhibit.from_texts(
        "four_or_fifty",
        {"count": count, "drift_deg": DRIFT_DEG, "outlier_share": OUTLIER_SHARE},
        verdict=judge(white.low > 0.5, max(drift.high, gross.high) >= 0.5),
        figures={"four_or_fifty": _four_against_fifty(curves)},
        data={"four_or_fifty": from_rows(names, rows)},
        numbers=numbers,
    )


def _error(
    device: Device, region: Array, commands: Array, rng: np.random.Generator
) -> Array:
    """(E,) degrees rms over the region of a calibration from ``commands``."""
    measured, off = device.record(commands, rng)
    found = least_squares(commands, measured)
    truth = device.true_outputs(region) + off[..., None, :]
    return rms(predict(found, region) - truth)


def _means(four: Array, fifty: Array) -> dict[str, Any]:
    return {
        "four": mean_interval(four),
        "fifty": mean_interval(fifty),
        "four_better": share_interval(four < fifty),
    }


def _mean_variance(chosen: Array, region: Array) -> Array:
    """(E,) mean over the region of the prediction variance, for unit noise."""
    inverse = np.linalg.inv(np.matrix_transpose(chosen) @ chosen)
    return np.einsum("eni,eij,enj->en", region, inverse, region).mean(axis=1)


def _recorded(study: Study) -> dict[str, Any]:
    """Four of fifty recorded together, predicting every other episode of dataset4."""
    commands, measured = study.measured("dataset4")

    def across(method: str) -> Array:
        """(E,) rms of each episode's calibration over all other episodes, degrees."""
        parameters = study.parameters("dataset4", method)
        square = rms(predict(parameters, commands[None]) - measured[None]) ** 2
        return np.sqrt((square.sum(axis=1) - np.diag(square)) / (len(square) - 1))

    four, fifty = across("policy"), across("all 50")
    rng, resamples = study.settings.rng(8, 9), study.settings.size("resamples")
    ratio = ratio_interval(np.mean, four, fifty, rng, resamples)
    return _means(four, fifty) | {"ratio_of_means": ratio}


def _four_against_fifty(curves: Mapping[str, list[dict[str, Any]]]) -> Figure:
    """Mean error of prediction of four and fifty postures, and how often four win."""
    title = "Four postures against fifty, on the same devices"
    shape = {"height_ratios": (3, 2), "sharey": "row"}
    figure, axes = panels((10.0, 5.2), title, (2, len(curves)), **shape)
    for (scenario, curve), (upper, lower) in zip(curves.items(), axes.T, strict=True):
        x = np.arange(float(len(curve)))
        for i, (each, name, label) in enumerate(
            (
                (upper, "four", "policy's four"),
                (upper, "fifty", "all fifty"),
                (lower, "four_better", "four better"),
            )
        ):
            ends = [(e[name].value, e[name].low, e[name].high) for e in curve]
            look = numbered(i) | {"label": label, "markersize": 4}
            band(each, x, *np.transpose(ends), **look)
            each.set_xticks(x, [f"{entry['strength']:g}" for entry in curve])
        upper.set_yscale("log")
        plain_log(upper.yaxis)
        upper.set_title(scenario, fontsize=10)
        lower.axhline(0.5, color=BLACK, linewidth=0.6)
        lower.set(ylim=(-0.03, 1.03), xlabel=SWEEPS[scenario][1])
    axes[0, 0].set_ylabel("error of prediction (° rms,\nmean; band: its 95 % interval)")
    axes[1, 0].set_ylabel("share of devices\non which four win")
    axes[0, 0].legend(fontsize=8, frameon=False)
    return figure


# -- how many postures -----------------------------------------------------------------


def _postures(study: Study) -> Exhibit:
    settings = study.settings
    count = min(settings.size("repeats"), 200)
    unit = study.dataset("dataset2").candidates[:count]
    commands = commands_deg(study.dataset("dataset2"))[:count]
    z = regressors(commands)
    scenarios = {"white noise": Device(), "drift": Device(drift_std_deg=DRIFT_DEG)}
    rows: list[tuple[Any, ...]] = []
    for step, k in enumerate(POSTURES):
        study.progress("number of postures", step, len(POSTURES))
        draw = settings.rng(9, step)
        order = np.argsort(draw.random(unit.shape[:2]), axis=1)[:, :k]
        restarts = 20 if settings.quick else None
        best = exchange_batch(unit, k, seed=settings.seed, restarts=restarts).indices
        for choice, indices in (("D-optimal", best), ("random", order)):
            used = pick(commands, indices)
            variance = _mean_variance(pick(z, indices), z).mean()
            theory = {"white noise": NOISE_STD_DEG * float(np.sqrt(variance))}
            for which, (scenario, device) in enumerate(scenarios.items()):
                found = _error(device, commands, used, settings.rng(10, step, which))
                middle = median_interval(found)
                rows.append(
                    (
                        *(scenario, choice, k, middle.value, middle.low, middle.high),
                        float(np.sqrt((found**2).mean())),
                        theory.get(scenario, np.nan),
                    )
                )
    names = (
        *("scenario", "choice", "K", "median_rms_deg", "low", "high"),
        *("root_mean_square_deg", "theory_deg"),
    )
    table = from_rows(names, rows)
    best_of = table["choice"] == "D-optimal"
    at = {name: best_of & (table["scenario"] == name) for name in scenarios}
    white, drift = (table["median_rms_deg"][keep] for keep in at.values())
    agreement = (table["root_mean_square_deg"] / table["theory_deg"])[at["white noise"]]
    half = [k for k, v in zip(POSTURES, white, strict=True) if v <= 0.5 * white[0]]
    return Exhibit.from_texts(
        "number_of_postures",
        {
            **{"count": count, "noise": NOISE_STD_DEG, "drift_deg": DRIFT_DEG},
            **{"white": white, "last_white": white[-1], "last_drift": drift[-1]},
            "half": f", to half of it at K = {half[0]}" if half else "",
            **{"least": drift.min(), "low": agreement.min(), "high": agreement.max()},
        },
        figures={"number_of_postures": _accuracy_over_k(table)},
        data={"number_of_postures": table},
        numbers={
            "white_noise_d_optimal_deg": dict(zip(POSTURES, white, strict=True)),
            "drift_d_optimal_deg": dict(zip(POSTURES, drift, strict=True)),
            "best_k_under_drift": POSTURES[int(drift.argmin())],
            "white_noise_over_theory": agreement,
        },
    )


def _accuracy_over_k(table: Mapping[str, Array]) -> Figure:
    """Median error of prediction over K, white noise and drift side by side."""
    white = f"white noise, {NOISE_STD_DEG}°"
    drift = f"{white}, and drift, {DRIFT_DEG}° per posture"
    title = "Number of postures against accuracy"
    figure, axes = panels((9.0, 3.9), title, (1, 2), sharey=True)
    scenarios = {"white noise": white, "drift": drift}
    for each, (scenario, text) in zip(axes, scenarios.items(), strict=True):
        for i, choice in enumerate(("D-optimal", "random")):
            keep = (table["scenario"] == scenario) & (table["choice"] == choice)
            columns = [table[c][keep] for c in ("K", "median_rms_deg", "low", "high")]
            band(each, *columns, label=choice, markersize=4, **numbered(i))
        each.set(xscale="log", yscale="log", xlabel="postures measured, K")
        each.xaxis.set_major_locator(FixedLocator([4, 6, 8, 12, 20, 30, 50]))
        each.xaxis.set_minor_locator(NullLocator())
        each.xaxis.set_major_formatter(ScalarFormatter())
        plain_log(each.yaxis)
        each.set_title(text, fontsize=10)
        each.legend(fontsize=8, frameon=False)
    axes[0].set_ylabel("error of prediction\n(° rms, median; band: its 95 % interval)")
    return figure
